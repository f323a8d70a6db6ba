"""Performers of the studio: a textured mesh at each moment, and its textures, prepared for drawing."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.geometry.mesh import Mesh
from viewmend.utils.srgb import linear_from_srgb


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


@dataclass(frozen=True)
class BoundMesh:
    """A mesh in its bind pose, and the joints that move it."""

    rest: TexturedMesh
    joints: Int[Tensor, "vertex 4"]
    """An unused slot has weight zero and any valid joint."""
    weights: Float[Tensor, "vertex 4"]
    """They sum to one per vertex."""

    def skin(self, world_from_bind: Float[Tensor, "joint 4 4"]) -> TexturedMesh:
        """Skin the mesh: the sum over slots of weight * (world_from_bind[joint] vertex), in world metres.

        `world_from_bind` is what glTF calls jointMatrix: the joint's pose times its inverse bind
        matrix. The normals are turned by the same blend and of unit length; vertices that coincide
        and share a normal keep sharing it.
        """
        rows = world_from_bind[:, :3].reshape(-1, 12)
        # A bag of four rows per vertex: ten times as fast on a CPU as gathers and a weighted sum.
        bags = torch.nn.functional.embedding_bag(
            self.joints.long(), rows, per_sample_weights=self.weights, mode="sum"
        )
        a, b, c, moved = bags.unflatten(1, (3, 4)).unbind(-1)

        def rotate(vectors: Float[Tensor, "vertex 3"]) -> Float[Tensor, "vertex 3"]:
            x, y, z = vectors[:, :, None].unbind(1)
            return torch.addcmul(torch.addcmul(a * x, b, y), c, z)

        mesh = Mesh(rotate(self.rest.mesh.vertices) + moved, self.rest.mesh.faces)
        return replace(
            self.rest, mesh=mesh, normals=torch.nn.functional.normalize(rotate(self.rest.normals), dim=-1)
        )


@dataclass(frozen=True)
class TexturePyramid:
    """Mipmaps of several textures: level l of texture t is `size[t, l]` texels from `first[t, l]` on."""

    texels: Float[Tensor, "texel 3"]
    """Linear light."""
    first: Int[Tensor, "texture level"]
    size: Int[Tensor, "texture level 2"]
    """Width and height. A texture with fewer levels repeats its last."""


def texture_pyramid(textures: Sequence[Float[Tensor, "3 _ _"]]) -> TexturePyramid:
    """Prepare sRGB textures of any sizes; costs about 50 ms for 1024 x 1024, so keep the result."""
    pyramids: list[list[Tensor]] = []
    for texture in textures:
        levels = [linear_from_srgb(texture)]
        while max(levels[-1].shape[1:]) > 1:
            half_height, half_width = (max(1, side // 2) for side in levels[-1].shape[1:])
            levels.append(torch.nn.functional.adaptive_avg_pool2d(levels[-1], (half_height, half_width)))
        pyramids.append(levels)
    texels = [level.flatten(1).T for levels in pyramids for level in levels]
    starts = itertools.accumulate(map(len, texels), initial=0)
    first = [[next(starts) for _ in levels] for levels in pyramids]
    size = [[level.shape[:0:-1] for level in levels] for levels in pyramids]
    depth = max(map(len, pyramids))
    return TexturePyramid(
        torch.cat(texels).contiguous(),
        *(torch.tensor([row + row[-1:] * (depth - len(row)) for row in table]) for table in (first, size)),
    )
