"""Where the studio's surface really moved, seen from a camera."""

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.geometry.sampling import in_view

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
