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
from viewmend.inpainting.correspondences import Correspondences
from viewmend.leave_one_out.true_motion import VISIBLE_M
from viewmend.views import MultiViewFrame

MOST_PIXELS = 512
"""So many missing pixels of a view, or some more, are looked for in the cameras."""


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
        assert frame.depth is not None, "the studio knows the depth"
        return cls(mesh.vertices, frame.cameras, frame.depth.half())


@dataclass(frozen=True)
class SurfaceSeen:
    """Which cameras saw, at some times, the surface point that each pixel of a true view shows."""

    names: tuple[str, ...]
    """The cameras."""
    seen: Bool[Tensor, "time view height width"]
    """The view's own time first; False where the view shows no surface."""

    def by_past_alone(self, names: Sequence[str]) -> Bool[Tensor, "height width"]:
        """Where none of these cameras sees the surface now, and one of them saw it at one of the other times."""
        by_any = self.seen[:, [self.names.index(name) for name in names]].any(1)
        return by_any[1:].any(0) & ~by_any[0]


def surface_seen(surfaces: Mapping[int, TrueSurface], times: Sequence[int], mesh: Mesh, target: Cameras) -> SurfaceSeen:
    """What the cameras saw, at these times, of the surface that `target` shows.

    Args:
        surfaces: by time; all with the same cameras.
        times: which, the view's own first.
        mesh: the true surface at the view's own time.
        target: the view's camera.
    """
    raster = rasterize(mesh, target)
    pixels = torch.nonzero(raster.triangle[0] >= 0)
    index = tuple(pixels.unbind(1))
    names, (height, width) = surfaces[times[0]].cameras.names, raster.triangle.shape[1:]
    seen = torch.zeros(len(times), len(names), height, width, dtype=torch.bool, device=pixels.device)
    for n, time in enumerate(times):
        points = interpolate(surfaces[time].vertices, mesh, target, raster)[0][index]
        _, visible = _visible(points, surfaces[time])
        for view in range(len(names)):
            seen[n, view][index] = visible[view]
    return SurfaceSeen(names, seen)


def true_correspondences(
    surfaces: Mapping[int, TrueSurface], mesh: Mesh, target: Cameras, missing: Bool[Tensor, "height width"]
) -> Correspondences:
    """Where the cameras saw, at all of these times, the surface that some missing pixels of `target` show.

    Args:
        surfaces: by time; all with the same cameras.
        mesh: the true surface at the view's own time.
        target: the view's camera.
        missing: what to look for; of many pixels, `MOST_PIXELS` or some more, evenly.
    """
    raster = rasterize(mesh, target)
    pixels = torch.nonzero(missing & (raster.triangle[0] >= 0))
    pixels = pixels[:: max(1, len(pixels) // MOST_PIXELS)]
    index = tuple(pixels.unbind(1))
    found = []
    for time, surface in surfaces.items():
        points = interpolate(surface.vertices, mesh, target, raster)[0][index]
        uv, visible = _visible(points, surface)
        camera, point = torch.nonzero(visible).unbind(1)
        found.append((pixels[point], camera, torch.full_like(camera, time), uv[camera, point]))
    names = next(iter(surfaces.values())).cameras.names
    return Correspondences(names, *(torch.cat(parts) for parts in zip(*found, strict=True)))


def _visible(
    points: Float[Tensor, "point 3"], surface: TrueSurface
) -> tuple[Float[Tensor, "view point 2"], Bool[Tensor, "view point"]]:
    """Where points of the surface are in its cameras' images, and whether these see them."""
    uv, z = project(points, surface.cameras)
    inside = in_view(uv, z, surface.cameras)
    column, row = torch.where(inside[..., None], uv, 0.0).long().unbind(-1)
    there = surface.depth[torch.arange(len(uv), device=uv.device)[:, None], row, column].float()
    return uv, inside & (there > 0) & (z - there < VISIBLE_M)
