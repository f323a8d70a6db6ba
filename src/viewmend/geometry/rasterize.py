"""Drawing a triangle mesh into cameras: depth, triangle ids, and interpolated attributes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, pixel_centers
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.threads import one_thread, parallel_for

NEAR_M = 1e-6
"""A surface nearer than this, in metres, is not drawn."""

BANDS = 4
"""A view is divided into this many horizontal strips for the threads, if there are fewer views than this."""

CANDIDATES = 1 << 22
"""The rasteriser in torch tests at most this many pixels at once, which bounds its memory."""

EMPTY = -1
"""The rasteriser in torch gives this key to pixels without a surface."""
FACE_BITS = 0x7FFFFFFF
"""These bits of a key hold the index of its face, subtracted from `LAST_FACE`."""
LAST_FACE = FACE_BITS - 1
"""Indices of faces are at most this, so that those of `EMPTY` mean -1."""


@dataclass(frozen=True)
class Raster:
    """Depth and triangle at each pixel centre."""

    depth: Float[Tensor, "view height width"]
    """z-depth in metres, 0 where there is no surface."""
    triangle: Int[Tensor, "view height width"]
    """Index into the mesh's faces (int32), -1 where there is no surface."""


@one_thread()
def rasterize(mesh: Mesh, cameras: Cameras, cull: Literal["none", "back", "front"] = "none") -> Raster:
    """Draw `mesh` into every camera, images of `cameras.max_size_px`; nothing is drawn beyond a view's own size.

    A pixel is covered if its centre is in a triangle (edges included: no cracks); the nearest
    surface wins, and of equally near ones the lower index. What is behind a camera draws nothing.
    Depth is perspective-correct.

    Args:
        mesh: triangles in the world; numba draws them on the CPU, torch elsewhere.
        cameras: on the mesh's device.
        cull: "back" leaves out the faces whose corners run clockwise in the image, "front" the others.
    """
    side = {"none": 0, "back": 1, "front": -1}[cull]
    if mesh.vertices.device.type != "cpu":
        return rasterize_torch(mesh, cameras, side)
    from viewmend.geometry import _rasterize_numba as kernels

    width, height = cameras.max_size_px
    views = len(cameras)
    vertices = mesh.vertices.detach().numpy()
    faces = mesh.faces.numpy()
    P = cameras.projection.detach().numpy()
    size = cameras.size_px.tolist()
    projected = torch.empty(views, len(vertices), 5, dtype=torch.float64).numpy()
    raster = Raster(
        depth=torch.zeros(views, height, width),
        triangle=torch.full((views, height, width), -1, dtype=torch.int32),
    )
    depths = raster.depth.numpy()
    triangles = raster.triangle.numpy()
    bands = 1 if views >= BANDS else BANDS

    def draw(item: int) -> None:
        view, band = divmod(item, bands)
        columns, rows = size[view]
        first = rows * band // bands
        end = rows * (band + 1) // bands
        kernels.draw_band(
            projected[view], faces, NEAR_M, side, first, end, columns, depths[view], triangles[view]
        )

    parallel_for(lambda view: kernels.project_vertices(vertices, P[view], projected[view]), views)
    parallel_for(draw, views * bands)
    return raster


def interpolate(
    attributes: Float[Tensor, "vertex channel"], mesh: Mesh, cameras: Cameras, raster: Raster
) -> Float[Tensor, "view height width channel"]:
    """Vertex attributes at every pixel of `raster`, perspective-correct; zeros where there is no surface."""
    if attributes.device.type == "cpu" and not (attributes.requires_grad or mesh.vertices.requires_grad):
        return _interpolate_cpu(attributes, mesh, cameras, raster)
    views, height, width = raster.triangle.shape
    if not len(mesh.faces):
        return attributes.new_zeros(views, height, width, attributes.shape[1])
    # all pixels, those without a surface with any triangle: to find the others would wait for the device
    covered = raster.triangle >= 0
    corners = mesh.faces[raster.triangle.clamp(min=0).long()].long()
    view = torch.arange(views, device=corners.device)[:, None, None, None]
    edges = edge_functions(homogeneous(mesh.vertices, cameras)[view, corners])
    uv1 = F.pad(pixel_centers(width, height, corners.device), (0, 1), value=1.0).double()
    values = (edges @ uv1[..., None])[..., 0]
    total = values.sum(-1, keepdim=True).masked_fill(~covered[..., None], 1.0)
    weights = (values / total).to(attributes)
    return (weights[..., None, :] @ attributes[corners])[..., 0, :] * covered[..., None]


def _interpolate_cpu(attributes, mesh: Mesh, cameras: Cameras, raster: Raster):
    from viewmend.geometry._rasterize_numba import interpolate_band

    image = attributes.new_zeros(*raster.triangle.shape, attributes.shape[1])
    P = cameras.projection.numpy()
    given = (attributes.numpy(), mesh.vertices.numpy(), mesh.faces.numpy())
    triangles = raster.triangle.numpy()
    images = image.numpy()
    rows = image.shape[1]

    def work(item: int) -> None:
        view, part = divmod(item, BANDS)
        first = rows * part // BANDS
        end = rows * (part + 1) // BANDS
        interpolate_band(*given, P[view], triangles[view], first, end, images[view])

    parallel_for(work, len(cameras) * BANDS)
    return image


def homogeneous(vertices: Float[Tensor, "vertex 3"], cameras: Cameras) -> Float[Tensor, "view vertex 3"]:
    """P X of every vertex in every camera, in float64: (u z, v z, z) with u, v in pixels."""
    P = cameras.projection
    return torch.einsum("vij,nj->vni", P[:, :, :3], vertices.double()) + P[:, None, :, 3]


