"""Drawing a triangle mesh into cameras: depth, triangle ids, and interpolated attributes."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.geometry._rasterize_torch import edge_functions, homogeneous, rasterize_torch
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.threads import light_operations, parallel_for

NEAR_M = 1e-6
"""Surface nearer than this is not drawn."""

BANDS = 4
"""Horizontal strips that share one view among threads when there are few views."""


@dataclass(frozen=True)
class Raster:
    """What each pixel's centre sees of a mesh."""

    depth: Float[Tensor, "view height width"]
    """z-depth in metres, 0 where there is no surface."""
    triangle: Int[Tensor, "view height width"]
    """Index into the mesh's faces (int32), -1 where there is no surface."""


@light_operations()
def rasterize(mesh: Mesh, cameras: Cameras, cull: Literal["none", "back", "front"] = "none") -> Raster:
    """Draw `mesh` into every camera, images of `cameras.max_size_px`; nothing is drawn beyond a view's own size.

    A pixel is covered if its centre is in a triangle (edges included: no cracks); the nearest surface wins, and of
    equally near ones the lower index. What is behind a camera draws nothing. Depth is perspective-correct.

    Args:
        mesh: triangles in the world; numba draws them on the CPU, torch elsewhere.
        cameras: on the mesh's device.
        cull: "back" leaves out the faces whose corners run clockwise in the image, "front" the others.
    """
    side = {"none": 0, "back": 1, "front": -1}[cull]
    if mesh.vertices.device.type == "cpu":
        return _rasterize_cpu(mesh, cameras, side)
    return Raster(*rasterize_torch(mesh, cameras, NEAR_M, side))


def barycentric(mesh: Mesh, cameras: Cameras, raster: Raster) -> Float[Tensor, "view height width 3"]:
    """Each pixel's perspective-correct weights of its triangle's three corners; zeros where there is no surface."""
    weights = mesh.vertices.new_zeros(*raster.triangle.shape, 3)
    where, _, values = _visible_corners(mesh, cameras, raster)
    weights[where] = values
    return weights


def interpolate(
    attributes: Float[Tensor, "vertex channel"], mesh: Mesh, cameras: Cameras, raster: Raster
) -> Float[Tensor, "view height width channel"]:
    """Vertex attributes at every pixel of `raster`, perspective-correct; zeros where there is no surface."""
    image = attributes.new_zeros(*raster.triangle.shape, attributes.shape[1])
    if attributes.device.type == "cpu" and not (attributes.requires_grad or mesh.vertices.requires_grad):
        return _interpolate_cpu(attributes, mesh, cameras, raster, image)
    where, corners, weights = _visible_corners(mesh, cameras, raster)
    image[where] = (attributes[corners] * weights[..., None].to(attributes)).sum(1)
    return image


def _interpolate_cpu(attributes, mesh: Mesh, cameras: Cameras, raster: Raster, image):
    from viewmend.geometry._rasterize_numba import interpolate_band

    P = (cameras.K.double() @ cameras.camera_from_world[:, :3].double()).numpy()
    given = attributes.numpy(), mesh.vertices.numpy(), mesh.faces.numpy()
    triangles, images, rows = raster.triangle.numpy(), image.numpy(), image.shape[1]

    def work(item: int) -> None:
        view, part = divmod(item, BANDS)
        first, end = rows * part // BANDS, rows * (part + 1) // BANDS
        interpolate_band(*given, P[view], triangles[view], first, end, images[view])

    parallel_for(work, len(cameras) * BANDS)
    return image


def _visible_corners(
    mesh: Mesh, cameras: Cameras, raster: Raster
) -> tuple[tuple[Tensor, ...], Int[Tensor, "pixel 3"], Float[Tensor, "pixel 3"]]:
    """Where surface is seen; there the three vertices of the triangle and their weights."""
    where = (raster.triangle >= 0).nonzero(as_tuple=True)
    view, row, column = where
    corners = mesh.faces[raster.triangle[where].long()].long()
    edges, _ = edge_functions(homogeneous(mesh.vertices, cameras)[view[:, None], corners])
    values = edges[..., 0] * (column + 0.5)[:, None] + edges[..., 1] * (row + 0.5)[:, None] + edges[..., 2]
    return where, corners, (values / values.sum(-1, keepdim=True)).to(mesh.vertices)


def _rasterize_cpu(mesh: Mesh, cameras: Cameras, side: int) -> Raster:
    from viewmend.geometry import _rasterize_numba as kernels

    width, height = cameras.max_size_px
    views, vertices, faces = len(cameras), mesh.vertices.detach().numpy(), mesh.faces.numpy()
    P = (cameras.K.double() @ cameras.camera_from_world[:, :3].double()).detach().numpy()
    size = cameras.size_px.tolist()
    projected = torch.empty(views, len(vertices), 5, dtype=torch.float64).numpy()
    depth = torch.zeros(views, height, width)
    triangle = torch.full((views, height, width), -1, dtype=torch.int32)
    depths, triangles = depth.numpy(), triangle.numpy()
    bands = 1 if views >= BANDS else BANDS

    def draw(item: int) -> None:
        view, band = divmod(item, bands)
        columns, rows = size[view]
        first, end = rows * band // bands, rows * (band + 1) // bands
        kernels.draw_band(projected[view], faces, NEAR_M, side, first, end, columns, depths[view], triangles[view])

    parallel_for(lambda view: kernels.project_vertices(vertices, P[view], projected[view]), views)
    parallel_for(draw, views * bands)
    return Raster(depth, triangle)
