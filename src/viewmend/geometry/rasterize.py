"""Drawing a triangle mesh into cameras: depth, triangle ids, and interpolated attributes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras
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
FIRST_FACE = -2
"""The lower half of a key is this, minus the index of its face: that of `EMPTY` means -1."""


@dataclass(frozen=True)
class Raster:
    """Depth and triangle at each pixel centre."""

    depth: Float[Tensor, "view height width"]
    """z-depth in metres, 0 where there is no surface."""
    triangle: Int[Tensor, "view height width"]
    """Index into the mesh's faces (int32), -1 where there is no surface."""
    planes: Float[Tensor, "view face 3 3"] | None = None
    """The `corner_planes` of all faces, if the rasteriser in torch has computed them."""


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
    planes = raster.planes
    if planes is None:
        planes, _ = corner_planes(homogeneous(mesh.vertices, cameras)[:, mesh.faces.long()])

    # the attributes and 1, all divided by z, are planes over each triangle
    of_vertices = F.pad(attributes, (0, 1), value=1.0).double()
    over_z = of_vertices[mesh.faces.long()].mT @ planes

    # all pixels, those without a surface with any triangle: to find the others would wait for the device
    view = torch.arange(views, device=planes.device)[:, None, None]
    across, down, start = over_z[view, raster.triangle.clamp(min=0).long()].unbind(-1)
    u = torch.arange(0.5, width, dtype=torch.double, device=planes.device)[:, None]
    v = torch.arange(0.5, height, dtype=torch.double, device=planes.device)[:, None, None]
    values = torch.addcmul(torch.addcmul(start, down, v), across, u)
    found = (values[..., :-1] / values[..., -1:]).to(attributes)
    return found.masked_fill((raster.triangle < 0)[..., None], 0.0)


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
    return torch.baddbmm(P[:, None, :, 3], vertices.double().expand(len(P), -1, -1), P[:, :, :3].mT)


def corner_planes(
    corners: Float[Tensor, "*face 3 3"],
) -> tuple[Float[Tensor, "*face 3 3"], Float[Tensor, "*face"]]:
    """The weight of each corner over its triangle, divided by z, as a plane over (u, v, 1); and the determinants.

    The corners q are homogeneous. A triangle without an area has a determinant of 0, and planes that are not finite.
    """
    around = torch.cat([corners, corners[..., :2, :]], -2)
    edges = torch.linalg.cross(around[..., 1:4, :], around[..., 2:5, :])  # edge i is q_j x q_k
    determinant = (corners[..., 0, :] * edges[..., 0, :]).sum(-1)
    return edges / determinant[..., None, None], determinant


def rasterize_torch(mesh: Mesh, cameras: Cameras, cull: int) -> Raster:
    """Depth and triangle id in every camera; the same answer as the numba kernel.

    `cull`: 0 none, 1 faces turned away, -1 faces turned to the camera.
    """
    width, height = cameras.max_size_px
    views = len(cameras)
    corners = homogeneous(mesh.vertices, cameras)[:, mesh.faces.long()]
    planes, determinant = corner_planes(corners)
    low, extent = _pixel_boxes(corners, cameras.size_px)
    if cull:
        extent = extent * (determinant * cull <= 0)[..., None]

    # Every triangle of every view has a box of pixels. Only the total number of pixels is read from the device
    area = extent.prod(-1).flatten()
    ends = area.cumsum(0)
    boxes = _box_table(low, extent, ends - area, width * height)

    keys = torch.full((views * height * width,), EMPTY, dtype=torch.long, device=ends.device)
    for part, begin, pixels in _portions(ends):
        box = torch.repeat_interleave(area[part], output_size=pixels)
        _draw(keys, boxes[part][box], planes.flatten(0, 1)[part][box], begin, width)

    depth, triangle = _unpack_keys(keys.view(views, height, width))
    return Raster(depth, triangle, planes)


def _box_table(
    low: Int[Tensor, "view face 2"],
    extent: Int[Tensor, "view face 2"],
    first: Int[Tensor, "box"],
    image_px: int,
) -> Int[Tensor, "box 6"]:
    """The boxes of all triangles, view by view, as `_candidate_pixels` reads them.

    Args:
        low: first column and row of each box.
        extent: numbers of its columns and rows.
        first: its first candidate.
        image_px: pixels of an image.
    """
    views, faces = extent.shape[:2]
    half_key = torch.arange(FIRST_FACE, FIRST_FACE - faces, -1, device=low.device).expand(views, -1)
    of_view = torch.arange(0, views * image_px, image_px, device=low.device)[:, None].expand(-1, faces)
    columns = [first.view(views, faces), extent[..., 0], half_key, of_view]
    return torch.cat([torch.stack(columns, -1), low], -1).flatten(0, 1)


