"""Novel views on a circle around the subject."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, concatenate_cameras, pinhole, project
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import reconstruct
from viewmend.geometry.rigid import look_at

AGREED = 0.5
"""The images' up directions do not agree if the length of their mean is below this."""
MARGIN = 0.06
"""A fitted path leaves this fraction of half an image free around the subject."""
FITTED_FRAMES = 24
"""The largest number of frames of a motion that are reconstructed to find what it covers."""
FITTED_RESOLUTION = 64
"""Their hulls have this many voxels along the longest side."""
FULL_TURN_GAP_RAD = math.radians(130)
"""A rig with a larger gap between neighbouring cameras does not surround the subject, so its orbit
swings back and forth."""


def upright(cameras: Cameras) -> Float[Tensor, "3"]:
    """The rig's up, a unit vector in the world.

    The mean of the images' up directions or, where these disagree (images partly upside down), the
    normal of the plane that the cameras lie in.
    """
    mean = -cameras.camera_from_world[:, 1, :3].mean(0)
    if float(mean.norm()) < AGREED:
        normal = torch.linalg.svd(cameras.centers - cameras.centers.mean(0)).Vh[2]
        mean = normal if float(normal @ mean) >= 0 else -normal
    return mean / mean.norm()


def horizontal_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Where azimuth 0 and azimuth 90 degrees are, unit vectors in the world: +z and +x where `up` (unit) is +y."""
    ahead = up.new_tensor([0.0, 0.0, 1.0] if abs(float(up[2])) < 0.9 else [1.0, 0.0, 0.0])
    front = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=0)
    return front, torch.linalg.cross(up, front)


def orbit(
    azimuths_rad: Sequence[float],
    size_px: tuple[int, int],
    *,
    radius_m: float,
    elevation_rad: float,
    center: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
    visible_m: float,
) -> Cameras:
    """Novel cameras on a circle around `center`, one for each azimuth.

    Args:
        azimuths_rad: as `horizontal_axes` counts them.
        size_px: width and height of the images.
        radius_m: distance from the centre.
        elevation_rad: above the horizon.
        center: the subject's middle, metres.
        up: the world's up.
        visible_m: what the shorter side of an image shows at the centre.
    """
    up = up / up.norm()
    front, side = horizontal_axes(up)
    fov_y = fov_y_showing(size_px, visible_m, radius_m)
    views = []
    for n, azimuth in enumerate(azimuths_rad):
        flat = math.cos(azimuth) * front + math.sin(azimuth) * side
        eye = center + radius_m * (math.cos(elevation_rad) * flat + math.sin(elevation_rad) * up)
        views.append(pinhole(fov_y, *size_px, look_at(eye, center, up), f"orbit{n:03d}"))
    return concatenate_cameras(views)


def fov_y_showing(size_px: tuple[int, int], visible_m: float, distance_m: float) -> float:
    """Vertical field of view (radians) of an image whose shorter side shows `visible_m` at a distance."""
    width, height = size_px
    return 2 * math.atan(visible_m / 2 / distance_m * height / min(width, height))


def orbit_around(
    center: Float[Tensor, "3"],
    cameras: Cameras,
    up: Float[Tensor, "3"] | None,
    views: int,
    frames_per_turn: int,
    arc_rad: float | None = None,
    size_px: tuple[int, int] | None = None,
) -> Cameras:
    """Novel cameras on a circle about `center`, as far and as high as the rig's cameras on average.

    A rig all around is circled once every `frames_per_turn` views; for a rig on one side the path
    swings from its one end to the other and back. Images show as much as the first camera's.

    Args:
        center: the subject's middle, metres.
        cameras: the rig.
        up: the world's up; by default `upright(cameras)`.
        views: how many cameras to give.
        frames_per_turn: length of a whole turn, or of a swing there and back.
        arc_rad: angle to swing over; a whole turn circles. By default what the rig covers.
        size_px: width and height of the images; by default the first camera's.
    """
    up = upright(cameras) if up is None else up.to(center) / up.norm()
    offsets = cameras.centers - center
    distance = offsets.norm(dim=-1)
    elevation = torch.asin((offsets @ up / distance).clamp(-1, 1)).mean()
    front, side = horizontal_axes(up)
    azimuths = _swing(torch.atan2(offsets @ side, offsets @ front).tolist(), views, frames_per_turn, arc_rad)
    width, height = cameras.size_px[0].tolist()
    radius_m = float(distance.mean())
    return orbit(
        azimuths,
        size_px or (width, height),
        radius_m=radius_m,
        elevation_rad=float(elevation),
        center=center.cpu(),
        up=up.cpu(),
        visible_m=min(width, height) / float(cameras.K[0, 1, 1]) * radius_m,
    )


def coarse_surface(
    mask: UInt8[Tensor, "camera height width"], cameras: Cameras, bounds: Bounds | None
) -> Float[Tensor, "point 3"]:
    """Points on the subject's surface in a frame, metres, to find what a motion covers."""
    return reconstruct(mask, cameras, bounds, HullConfig(resolution=FITTED_RESOLUTION)).mesh.vertices.cpu()


def thinned(moments: Sequence[int]) -> list[int]:
    """Select at most `FITTED_FRAMES` moments, evenly spaced: enough to know what a motion covers."""
    return list(moments[:: -(-len(moments) // FITTED_FRAMES) or 1])


def fit_to(path: Cameras, points: Float[Tensor, "point 3"]) -> Cameras:
    """The cameras of a path, of one image size, with the focal length at which all images show all points."""
    cameras = path.to("cpu")
    uv_px, z = project(points.cpu(), cameras)
    half = cameras.size_px[:, None].float() / 2
    ratio = (((uv_px - half) / half).abs().amax(-1) * (z > 0)).max()
    K = cameras.K.clone()
    for axis in (0, 1):
        K[:, axis, axis] = K[:, axis, axis] * (1 - MARGIN) / ratio
    return replace(cameras, K=K)


def _swing(
    azimuths: Sequence[float], views: int, frames_per_turn: int, arc_rad: float | None = None
) -> list[float]:
    """Azimuths of a path over the rig's own, beginning in the middle of its widest gap's far end."""
    ordered = sorted(a % (2 * math.pi) for a in azimuths)
    gaps = [
        (after - before) % (2 * math.pi)
        for before, after in zip(ordered, [*ordered[1:], ordered[0]], strict=True)
    ]
    widest = max(range(len(gaps)), key=lambda n: gaps[n])
    start = ordered[(widest + 1) % len(ordered)]
    phases = [view / frames_per_turn for view in range(views)]
    surrounds = len(ordered) > 1 and gaps[widest] < FULL_TURN_GAP_RAD
    covered = (2 * math.pi - gaps[widest]) % (2 * math.pi) if len(ordered) > 1 else math.pi / 6
    middle = start if surrounds else start + covered / 2
    arc = arc_rad if arc_rad is not None else 2 * math.pi if surrounds else covered
    if arc > 2 * math.pi - 1e-6:
        return [middle + 2 * math.pi * phase for phase in phases]
    return [middle - arc / 2 * math.cos(2 * math.pi * phase) for phase in phases]
