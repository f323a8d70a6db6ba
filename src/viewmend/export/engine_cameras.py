"""Cameras in the world of 3D engines: metres, +y up, OpenGL's axes."""

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.orbit import horizontal_axes

SENSOR_MM = 36.0
"""The sensor width of every camera in millimetres: engines need one, but only its ratio to the
focal length matters."""


def engine_from_world(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation of the capture's `up` to +y, and of azimuth 0 to +z: right-handed and y up, as in glTF."""
    up = up / up.norm()
    front, side = horizontal_axes(up)
    return torch.stack([side, up, front])


def engine_from_cameras(cameras: Cameras, rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "view 4 4"]:
    """The cameras' poses in the engine's world, with OpenGL axes: x right, y up, looking along -z."""
    poses = cameras.world_from_camera.clone()
    poses[:, :3] = rotation @ poses[:, :3]
    return poses * poses.new_tensor([1.0, -1.0, -1.0, 1.0])
