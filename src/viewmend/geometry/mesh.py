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
