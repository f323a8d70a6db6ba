"""Drawing a triangle mesh into cameras: depth, triangle ids, and interpolated attributes."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.threads import light_operations, parallel_for
from viewmend.utils.tensors import OnDevice

NEAR_M = 1e-6
"""Surface nearer than this is not drawn."""

BANDS = 4
"""Horizontal strips that share one view among threads when there are few views."""


@dataclass(frozen=True)
class Raster(OnDevice):
    """Depth and triangle at each pixel centre."""

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
        mesh: triangles in the world, drawn on the CPU.
        cameras: on the mesh's device, as is the result.
        cull: "back" leaves out the faces whose corners run clockwise in the image, "front" the others.
    """
    from viewmend.geometry import _rasterize_numba as kernels

    device, mesh, cameras = mesh.vertices.device, mesh.to("cpu"), cameras.to("cpu")
    side = {"none": 0, "back": 1, "front": -1}[cull]
    width, height = cameras.max_size_px
    views, vertices, faces = len(cameras), mesh.vertices.numpy(), mesh.faces.numpy()
    P = (cameras.K.double() @ cameras.camera_from_world[:, :3].double()).numpy()
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
    return Raster(depth, triangle).to(device)


def interpolate(
    attributes: Float[Tensor, "vertex channel"], mesh: Mesh, cameras: Cameras, raster: Raster
) -> Float[Tensor, "view height width channel"]:
    """Vertex attributes at every pixel of `raster`, perspective-correct; zeros where there is no surface."""
    from viewmend.geometry._rasterize_numba import interpolate_band

    device, mesh, cameras, raster = attributes.device, mesh.to("cpu"), cameras.to("cpu"), raster.to("cpu")
    image = torch.zeros(*raster.triangle.shape, attributes.shape[1], dtype=attributes.dtype)
    P = (cameras.K.double() @ cameras.camera_from_world[:, :3].double()).numpy()
    given = attributes.cpu().numpy(), mesh.vertices.numpy(), mesh.faces.numpy()
    triangles, images, rows = raster.triangle.numpy(), image.numpy(), image.shape[1]

    def work(item: int) -> None:
        view, part = divmod(item, BANDS)
        first, end = rows * part // BANDS, rows * (part + 1) // BANDS
        interpolate_band(*given, P[view], triangles[view], first, end, images[view])

    parallel_for(work, len(cameras) * BANDS)
    return image.to(device)
