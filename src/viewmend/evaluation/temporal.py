"""Change from frame to frame, along the true motion of the surface and in place."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.geometry.sampling import in_view, sample_bilinear

VISIBLE_M = 0.02
"""A surface point was seen if it lay at most this much behind the depth of the pixel it fell into."""


def backward_flow(
    now: Mesh, before: Mesh, depth_before: Float[Tensor, "height width"], camera: Cameras
) -> Float[Tensor, "height width 2"]:
    """Where each pixel's surface point was in the image of the time before, pixels; NaN where it was not seen.

    Args:
        now: the true surface.
        before: the same vertices and triangles at the time before.
        depth_before: its z-depth in the camera, metres, 0 where there is none.
        camera: one camera, which stands still.
    """
    raster = rasterize(now, camera)
    points = interpolate(before.vertices, now, camera, raster)[0]
    uv, z = project(points.reshape(-1, 3), camera)
    inside = (raster.triangle[0].flatten() >= 0) & in_view(uv, z, camera)[0]
    uv, z = uv[0], z[0]
    column, row = torch.where(inside[:, None], uv, 0.0).long().unbind(-1)
    there = depth_before[row, column]
    seen = inside & (there > 0) & ((z - there).abs() < VISIBLE_M)
    return torch.where(seen[:, None], uv, torch.nan).view(*depth_before.shape, 2)


def warp_error(
    image: Float[Tensor, "channel height width"],
    before: Float[Tensor, "channel height width"],
    backward_flow_px: Float[Tensor, "height width 2"],
    pixels: Bool[Tensor, "height width"],
    enough_px: int = 1,
) -> float | None:
    """Mean absolute difference of an image and the one before, warped by the true motion, over some pixels.

    Counted are those of `pixels` whose surface point was seen before; None where they are fewer than `enough_px`. The
    image before is sampled bilinearly, so the truth's own error is not 0: compare with it.
    """
    counted = pixels & backward_flow_px.isfinite().all(-1)
    if int(counted.sum()) < enough_px:
        return None
    warped = sample_bilinear(before[None], backward_flow_px[counted][None], "border")[0]
    return float((image[:, counted] - warped.T).abs().mean())


def change(
    image: Float[Tensor, "channel height width"],
    before: Float[Tensor, "channel height width"],
    pixels: Bool[Tensor, "height width"],
    enough_px: int = 1,
) -> float | None:
    """Mean absolute difference of an image and the one before in the same places; None where they are too few."""
    return float((image - before)[:, pixels].abs().mean()) if int(pixels.sum()) >= enough_px else None
