"""Who stands on the studio's stage: a textured mesh at each moment; and its textures, ready for drawing."""

from collections.abc import Sequence
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


def blend_transforms(
    joints: Int[Tensor, "vertex 4"], weights: Float[Tensor, "vertex 4"], world_from_bind: Float[Tensor, "joint 4 4"]
) -> Float[Tensor, "vertex 3 4"]:
    """Average each vertex' four joint transforms by weight: affine maps, given as their top three rows.

    Weights are expected to sum to one per vertex; an unused slot has weight zero and any valid joint index.
    """
    rows = world_from_bind[:, :3].reshape(-1, 12)
    # A bag of four rows per vertex: ten times as fast on a CPU as gathers and a weighted sum.
    bags = torch.nn.functional.embedding_bag(joints.long(), rows, per_sample_weights=weights, mode="sum")
    return bags.unflatten(1, (3, 4))


def _turned(transforms: Float[Tensor, "vertex 3 4"], vectors: Float[Tensor, "vertex 3"]) -> Float[Tensor, "vertex 3"]:
    a, b, c, _ = transforms.unbind(-1)
    x, y, z = vectors[:, :, None].unbind(1)
    return torch.addcmul(torch.addcmul(a * x, b, y), c, z)


def skin(
    vertices: Float[Tensor, "vertex 3"],
    joints: Int[Tensor, "vertex 4"],
    weights: Float[Tensor, "vertex 4"],
    world_from_bind: Float[Tensor, "joint 4 4"],
) -> Float[Tensor, "vertex 3"]:
    """Bind-pose vertices in the world: sum over slots of weight * (world_from_bind[joint] vertex), metres.

    `world_from_bind` is what glTF calls jointMatrix: the joint's pose times its inverse bind matrix.
    """
    transforms = blend_transforms(joints, weights, world_from_bind)
    return _turned(transforms, vertices) + transforms[:, :, 3]


def skin_with_normals(
    vertices: Float[Tensor, "vertex 3"],
    normals: Float[Tensor, "vertex 3"],
    joints: Int[Tensor, "vertex 4"],
    weights: Float[Tensor, "vertex 4"],
    world_from_bind: Float[Tensor, "joint 4 4"],
) -> tuple[Float[Tensor, "vertex 3"], Float[Tensor, "vertex 3"]]:
    """`skin`, and the bind-pose normals turned by the same blend, of unit length again.

    Seams of the texture stay invisible: vertices that coincide and share a normal keep sharing it.
    """
    transforms = blend_transforms(joints, weights, world_from_bind)
    skinned = _turned(transforms, vertices) + transforms[:, :, 3]
    return skinned, torch.nn.functional.normalize(_turned(transforms, normals), dim=-1)


@dataclass(frozen=True)
class TexturePyramid:
    """Several textures, each in halving sizes: level l of texture t is `size[t, l]` texels from `first[t, l]` on."""

    texels: Float[Tensor, "texel 3"]
    """Linear light."""
    first: Int[Tensor, "texture level"]
    size: Int[Tensor, "texture level 2"]
    """Width and height. A texture with fewer levels repeats its last."""


def linear_from_srgb(srgb: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Linear light of sRGB values in [0, 1]."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Encode as sRGB: values of linear light, clamped to [0, 1]."""
    linear = linear.clamp(0, 1)
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=1e-8) ** (1 / 2.4) - 0.055)


def texture_pyramid(textures: Sequence[Float[Tensor, "3 _ _"]]) -> TexturePyramid:
    """Prepare sRGB textures of any sizes; costs about 50 ms for 1024 x 1024, so keep the result."""
    texels: list[Tensor] = []
    first: list[list[int]] = []
    size: list[list[tuple[int, int]]] = []
    total = 0
    for texture in textures:
        level = linear_from_srgb(texture)
        first.append([])
        size.append([])
        while True:
            first[-1].append(total)
            size[-1].append((level.shape[2], level.shape[1]))
            texels.append(level.flatten(1).T)
            total += level.shape[1] * level.shape[2]
            if max(level.shape[1:]) == 1:
                break
            level = torch.nn.functional.adaptive_avg_pool2d(
                level, (max(1, level.shape[1] // 2), max(1, level.shape[2] // 2))
            )
    depth = max(len(f) for f in first)
    return TexturePyramid(
        torch.cat(texels).contiguous(),
        torch.tensor([f + f[-1:] * (depth - len(f)) for f in first]),
        torch.tensor([s + s[-1:] * (depth - len(s)) for s in size]),
    )
