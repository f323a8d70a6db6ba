"""Drawing a triangle mesh into cameras: depth, triangle ids, and interpolated attributes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.geometry.cameras import Cameras, pixel_centers
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.threads import one_thread, parallel_for

NEAR_M = 1e-6
"""A surface nearer than this, in metres, is not drawn."""

BANDS = 4
"""A view is divided into this many horizontal strips for the threads, if there are fewer views than this."""

CANDIDATES = 1 << 22
"""The rasteriser in torch tests at most this many pixels at once, which bounds its memory."""


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
    P = (cameras.K.double() @ cameras.camera_from_world[:, :3].double()).detach().numpy()
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
    image = attributes.new_zeros(*raster.triangle.shape, attributes.shape[1])
    if attributes.device.type == "cpu" and not (attributes.requires_grad or mesh.vertices.requires_grad):
        return _interpolate_cpu(attributes, mesh, cameras, raster, image)
    if not len(mesh.faces):
        return image
    # all pixels, those without a surface with any triangle: to find the others would wait for the device
    covered = raster.triangle >= 0
    corners = mesh.faces[raster.triangle.clamp(min=0).long()].long()
    view = torch.arange(len(cameras), device=image.device)[:, None, None, None]
    edges, _ = edge_functions(homogeneous(mesh.vertices, cameras)[view, corners])
    u, v = pixel_centers(image.shape[2], image.shape[1], image.device).double()[..., None, :].unbind(-1)
    values = edges[..., 0] * u + edges[..., 1] * v + edges[..., 2]
    total = torch.where(covered, values.sum(-1), 1.0)[..., None]
    weights = (values / total).to(mesh.vertices)
    colour = (attributes[corners] * weights[..., None].to(attributes)).sum(-2)
    return torch.where(covered[..., None], colour, 0.0)


def _interpolate_cpu(attributes, mesh: Mesh, cameras: Cameras, raster: Raster, image):
    from viewmend.geometry._rasterize_numba import interpolate_band

    P = (cameras.K.double() @ cameras.camera_from_world[:, :3].double()).numpy()
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
    P = cameras.K.double() @ cameras.camera_from_world[:, :3].double()
    return torch.einsum("vij,nj->vni", P[:, :, :3], vertices.double()) + P[:, None, :, 3]


def edge_functions(
    corners: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch"]]:
    """Edge i as the plane q_j x q_k over (u, v, 1), and the triangle's determinant; corner by corner in dim -2."""
    a, b, c = corners.unbind(-2)
    edges = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -2)
    return edges, (a * edges[..., 0, :]).sum(-1)


def rasterize_torch(mesh: Mesh, cameras: Cameras, cull: int) -> Raster:
    """Depth and triangle id in every camera; the same answer as the numba kernel.

    `cull`: 0 none, 1 faces turned away, -1 faces turned to the camera.
    """
    width, height = cameras.max_size_px
    device = mesh.vertices.device
    corners = homogeneous(mesh.vertices, cameras)[:, mesh.faces.long()]
    edges, determinant = edge_functions(corners)
    low, high = _pixel_boxes(corners, cameras.size_px)
    keep = (determinant != 0) & (determinant * cull <= 0) & (low <= high).all(-1)

    # Every triangle of every view has a box of pixels. Only the total number of pixels is read from
    # the device.
    view = torch.arange(len(cameras), device=device).repeat_interleave(
        len(mesh.faces), output_size=keep.numel()
    )
    face = torch.arange(len(mesh.faces), device=device).repeat(len(cameras))
    extent = torch.where(keep[..., None], high - low + 1, 0).flatten(0, 1)
    low = low.flatten(0, 1)
    edges = edges.flatten(0, 1)
    determinant = determinant.flatten()
    ends = extent.prod(-1).cumsum(0)

    # The key orders by 1/z, then by the lower id: positive floats order like their bits.
    keys = torch.full((len(cameras) * height * width,), -1, dtype=torch.long, device=device)
    for part, pixels in _portions(ends):
        owner, uv = _candidate_pixels(low[part], extent[part], pixels)
        inverse = _inverse_depth(edges[part][owner], determinant[part][owner], uv)
        owner = owner + part.start
        key = (inverse.view(torch.int32).long() << 32) | (0x7FFFFFFF - face[owner])
        key = torch.where(inverse > 0, key, -1)
        keys.scatter_reduce_(0, (view[owner] * height + uv[:, 1]) * width + uv[:, 0], key, "amax")

    return _unpack_keys(keys.view(len(cameras), height, width))


def _unpack_keys(keys: Int[Tensor, "view height width"]) -> Raster:
    """Depth and triangle of each pixel from its key; -1 is the key of an empty pixel."""
    triangle = torch.where(keys >= 0, 0x7FFFFFFF - (keys & 0x7FFFFFFF), -1).int()
    inverse = (keys >> 32).int().view(torch.float32)
    return Raster(torch.where(keys >= 0, 1 / inverse, 0.0), triangle)


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
    z = corners[..., 2:]
    image_end = size_px[:, None].double() - 1
    uv = corners[..., :2] / torch.where(z > NEAR_M, z, torch.inf)
    behind = z <= NEAR_M
    crossing = behind.any(2) & ~behind.all(2)
    low = torch.where(crossing, 0, uv.amin(2) - 0.5).ceil().clamp(min=0).minimum(image_end + 1)
    high = torch.where(crossing, image_end, uv.amax(2) - 0.5).floor().clamp(min=-1).minimum(image_end)
    return low.long(), torch.where(behind.all(2), -1, high).long()


def _candidate_pixels(
    low: Int[Tensor, "face 2"], extent: Int[Tensor, "face 2"], pixels: int
) -> tuple[Int[Tensor, "candidate"], Int[Tensor, "candidate 2"]]:
    """Every pixel of every box, with the position of its box; there are `pixels` of them."""
    area = extent.prod(-1)
    owner = torch.repeat_interleave(torch.arange(len(area), device=area.device), area, output_size=pixels)
    within = torch.arange(len(owner), device=area.device) - (area.cumsum(0) - area)[owner]
    columns = extent[owner, 0]
    return owner, low[owner] + torch.stack([within % columns, within // columns], -1)


def _inverse_depth(
    edges: Float[Tensor, "candidate 3 3"],
    determinant: Float[Tensor, "candidate"],
    uv: Int[Tensor, "candidate 2"],
) -> Float[Tensor, "candidate"]:
    """1/z of the triangle at each pixel's centre, float32; -1 where the centre is outside it or z <= near."""
    u, v = (uv.double() + 0.5).unsqueeze(1).unbind(-1)
    value = edges[..., 0] * u + (edges[..., 1] * v + edges[..., 2])
    inside = (value * determinant.sign()[:, None] >= 0).all(-1)
    inverse = (value.sum(-1) / determinant).float()
    return torch.where(inside & (inverse * NEAR_M < 1) & (inverse > 0), inverse, -1.0)
