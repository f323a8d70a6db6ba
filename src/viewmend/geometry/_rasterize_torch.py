"""The rasteriser in torch, for any device: all triangles at once, and a scatter that keeps the nearest."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.mesh import Mesh

CANDIDATES = 1 << 22
"""Pixels tested at once; bounds the memory."""


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


def rasterize_torch(
    mesh: Mesh, cameras: Cameras, near_m: float, cull: int
) -> tuple[Float[Tensor, "view height width"], Int[Tensor, "view height width"]]:
    """Depth and triangle id in every camera; the same answer as the numba kernel.

    `cull`: 0 none, 1 faces turned away, -1 faces turned to the camera.
    """
    width, height = cameras.max_size_px
    corners = homogeneous(mesh.vertices, cameras)[:, mesh.faces.long()]
    edges, determinant = edge_functions(corners)
    low, high = _pixel_boxes(corners, cameras.size_px, near_m)
    keep = (determinant != 0) & (determinant * cull <= 0) & (low <= high).all(-1)
    view, face = keep.nonzero(as_tuple=True)
    edges, determinant, low, high = edges[keep], determinant[keep], low[keep], high[keep]

    # The key orders by 1/z, then by the lower id: positive floats order like their bits.
    keys = torch.full((len(cameras) * height * width,), -1, dtype=torch.long, device=mesh.vertices.device)
    extent = high - low + 1
    ends = extent.prod(-1).cumsum(0)
    first = 0
    while first < len(ends):
        begin = int(ends[first - 1]) if first else 0
        last = max(first + 1, int(torch.searchsorted(ends, begin + CANDIDATES, right=True)))
        part = slice(first, last)
        owner, uv = _candidate_pixels(low[part], extent[part])
        inverse = _inverse_depth(edges[part][owner], determinant[part][owner], uv, near_m)
        hit = inverse > 0
        owner, uv = owner[hit] + first, uv[hit]
        key = (inverse[hit].view(torch.int32).long() << 32) | (0x7FFFFFFF - face[owner])
        keys.scatter_reduce_(0, (view[owner] * height + uv[:, 1]) * width + uv[:, 0], key, "amax")
        first = last

    keys = keys.view(len(cameras), height, width)
    triangle = torch.where(keys >= 0, 0x7FFFFFFF - (keys & 0x7FFFFFFF), -1).int()
    inverse = (keys >> 32).int().view(torch.float32)
    return torch.where(keys >= 0, 1 / inverse, 0.0), triangle


def _pixel_boxes(
    corners: Float[Tensor, "view face 3 3"], size_px: Int[Tensor, "view 2"], near_m: float
) -> tuple[Int[Tensor, "view face 2"], Int[Tensor, "view face 2"]]:
    """First and last pixel whose centre may be in each triangle; the whole image for one that crosses z = near."""
    z = corners[..., 2:]
    uv = corners[..., :2] / torch.where(z > near_m, z, torch.inf)
    crossing = (z <= near_m).any(2) & (z > near_m).any(2)
    image_end = size_px[:, None].double() - 1
    low = torch.where(crossing, 0, uv.amin(2) - 0.5).ceil().clamp(min=0).minimum(image_end + 1)
    high = torch.where(crossing, image_end, uv.amax(2) - 0.5).floor().clamp(min=-1).minimum(image_end)
    behind = (z <= near_m).all(2)
    return low.long(), torch.where(behind, -1, high).long()


def _candidate_pixels(
    low: Int[Tensor, "face 2"], extent: Int[Tensor, "face 2"]
) -> tuple[Int[Tensor, "candidate"], Int[Tensor, "candidate 2"]]:
    """Every pixel of every box, with the position of its box."""
    area = extent.prod(-1)
    owner = torch.repeat_interleave(torch.arange(len(area), device=area.device), area)
    within = torch.arange(len(owner), device=area.device) - (area.cumsum(0) - area)[owner]
    columns = extent[owner, 0]
    return owner, low[owner] + torch.stack([within % columns, within // columns], -1)


def _inverse_depth(
    edges: Float[Tensor, "candidate 3 3"],
    determinant: Float[Tensor, "candidate"],
    uv: Int[Tensor, "candidate 2"],
    near_m: float,
) -> Float[Tensor, "candidate"]:
    """1/z of the triangle at each pixel's centre, float32; -1 where the centre is outside it or z <= near."""
    u, v = (uv.double() + 0.5).unsqueeze(1).unbind(-1)
    value = edges[..., 0] * u + (edges[..., 1] * v + edges[..., 2])
    inside = (value * determinant.sign()[:, None] >= 0).all(-1)
    inverse = (value.sum(-1) / determinant).float()
    return torch.where(inside & (inverse * near_m < 1) & (inverse > 0), inverse, -1.0)
