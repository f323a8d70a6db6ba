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
    from viewmend.geometry._surface_numba import sum_face_normals

    sums = torch.zeros_like(mesh.vertices, device="cpu")
    sum_face_normals(mesh.vertices.cpu().numpy(), mesh.faces.cpu().numpy(), sums.numpy())
    return sums.to(mesh.vertices.device)
