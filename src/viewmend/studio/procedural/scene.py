"""Several posed meshes as one."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from viewmend.geometry.mesh import Mesh
from viewmend.studio.performer import TexturedMesh
from viewmend.studio.procedural.patches import BoundMesh
from viewmend.studio.procedural.person import ProceduralPerson


def merge(parts: Sequence[TexturedMesh]) -> TexturedMesh:
    """All parts in one mesh; their textures stay separate."""
    vertices, faces, textures, first, layer = [], [], [], 0, 0
    for part in parts:
        vertices.append(part.mesh.vertices)
        faces.append(part.mesh.faces + first)
        textures.append(part.texture_of_face + layer)
        first, layer = first + len(part.mesh.vertices), layer + len(part.textures)
    return TexturedMesh(
        Mesh(torch.cat(vertices), torch.cat(faces)),
        torch.cat([part.normals for part in parts]),
        torch.cat([part.uv for part in parts]),
        torch.cat(textures),
        tuple(texture for part in parts for texture in part.textures),
    )


def still(bound: BoundMesh) -> TexturedMesh:
    """A mesh that stays in its bind pose: what stands on the floor."""
    texture = torch.zeros(len(bound.mesh.faces), dtype=torch.int64)
    return TexturedMesh(bound.mesh, bound.normals, bound.uv, texture, (bound.atlas,))


@dataclass(frozen=True)
class ProceduralPerformer:
    """One or two people and what stands around them. `pose` keeps nothing between calls."""

    people: tuple[ProceduralPerson, ...]
    things: TexturedMesh | None
    description: str

    def pose(self, time_s: float) -> TexturedMesh:
        """All of them at this time, in seconds."""
        parts = [person.pose(time_s) for person in self.people]
        if self.things is not None:
            parts.append(self.things)
        return parts[0] if len(parts) == 1 else merge(parts)
