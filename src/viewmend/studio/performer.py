"""Who stands on the studio's stage: anything that is a textured mesh at each moment."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.geometry.mesh import Mesh


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh with a texture atlas or several, in the stage's world: metres, y up, floor at y = 0, stage centre at 0."""

    mesh: Mesh
    normals: Float[Tensor, "vertex 3"]
    """Unit, outward."""
    uv: Float[Tensor, "vertex 2"]
    """Texture coordinates in [0, 1]: (0, 0) is the corner of the texture's top-left texel (as in glTF)."""
    texture_of_face: Int[Tensor, "face"]
    textures: tuple[Float[Tensor, "3 _ _"], ...]
    """sRGB colours in [0, 1]; the sizes may differ."""

    def to(self, device: torch.device | str) -> "TexturedMesh":
        """The same mesh on `device`; its textures stay where they are, since their pyramid moves."""
        normals, uv, texture = (t.to(device) for t in (self.normals, self.uv, self.texture_of_face))
        return TexturedMesh(self.mesh.to(device), normals, uv, texture, self.textures)


@runtime_checkable
class Performer(Protocol):
    """A person, or several with their props, in motion."""

    @property
    def description(self) -> str:
        """One line for logs and contact sheets: who, in what, doing what."""
        ...

    def pose(self, time_s: float) -> TexturedMesh:
        """The performer at this time; a deterministic function of time."""
        ...
