"""Places along rays as a rig's cameras see them, in double precision as the compiled loops, for any number of them."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.geometry.cameras import Cameras


class RigCameras(NamedTuple):
    """Calibrations of some cameras."""

    P: Float[Tensor, "camera 3 4"]
    centers: Float[Tensor, "camera 3"]
    """Metres."""
    focal_px: Float[Tensor, "camera"]
    sizes_px: Int[Tensor, "camera 2"]
    """Width and height of each image."""

    @classmethod
    def of(
        cls,
        K: Float[Tensor, "camera 3 3"],
        camera_from_world: Float[Tensor, "camera 4 4"],
        sizes_px: Int[Tensor, "camera 2"],
    ) -> "RigCameras":
        """The cameras of these intrinsics (pixels) and poses (metres)."""
        P = K.double() @ camera_from_world[:, :3].double()
        return cls(P, _center(camera_from_world).double(), K[:, 0, 0].double(), sizes_px)


class Viewer(NamedTuple):
    """The camera of a novel view."""

    center: Float[Tensor, "3"]
    """Metres."""
    forward: Float[Tensor, "3"]
    world_from_pixel: Float[Tensor, "3 3"]
    """From (u, v, 1) to the direction of z-depth 1."""
    focal_px: Float[Tensor, ""]

    @classmethod
    def of(cls, camera: Cameras) -> "Viewer":
        """The viewer that has this camera (one view)."""
        K, pose = camera.K[0].double(), camera.camera_from_world[0]
        rotation = pose[:3, :3].double().T
        fx, skew, cx, fy, cy = K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]
        nothing = torch.zeros_like(fx)
        rows = (1 / fx, -skew / (fx * fy), (skew * cy - cx * fy) / (fx * fy)), (nothing, 1 / fy, -cy / fy)
        inverse = torch.stack([torch.stack(row) for row in (*rows, (nothing, nothing, nothing + 1))])
        return cls(_center(pose).double(), rotation[:, 2], rotation @ inverse, K[0, 0])


class Seen(NamedTuple):
    """Where cameras see places along rays; all 0 where a camera has the place not in view."""

    u: Float[Tensor, "ray place camera"]
    v: Float[Tensor, "ray place camera"]
    z: Float[Tensor, "ray place camera"]
    """z-depth in the camera, metres."""
    inside: Bool[Tensor, "ray place camera"]


def seen_by(
    cameras: RigCameras, viewer: Viewer, uv_px: Float[Tensor, "ray 2"], z_m: Float[Tensor, "ray place"]
) -> Seen:
    """Where the cameras see the places of these z-depths along the rays of a view's pixels."""
    away = directions(viewer, uv_px) @ cameras.P[:, :, :3].mT  # camera, ray, 3
    ray = away.movedim(0, 1)[:, None]
    start = cameras.P[:, :, :3] @ viewer.center + cameras.P[:, :, 3]
    z = z_m.double()[..., None]
    x, y, w = (ray[..., axis] * z + start[:, axis] for axis in range(3))
    front = (z > 0) & (w > 1e-6)
    safe = torch.where(front, w, 1.0)
    u, v = x / safe, y / safe
    width, height = cameras.sizes_px.double().unbind(1)
    inside = front & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v, w = (torch.where(inside, values, 0.0) for values in (u, v, w))
    return Seen(u, v, w, inside)


def cosines(
    cameras: RigCameras, viewer: Viewer, uv_px: Float[Tensor, "ray 2"], z_m: Float[Tensor, "ray place"]
) -> Float[Tensor, "ray place camera"]:
    """Cosine, at each place, of the angle between the viewer and each camera."""
    back = -directions(viewer, uv_px)
    offset = (cameras.centers - viewer.center) + z_m.double()[..., None, None] * back[:, None, None]
    across = (offset * back[:, None, None]).sum(-1)
    lengths = (offset.square().sum(-1) * back.square().sum(-1)[:, None, None]).sqrt()
    return across / lengths.clamp_min(1e-12)


def directions(viewer: Viewer, uv_px: Float[Tensor, "ray 2"]) -> Float[Tensor, "ray 3"]:
    """What a pixel's ray gains with each metre of z-depth, world coordinates."""
    uv = uv_px.double()
    return torch.cat([uv, torch.ones_like(uv[:, :1])], 1) @ viewer.world_from_pixel.T


def _center(camera_from_world: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 3"]:
    rotation, translation = camera_from_world[..., :3, :3], camera_from_world[..., :3, 3:]
    return -(rotation.mT @ translation)[..., 0]
