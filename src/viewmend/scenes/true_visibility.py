"""Which cameras truly saw the surface that a view shows, now and before: what only the past can tell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.geometry.sampling import in_view
from viewmend.types import MultiViewFrame

VISIBLE_M = 0.02
"""A surface point was seen if it lay at most this much behind the depth of the pixel it fell into."""


def backward_flow(
    now: Mesh, before: Mesh, depth_before: Float[Tensor, "height width"], camera: Cameras
) -> Float[Tensor, "height width 2"]:
    """Where each pixel's surface point was in the image of the time before, pixels; NaN where it was not seen.

    `now` and `before` are the same triangles of the true surface, `depth_before` is its z-depth then, metres, 0 where
    there is none. The camera, a single one, stands still.
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


@dataclass(frozen=True)
class TrueSurface:
    """The true surface at one time, and how far the cameras see: what a later time needs of it."""

    vertices: Float[Tensor, "vertex 3"]
    """Metres, world; the same vertices at every time."""
    cameras: Cameras
    depth: Float[Tensor, "view height width"]
    """True z-depth, metres, in half precision: a step at 4 m is 4 mm, and `VISIBLE_M` is more."""

    @classmethod
    def of(cls, frame: MultiViewFrame, mesh: Mesh) -> "TrueSurface":
        """The surface of a frame with true depth."""
        assert frame.depth is not None, "studio frames have depth"
        return cls(mesh.vertices, frame.cameras, frame.depth.half())


@dataclass(frozen=True)
class SurfaceSeen:
    """Which cameras saw, at some times, the surface point that each pixel of a true view shows."""

    names: tuple[str, ...]
    seen: Bool[Tensor, "time view height width"]
    """The view's own time first; False where the view shows no surface."""

    def by_past_alone(self, names: Sequence[str]) -> Bool[Tensor, "height width"]:
        """Pixels whose surface none of these cameras sees now, but one saw in another frame."""
        by_any = self.seen[:, [self.names.index(name) for name in names]].any(1)
        return by_any[1:].any(0) & ~by_any[0]


def surface_seen(surfaces: Mapping[int, TrueSurface], times: Sequence[int], mesh: Mesh, target: Cameras) -> SurfaceSeen:
    """What the cameras saw, at these times, of the surface that the view of the camera `target` shows.

    `surfaces` are by time, and all have the same cameras. The view's own time is the first; `mesh` is the true surface
    then.
    """
    raster = rasterize(mesh, target)
    pixels = torch.nonzero(raster.triangle[0] >= 0)
    index = tuple(pixels.unbind(1))
    names, (height, width) = surfaces[times[0]].cameras.names, raster.triangle.shape[1:]
    seen = torch.zeros(len(times), len(names), height, width, dtype=torch.bool, device=pixels.device)
    for n, time in enumerate(times):
        surface = surfaces[time]
        uv, z = project(interpolate(surface.vertices, mesh, target, raster)[0][index], surface.cameras)
        inside = in_view(uv, z, surface.cameras)
        column, row = torch.where(inside[..., None], uv, 0.0).long().unbind(-1)
        there = surface.depth[torch.arange(len(uv), device=uv.device)[:, None], row, column].float()
        visible = inside & (there > 0) & (z - there < VISIBLE_M)
        for view in range(len(names)):
            seen[n, view][index] = visible[view]
    return SurfaceSeen(names, seen)