def edge_functions(corners: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Edge i of each triangle as the plane q_j x q_k over (u, v, 1); corner by corner in dim -2."""
    return torch.linalg.cross(corners.roll(-1, -2), corners.roll(-2, -2))


def rasterize_torch(mesh: Mesh, cameras: Cameras, cull: int) -> Raster:
    """Depth and triangle id in every camera; the same answer as the numba kernel.

    `cull`: 0 none, 1 faces turned away, -1 faces turned to the camera.
    """
    width, height = cameras.max_size_px
    corners = homogeneous(mesh.vertices, cameras)[:, mesh.faces.long()]
    edges = edge_functions(corners)
    determinant = (corners[..., 0, :] * edges[..., 0, :]).sum(-1)
    low, high = _pixel_boxes(corners, cameras.size_px)

    # Every triangle of every view has a box of pixels. Only the total number of pixels is read from
    # the device. Edges become weights of the corners, which are 1/z at the corners' own pixels.
    keep = (low <= high).all(-1) & (determinant * cull <= 0)
    extent = ((high - low + 1) * keep[..., None]).flatten(0, 1)
    low = low.flatten(0, 1)
    weights = (edges / determinant[..., None, None]).flatten(0, 1)
    area = extent.prod(-1)
    ends = area.cumsum(0)

    # The key orders by 1/z, then by the lower id: positive floats order like their bits.
    keys = torch.full((len(cameras) * height * width,), EMPTY, dtype=torch.long, device=ends.device)
    for part, pixels in _portions(ends):
        box, uv = _candidate_pixels(low[part], extent[part], area[part], pixels)
        inverse, visible = _inverse_depth(weights[part][box], uv)
        box = box + part.start
        key = (inverse.view(torch.int32).long() << 32) | (LAST_FACE - box % len(mesh.faces))
        key = key.masked_fill(~visible, EMPTY)
        # box // len(mesh.faces) is the view
        keys.scatter_reduce_(0, (box // len(mesh.faces) * height + uv[:, 1]) * width + uv[:, 0], key, "amax")

    return _unpack_keys(keys.view(len(cameras), height, width))


def _unpack_keys(keys: Int[Tensor, "view height width"]) -> Raster:
    """Depth and triangle of each pixel from its key. `EMPTY` becomes triangle -1, and its upper half is NaN."""
    triangle = (LAST_FACE - (keys & FACE_BITS)).int()
    inverse = (keys >> 32).int().view(torch.float32)
    return Raster(inverse.reciprocal().nan_to_num(0.0), triangle)


def _portions(ends: Int[Tensor, "box"]) -> Iterator[tuple[slice, int]]:
    """Boxes whose pixels are drawn at once, at most about `CANDIDATES`, and how many pixels they have.

    `ends` counts the pixels up to the end of each box. One portion, if that is enough, waits for
    the device only once.
    """
    total = int(ends[-1]) if len(ends) else 0
    if total <= CANDIDATES:
        if total:
            yield slice(0, len(ends)), total
        return
    on_host = ends.cpu()
    first = 0
    while first < len(ends):
        begin = int(on_host[first - 1]) if first else 0
        last = max(first + 1, int(torch.searchsorted(on_host, begin + CANDIDATES, right=True)))
        pixels = int(on_host[last - 1]) - begin
        if pixels:
            yield slice(first, last), pixels
        first = last


def _pixel_boxes(
    corners: Float[Tensor, "view face 3 3"], size_px: Int[Tensor, "view 2"]
) -> tuple[Int[Tensor, "view face 2"], Int[Tensor, "view face 2"]]:
    """First and last pixel whose centre may be in each triangle; the whole image for one that crosses z = near."""
    in_front = (corners[..., 2] > NEAR_M).sum(-1)[..., None]
    crossing = in_front < 3
    uv = corners[..., :2] / corners[..., 2:].clamp_min(NEAR_M)
    first, last = uv.aminmax(dim=2)
    image_end = size_px[:, None].double() - 1
    low = (first - 0.5).ceil().clamp_min(0)
    high = (last - 0.5).floor().minimum(image_end)
    low = low.masked_fill(crossing, 0)
    high = torch.where(crossing, image_end, high).masked_fill(in_front == 0, -1)
    return low.long(), high.long()


def _candidate_pixels(
    low: Int[Tensor, "box 2"], extent: Int[Tensor, "box 2"], area: Int[Tensor, "box"], pixels: int
) -> tuple[Int[Tensor, "candidate"], Int[Tensor, "candidate 2"]]:
    """Every pixel of every box, with the index of its box; there are `pixels` of them."""
    box = torch.repeat_interleave(area, output_size=pixels)
    first = area.cumsum(0) - area
    within = torch.arange(pixels, device=area.device) - first[box]
    columns = extent[box, 0]
    return box, low[box] + torch.stack([within % columns, within // columns], -1)


def _inverse_depth(
    weights: Float[Tensor, "candidate 3 3"], uv: Int[Tensor, "candidate 2"]
) -> tuple[Float[Tensor, "candidate"], Bool[Tensor, "candidate"]]:
    """1/z of the triangle at each pixel's centre, float32, and whether the centre is inside it and z > near.

    `weights` are the triangle's edges, divided by its determinant; not finite for one without an area.
    """
    u, v = (uv + 0.5).unsqueeze(1).unbind(-1)
    value = weights[..., 0] * u + (weights[..., 1] * v + weights[..., 2])
    inverse = value.sum(-1).float()
    return inverse, (value >= 0).all(-1) & (inverse > 0) & (inverse * NEAR_M < 1)
