"""The world that engines share: metres, right-handed, y up, as glTF has it."""

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.upright import horizontal_axes


def engine_from_world(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation about the capture's origin that turns its `up` into +y, and azimuth 0 into +z."""
    up = up / up.norm()
    front, side = horizontal_axes(up)
    return torch.stack([side, up, front])


def engine_from_cameras(cameras: Cameras, rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "view 4 4"]:
    """The cameras' poses in the engines' world, by the axes of OpenGL: x right, y up, looking along -z."""
    poses = cameras.world_from_camera.clone()
    poses[:, :3] = rotation @ poses[:, :3]
    return poses * poses.new_tensor([1.0, -1.0, -1.0, 1.0])
