"""Views of the geometry proxy itself: its shaded surface, or its vertices as dots in the cameras' colours."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, pixel_centers, project, unproject
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.geometry.sampling import in_view, sample_bilinear
from viewmend.types import ContextViews

CLAY = (0.86, 0.83, 0.79)
"""The surface has this colour, RGB in [0, 1], where it faces the viewer."""
GRAZING = 0.18
"""The surface has this brightness at grazing angles, relative to where it faces the viewer."""
DOT = 0.7
"""A dot's side is this many times the distance between neighbouring vertices."""
MAX_DOT_PX = 32
"""A dot's side has at most this many pixels."""
BEHIND = 1.5
"""A vertex is hidden if it lies this far behind the visible surface, in distances between
neighbouring vertices."""
FRONTAL_POWER = 4
"""A camera's weight at a vertex is this power of the cosine between the normal and the direction to
the camera."""
BIAS = 0.01
"""A vertex is hidden if it lies this far behind the proxy's depth, as a fraction of the diagonal of
the hull's box."""
MIN_MASK = 0.5
"""A sample is ignored if its foreground fraction is below this."""
MIN_WEIGHT = 1e-4
"""A vertex counts as unseen if the sum of its cameras' weights is below this."""
GREY = 0.5
"""Vertices that are not connected to any that a camera sees have this grey level, in [0, 1]."""


def shaded_hull(proxy: GeometryProxy, camera: Cameras) -> Float[Tensor, "4 height width"]:
    """The surface lit from the viewer: RGB in [0, 1], and 1 in the last channel where there is a surface."""
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
    """The vertices as square dots, the nearest in front: RGB in [0, 1], and 1 in the last channel on dots."""
    width, height = camera.max_size_px
    image = np.zeros((height, width, 4), np.float32)
    mesh = proxy.mesh
    if len(mesh.vertices):
        first, second = mesh.vertices[mesh.faces[:, :2].long()].unbind(1)
        apart_m = float((first - second).norm(dim=-1).median())
        uv, z = project(mesh.vertices, camera)
        column = uv[0, :, 0].long().clamp(0, width - 1)
        row = uv[0, :, 1].long().clamp(0, height - 1)
        surface = proxy.depth(camera)[0][row, column]
        visible = in_view(uv, z, camera)[0] & ((surface == 0) | (z[0] <= surface + BEHIND * apart_m))
        farthest_first = torch.where(visible, z[0], 0.0).argsort(descending=True)
        order = farthest_first[: int(visible.sum())]
        sides = (DOT * apart_m * camera.K[0, 0, 0] / z[0, order]).round().clamp(1, MAX_DOT_PX).long()
        rgba = torch.cat([colours, torch.ones_like(colours[:, :1])], 1)[order]
        _draw(
            image,
            row[order].cpu().numpy(),
            column[order].cpu().numpy(),
            sides.cpu().numpy(),
            rgba.cpu().numpy(),
        )
    return torch.from_numpy(image).movedim(-1, 0).to(colours)


def vertex_colours(proxy: GeometryProxy, views: ContextViews) -> Float[Tensor, "vertex 3"]:
    """RGB of the proxy's vertices, in [0, 1]: a mean of the cameras that see a vertex, weighted towards frontal ones.

    Unseen vertices take the colour of the nearest coloured vertices along the mesh.
    """
    vertices = proxy.mesh.vertices
    total = vertices.new_zeros(len(vertices), 4)
    for view in range(len(views.frame.cameras)):
        total += _weighted_colours(proxy, views, view)
    known = total[:, 3] > MIN_WEIGHT
    mean = total[:, :3] / total[:, 3:].clamp(min=MIN_WEIGHT)
    return _spread(torch.where(known[:, None], mean, GREY), known, proxy.mesh)


def _weighted_colours(proxy: GeometryProxy, views: ContextViews, view: int) -> Float[Tensor, "vertex 4"]:
    """Colours of the vertices in one camera, times their weights, and the weights; 0 where it does not see them."""
    vertices = proxy.mesh.vertices
    frame = views.frame
    bias_m = BIAS * float(proxy.bounds.size_m.norm())

    # Sample the camera at the vertices
    camera = frame.cameras[view]
    uv, z = project(vertices, camera)
    rgb = frame.rgb[view].to(vertices) / 255
    depth = views.depth[view]
    mask = (depth > 0).to(rgb) if frame.mask is None else frame.mask[view].to(rgb) / 255
    sample = sample_bilinear(torch.cat([rgb * mask, mask[None]])[None], uv)[0]
    column, row = uv[0].long().unbind(-1)
    surface = depth[row.clamp(0, depth.shape[0] - 1), column.clamp(0, depth.shape[1] - 1)]

    # Weigh the visible ones by their angle to the camera
    visible = (
        in_view(uv, z, camera)[0] & (surface > 0) & (z[0] <= surface + bias_m) & (sample[:, 3] > MIN_MASK)
    )
    to_camera = F.normalize(camera.centers - vertices, dim=-1)
    weight = visible * (proxy.normals * to_camera).sum(-1).clamp(min=0) ** FRONTAL_POWER
    colour = sample[:, :3] / sample[:, 3:].clamp(min=MIN_MASK)
    return weight[:, None] * torch.cat([colour, torch.ones_like(z.mT)], 1)


def _draw(
    image: Float[np.ndarray, "height width 4"],
    rows: Int[np.ndarray, "dot"],
    columns: Int[np.ndarray, "dot"],
    sides: Int[np.ndarray, "dot"],
    colours: Float[np.ndarray, "dot 4"],
) -> None:
    """Draw squares of these sides around these pixels, in order; sides must not decrease."""
    for side in np.unique(sides):
        own = sides == side
        reach = np.arange(side) - side // 2
        y, x = np.broadcast_arrays(rows[own, None, None] + reach[:, None], columns[own, None, None] + reach)
        inside = (y >= 0) & (y < image.shape[0]) & (x >= 0) & (x < image.shape[1])
        image[y[inside], x[inside]] = colours[own][np.nonzero(inside)[0]]


def _spread(
    colours: Float[Tensor, "vertex 3"], known: Bool[Tensor, "vertex"], mesh: Mesh
) -> Float[Tensor, "vertex 3"]:
    """The colours, with those of unknown vertices taken from their neighbours, ring by ring."""
    faces = mesh.faces.long()
    sides = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = torch.cat([sides, sides.flip(1)])
    while True:
        reached = edges[known[edges[:, 0]] & ~known[edges[:, 1]]]
        if not len(reached):
            return colours
        sums = colours.new_zeros(len(colours), 4)
        sums.index_add_(
            0, reached[:, 1], torch.cat([colours[reached[:, 0]], colours.new_ones(len(reached), 1)], 1)
        )
        new = sums[:, 3] > 0
        colours = torch.where(new[:, None], sums[:, :3] / sums[:, 3:].clamp(min=1), colours)
        known = known | new
