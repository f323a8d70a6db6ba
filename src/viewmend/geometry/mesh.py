"""A triangle mesh."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.utils.tensors import OnDevice


@dataclass(frozen=True)
class Mesh(OnDevice):
    """Triangles in world coordinates (metres); seen from outside, their corners run counter-clockwise."""

    vertices: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]


def simplify(mesh: Mesh, cell_m: float) -> Mesh:
    """The mesh with one vertex, their mean, for all in a cube of this side, metres.

    Faces within a cube vanish.
    """
    if not len(mesh.vertices):
        return mesh
    cells = (mesh.vertices / cell_m).floor().long()
    _, merged = torch.unique(cells, dim=0, return_inverse=True)
    count = int(merged.max()) + 1
    sums = torch.zeros(count, 3, dtype=torch.float64, device=merged.device).index_add_(
        0, merged, mesh.vertices.double()
    )
    means = sums / merged.bincount(minlength=count)[:, None]
    faces = merged[mesh.faces.long()]
    a, b, c = faces.unbind(1)
    kept = faces[(a != b) & (b != c) & (c != a)]
    return Mesh(means.to(mesh.vertices), kept.to(mesh.faces))


def vertex_normals(mesh: Mesh) -> Float[Tensor, "vertex 3"]:
    """Unit normals at the vertices, outward: the area-weighted mean of the faces around each (zero where none)."""
    if mesh.vertices.device.type == "cpu" and not mesh.vertices.requires_grad:
        from viewmend.geometry._surface_numba import sum_face_normals

        sums = torch.zeros_like(mesh.vertices)
        sum_face_normals(mesh.vertices.numpy(), mesh.faces.numpy(), sums.numpy())
        return sums
    a, b, c = mesh.vertices[mesh.faces.long()].unbind(1)
    face_normals = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(mesh.vertices)
    for corner in range(3):
        normals.index_add_(0, mesh.faces[:, corner].long(), face_normals)
    return torch.nn.functional.normalize(normals, dim=-1)