def _draw(
    keys: Int[Tensor, "pixel"],
    boxes: Int[Tensor, "candidate 6"],
    planes: Float[Tensor, "candidate 3 3"],
    begin: int,
    width: int,
) -> None:
    """Write the keys of candidates, of which `begin` is the first, into images of this width, unless others are larger.

    A key holds 1/z and the face; it orders by 1/z, then by the lower face, since positive floats order like
    their bits.
    """
    face, pixel, uv = _candidate_pixels(boxes, begin, width)
    inverse = _inverse_depth(planes, uv)
    key = torch.stack([face.int(), inverse.view(torch.int32)], -1).view(torch.long)[:, 0]
    keys.scatter_reduce_(0, pixel, key, "amax")


def _unpack_keys(
    keys: Int[Tensor, "view height width"],
) -> tuple[Float[Tensor, "view height width"], Int[Tensor, "view height width"]]:
    """Depth and triangle of each pixel from its key. `EMPTY` becomes triangle -1, and its upper half is NaN."""
    face, inverse = keys.view(torch.int32).unflatten(-1, (-1, 2)).unbind(-1)
    return inverse.view(torch.float32).reciprocal().nan_to_num(0.0), FIRST_FACE - face


def _portions(ends: Int[Tensor, "box"]) -> Iterator[tuple[slice, int, int]]:
    """Boxes whose pixels are drawn at once, at most about `CANDIDATES`, their first pixel and how many they have.

    `ends` counts the pixels up to the end of each box. One portion, if that is enough, waits for
    the device only once.
    """
    total = int(ends[-1]) if len(ends) else 0
    if total <= CANDIDATES:
        if total:
            yield slice(0, len(ends)), 0, total
        return
    on_host = ends.cpu()
    first = 0
    while first < len(ends):
        begin = int(on_host[first - 1]) if first else 0
        last = max(first + 1, int(torch.searchsorted(on_host, begin + CANDIDATES, right=True)))
        pixels = int(on_host[last - 1]) - begin
        if pixels:
            yield slice(first, last), begin, pixels
        first = last


def _pixel_boxes(
    corners: Float[Tensor, "view face 3 3"], size_px: Int[Tensor, "view 2"]
) -> tuple[Int[Tensor, "view face 2"], Int[Tensor, "view face 2"]]:
    """First pixel and numbers of columns and rows of those whose centres may be in each triangle.

    That is the whole image for a triangle that crosses z = near, and no pixel for one behind it.
    """
    nearest_m, farthest_m = corners[..., 2].aminmax(dim=2, keepdim=True)
    crossing = nearest_m <= NEAR_M
    uv = corners[..., :2] / corners[..., 2:].clamp_min(NEAR_M)
    first, last = uv.aminmax(dim=2)
    image_end = size_px[:, None]
    low = (first - 0.5).ceil().clamp_min(0).masked_fill(crossing, 0)
    end = torch.where(crossing, image_end, (last + 0.5).floor().minimum(image_end))
    extent = (end - low).clamp_min(0).masked_fill(farthest_m <= NEAR_M, 0)
    return low.long(), extent.long()


def _candidate_pixels(
    boxes: Int[Tensor, "candidate 6"], begin: int, width: int
) -> tuple[Int[Tensor, "candidate"], Int[Tensor, "candidate"], Int[Tensor, "candidate 2"]]:
    """Half a key, index in all images, and column and row, of every pixel of every box.

    Args:
        boxes: each candidate's box: its first candidate, its number of columns, its half of the key, the
            first pixel of its view, and its own first column and row.
        begin: the first of these candidates.
        width: of the images, pixels.
    """
    first, columns, face, of_view, *_ = boxes.unbind(1)
    within = torch.arange(begin, begin + len(boxes), device=boxes.device) - first
    uv = boxes[:, 4:] + torch.stack([within % columns, within // columns], -1)
    return face, of_view + uv[:, 1] * width + uv[:, 0], uv


def _inverse_depth(
    planes: Float[Tensor, "candidate 3 3"], uv: Int[Tensor, "candidate 2"]
) -> Float[Tensor, "candidate"]:
    """1/z of the triangle at each pixel's centre, float32; below 0 if the centre is not inside it, or z is too small.

    `planes` are the `corner_planes` of the triangle.
    """
    u, v = (uv + 0.5).unsqueeze(1).unbind(-1)
    across, down, start = planes.unbind(-1)
    value = torch.addcmul(torch.addcmul(start, down, v), across, u)
    inverse = value.sum(-1).float()
    in_range = inverse.clamp(torch.finfo(inverse.dtype).tiny, 1 / NEAR_M)
    hidden = (value < 0).any(-1) | (inverse != in_range)  # nothing equals NaN, of a triangle without an area
    return inverse.masked_fill(hidden, -1.0)
