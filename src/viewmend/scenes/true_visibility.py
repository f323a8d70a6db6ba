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

VISIBLE_M = 0.02
"""A surface point was seen if it lay at most this much behind the depth of the pixel it fell into."""


def backward_flow(
    now: Mesh, before: Mesh, depth_before: Float[Tensor, "height width"], camera: Cameras
) -> Float[Tensor, "height width 2"]:
    """Where each pixel's surface point was in the image of the time before, pixels; NaN where it was not seen.

    `now` and `before` are the same triangles of the true surface, `depth_before` is its z-depth
    then, metres, 0 where there is none. The camera, a single one, stands still.
    """
    raster = rasterize(now, camera)
    points = interpolate(before.vertices, now, camera, raster)[0]
    uv, z = project(points.reshape(-1, 3), camera)
    inside = (raster.triangle[0].flatten() >= 0) & in_view(uv, z, camera)[0]
    uv = uv[0]
    z = z[0]
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
    def of(
        cls, mesh: Mesh, cameras: Cameras, depth: Float[Tensor, "view height width"] | None = None
    ) -> "TrueSurface":
        """The surface, and its true depth in these cameras, which is rendered unless it is given."""
        depth = rasterize(mesh, cameras).depth if depth is None else depth
        return cls(mesh.vertices, cameras, depth.half())


@dataclass(frozen=True)
class PixelOrigins:
    """What shows the surface that each pixel of a true view shows; a pixel is in one of the three masks at most."""

    sources: Bool[Tensor, "height width"]
    """A source camera of the rendered view sees the surface now."""
    others: Bool[Tensor, "height width"]
    """No source camera sees it now, but another camera of the rig does."""
    past: Bool[Tensor, "height width"]
    """No camera sees it now, but a source camera saw it in an earlier frame of the window."""
    sources_past: Bool[Tensor, "height width"]
    """No source camera sees it now, but one saw it earlier, whether or not another camera sees it now."""


@dataclass(frozen=True)
class SurfaceSeen:
    """Which cameras saw, at some times, the surface point that each pixel of a true view shows."""

    names: tuple[str, ...]
    seen: Bool[Tensor, "time view height width"]
    """The view's own time first; False where the view shows no surface."""

    def origins(self, sources: Sequence[str]) -> PixelOrigins:
        """The pixels by what shows their surface, for a view that `sources` colour."""
        by_sources = self.seen[:, [self.names.index(name) for name in sources]].any(1)
        now = by_sources[0]
        before = by_sources[1:].any(0)
        by_any = self.seen[0].any(0)
        return PixelOrigins(now, by_any & ~now, before & ~by_any, before & ~now)


def surface_seen(
    surfaces: Mapping[int, TrueSurface], times: Sequence[int], mesh: Mesh, target: Cameras
) -> SurfaceSeen:
    """What the cameras saw, at these times, of the surface that the view of the camera `target` shows.

    `surfaces` are by time. The view's own time is the first and has all cameras; the others
    may have fewer, and what these saw counts as unseen. `mesh` is the true surface at the
    view's own time.
    """
    raster = rasterize(mesh, target)
    pixels = torch.nonzero(raster.triangle[0] >= 0)
    index = tuple(pixels.unbind(1))
    names = surfaces[times[0]].cameras.names
    height, width = raster.triangle.shape[1:]
    seen = torch.zeros(len(times), len(names), height, width, dtype=torch.bool, device=pixels.device)
    for n, time in enumerate(times):
        surface = surfaces[time]
        uv, z = project(interpolate(surface.vertices, mesh, target, raster)[0][index], surface.cameras)
        inside = in_view(uv, z, surface.cameras)
        column, row = torch.where(inside[..., None], uv, 0.0).long().unbind(-1)
        there = surface.depth[torch.arange(len(uv), device=uv.device)[:, None], row, column].float()
        visible = inside & (there > 0) & (z - there < VISIBLE_M)
        for name, by_camera in zip(surface.cameras.names, visible, strict=True):
            seen[n, names.index(name)][index] = by_camera
    return SurfaceSeen(names, seen)
