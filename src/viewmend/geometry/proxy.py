"""The geometry proxy G[t] of section 1: a mesh of the subject that gives its depth in any camera."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import HullConfig, bounds_from_masks, occupied_bounds, visual_hull
from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.geometry.rasterize import rasterize
from viewmend.geometry.surface import extract_surface


@dataclass(frozen=True)
class GeometryProxy:
    """The subject's approximate surface at one time."""

    mesh: Mesh
    """Closed; without vertices where nothing was found."""
    normals: Float[Tensor, "vertex 3"]
    """Unit, outward, one a vertex."""
    bounds: Bounds
    """The box that was carved at full resolution."""

    def depth(self, cameras: Cameras) -> Float[Tensor, "view height width"]:
        """z-depth of the surface in each camera, metres; 0 where there is none."""
        return rasterize(self.mesh, cameras).depth

    def to(self, device: torch.device | str) -> "GeometryProxy":
        """The same proxy on `device`."""
        return GeometryProxy(self.mesh.to(device), self.normals.to(device), self.bounds.to(device))


def reconstruct(
    mask: UInt8[Tensor, "view height width"],
    cameras: Cameras,
    bounds: Bounds | None = None,
    config: HullConfig | None = None,
) -> GeometryProxy:
    """The visual hull's surface from the masks of all cameras.

    A coarse pass over `bounds` (estimated from the masks where None) finds the box that the subject fills; the fine
    pass spends its voxels there. So bounds much larger than the subject cost no detail. Where the masks agree on no
    point of space, the proxy is empty.

    Raises:
        ValueError: there is one camera only, or no mask has any foreground.
    """
    config = config or HullConfig()
    bounds = bounds or bounds_from_masks(mask, cameras)
    bounds = occupied_bounds(mask, cameras, bounds, config) or bounds
    mesh = extract_surface(visual_hull(mask, cameras, bounds, config))
    return GeometryProxy(mesh, vertex_normals(mesh), bounds)
