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
from viewmend.leave_one_out.true_motion import VISIBLE_M
from viewmend.views import MultiViewFrame


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
        surface = surfaces[time]
        points = interpolate(surface.vertices, mesh, target, raster)[0][index]
        uv, z = project(points, surface.cameras)
        inside = in_view(uv, z, surface.cameras)
        column, row = torch.where(inside[..., None], uv, 0.0).long().unbind(-1)
        for view in range(len(names)):
            there = surface.depth[view, row[view], column[view]].float()
            seen[n, view][index] = inside[view] & (there > 0) & (z[view] - there < VISIBLE_M)
    return SurfaceSeen(names, seen)
