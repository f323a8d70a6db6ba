"""The geometry proxy by itself, as a viewer sees it: its surface in the light of a lamp, or its vertices as dots."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, pixel_centers, project, unproject
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.geometry.sampling import in_view

CLAY = (0.86, 0.83, 0.79)
"""RGB of the surface where it faces the viewer."""
GRAZING = 0.18
"""How bright it is where it does not face the viewer at all, as a share."""
DOT = 0.7
"""A dot's side, as a share of the vertices' distance from one another."""
LARGEST_PX = 32
"""Dots are no larger, however near they are."""
BEHIND = 1.5
"""Vertices are hidden that lie more than so many of these distances behind the surface."""


def shaded_hull(proxy: GeometryProxy, camera: Cameras) -> Float[Tensor, "4 height width"]:
    """The surface, lit from the viewer: RGB in [0, 1] and, last, 1 where there is any.

    Args:
        proxy: of one time.
        camera: one view.
    """
    raster = rasterize(proxy.mesh, camera, cull="back")
    cover = raster.depth[0] > 0
    height, width = cover.shape
    normals = interpolate(proxy.normals, proxy.mesh, camera, raster)[0]
    uv = pixel_centers(width, height, cover.device).reshape(1, -1, 2)
    away = unproject(uv, torch.ones_like(uv[..., 0]), camera)[0] - camera.centers
    facing = F.cosine_similarity(normals.reshape(-1, 3), -away, dim=-1).view(height, width).clamp(min=0)
    light = (GRAZING + (1 - GRAZING) * facing) * cover
    return torch.cat([light * light.new_tensor(CLAY)[:, None, None], cover[None].to(light)])


def hull_points(
    proxy: GeometryProxy, colours: Float[Tensor, "vertex 3"], camera: Cameras
) -> Float[Tensor, "4 height width"]:
    """The vertices as square dots, the nearest in front: RGB in [0, 1] and, last, 1 where there is a dot.

    Args:
        proxy: of one time.
        colours: one a vertex, as of `vertex_colours`.
        camera: one view.
    """
    width, height = camera.max_size_px
    image = np.zeros((height, width, 4), np.float32)
    mesh = proxy.mesh
    if len(mesh.vertices):
        first, second = mesh.vertices[mesh.faces[:, :2].long()].unbind(1)
        apart_m = float((first - second).norm(dim=-1).median())
        uv, z = project(mesh.vertices, camera)
        column, row = (uv[0, :, axis].long().clamp(0, most - 1) for axis, most in ((0, width), (1, height)))
        surface = proxy.depth(camera)[0][row, column]
        shown = in_view(uv, z, camera)[0] & ((surface == 0) | (z[0] <= surface + BEHIND * apart_m))
        order = torch.where(shown, z[0], 0.0).argsort(descending=True)[: int(shown.sum())]  # the farthest first
        sides = (DOT * apart_m * camera.K[0, 0, 0] / z[0, order]).round().clamp(1, LARGEST_PX)
        drawn = torch.cat([colours, torch.ones_like(colours[:, :1])], 1)[order]
        _draw(image, *(told.cpu().numpy() for told in (row[order], column[order], sides.long(), drawn)))
    return torch.from_numpy(image).movedim(-1, 0).to(colours)


def _draw(
    image: Float[np.ndarray, "height width 4"],
    rows: Int[np.ndarray, "dot"],
    columns: Int[np.ndarray, "dot"],
    sides: Int[np.ndarray, "dot"],
    colours: Float[np.ndarray, "dot 4"],
) -> None:
    """Squares of these sides about these pixels, each over those before it; sides must not shrink."""
    for side in np.unique(sides):
        own, reach = sides == side, np.arange(side) - side // 2
        y, x = np.broadcast_arrays(rows[own, None, None] + reach[:, None], columns[own, None, None] + reach)
        inside = (y >= 0) & (y < image.shape[0]) & (x >= 0) & (x < image.shape[1])
        dot = np.nonzero(inside)[0]
        image[y[inside], x[inside]] = colours[own][dot]
