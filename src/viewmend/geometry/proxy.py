"""The geometry proxy G[t] of section 1: a mesh of the subject that gives its depth in any camera."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import (
    HullConfig,
    OccupancyGrid,
    bounds_from_masks,
    check_views,
    occupied_bounds,
    visual_hull,
)
from viewmend.geometry.hull_parts import filled_box, without_floating_parts
from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.geometry.rasterize import rasterize
from viewmend.geometry.surface import extract_surface
from viewmend.geometry.threads import one_thread
from viewmend.utils.tensors import OnDevice

WORTH_RECARVING = 0.85
"""A subject smaller than this fraction of the carved box is carved again in its own box."""

RECARVINGS = 3
"""A subject is carved again at most this many times."""


@dataclass(frozen=True)
class GeometryProxy(OnDevice):
    """The subject's approximate surface in one frame."""

    mesh: Mesh
    """Closed; without vertices where nothing was found."""
    normals: Float[Tensor, "vertex 3"]
    """Unit, outward, one a vertex."""
    bounds: Bounds
    """The box that was carved at full resolution."""

    @cached_property
    def center(self) -> Float[Tensor, "3"]:
        """The middle of the subject: the mean of the vertices, or the box's middle without any; on the CPU, metres."""
        return self.mesh.vertices.mean(0).cpu() if len(self.mesh.vertices) else self.bounds.on_host.center

    def depth(self, cameras: Cameras) -> Float[Tensor, "view height width"]:
        """z-depth of the surface in each camera, metres; 0 where there is none.

        Back faces are culled: a camera inside the surface does not see it.
        """
        return rasterize(self.mesh, cameras, cull="back").depth


@one_thread()
def reconstruct(
    mask: UInt8[Tensor, "view height width"],
    cameras: Cameras,
    bounds: Bounds | None = None,
    config: HullConfig | None = None,
) -> GeometryProxy:
    """The visual hull's surface from the masks of all cameras, without floating parts that no mask needs.

    A search over `bounds` (estimated from the masks where None) finds the box that the subject
    fills; all voxels are spent there. So bounds much larger than the subject cost no detail. Where
    the masks agree on no point of space, or are empty, the proxy is empty.

    Raises:
        ValueError: there is one camera only; or `bounds` is None, two masks have foreground, and the cameras
            look away from each other.
    """
    config = config or HullConfig()
    check_views(cameras)
    whole = (bounds or bounds_from_masks(mask, cameras)).on_host
    box = occupied_bounds(mask, cameras, whole, config)
    if box is None:
        nothing = torch.zeros(0, 3, device=mask.device)
        return GeometryProxy(Mesh(nothing, nothing.int()), nothing, whole.to(mask.device))
    grid = without_floating_parts(visual_hull(mask, cameras, box, config), cameras)
    # Where images end, the search cannot tell empty from unknown until its blocks are as small as voxels.
    for _ in range(RECARVINGS):
        tight = _filled_bounds(grid, box)
        if tight is None or float(tight.size_m.max()) > WORTH_RECARVING * float(box.size_m.max()):
            break
        box = tight
        grid = without_floating_parts(visual_hull(mask, cameras, tight, config), cameras)
    mesh = extract_surface(grid)
    return GeometryProxy(mesh, vertex_normals(mesh), box.to(mask.device))


def _filled_bounds(grid: OccupancyGrid, bounds: Bounds) -> Bounds | None:
    """The `filled_box` of the grid, with two voxels around it, within `bounds`; None for an empty grid."""
    sides = filled_box(grid)
    if sides is None:
        return None
    first = torch.tensor([max(side.start - 1, 0) for side in sides])
    end = torch.tensor(
        [min(side.stop + 1, size) for side, size in zip(sides, grid.values.shape, strict=True)]
    )
    low = grid.low + (first - 1) * grid.voxel_m
    high = grid.low + (end + 1) * grid.voxel_m
    return Bounds(torch.maximum(low, bounds.low), torch.minimum(high, bounds.high))
