"""Other clothes for a photo-textured character: dyed, or of another cloth, with the folds of its own."""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.studio.garments import Garments, find_garments, rest_body
from viewmend.studio.gltf import Character
from viewmend.studio.procedural.fabric import QUIET, WORDS, Canvas, Fabric, sample_fabric, write

CHART = Canvas(1.4, 1.65, 250.0)
"""One cloth, flat: around the trunk with 0 in front, and from the soles to the collar."""
CHEST_M = 1.22
"""Height of lettering."""
FOLDS = 0.12
"""Added to lightness before the ratio that folds are: black cloth would be all noise."""
_DYED = 0.3
"""Share of garments that are dyed instead of replaced; shoes always are."""
_ONE_PIECE = 0.4
"""Share of overalls that stay in one piece; the others become a top and trousers."""
_LETTERED = 0.4
_GRAY = np.array([0.299, 0.587, 0.114], np.float32)


def vary_cloth(character: Character, upright_from_file: Float[Tensor, "4 4"], variety: float, seed: int) -> Character:
    """The character in other clothes; its skin, hair and eyes stay as they are, bit for bit.

    Each garment is found by its colour (see `garments`), and with a chance of `variety` either dyed (its own pattern in
    other hues) or replaced by a seeded cloth: plain, striped, checked, printed or lettered, under the garment's folds.

    Args:
        character: with photographs of clothes as textures.
        upright_from_file: brings its rest pose upright (`Retarget.upright_from_file`).
        variety: 0 leaves it as it is, 1 changes every garment.
        seed: of the clothes.

    Raises:
        ValueError: `variety` is not in [0, 1], or the skeleton is no human one.
    """
    if not 0 <= variety <= 1:
        raise ValueError(f"expected a variety of cloth from 0 to 1, got {variety}; it is the share that changes")
    if variety == 0:
        return character
    rng = np.random.default_rng([seed, 31])
    found = find_garments(character, rest_body(character, upright_from_file))
    textures = [
        texture if garments is None else _dressed(texture, garments, variety, rng)
        for texture, garments in zip(character.textures, found, strict=True)
    ]
    return replace(character, textures=tuple(textures))


def _dressed(
    texture: Float[Tensor, "3 height width"], garments: Garments, variety: float, rng: np.random.Generator
) -> Float[Tensor, "3 height width"]:
    image = cv2.merge(list(texture.numpy()))
    seeds: dict[int, int] = {}
    for n, (dress, shoe) in enumerate(zip(garments.dress, garments.shoes, strict=True)):
        changes, seed = rng.random() < variety, int(rng.integers(2**31))
        # The halves of an overall: the second takes the seed of the first.
        seed = seeds[dress] if not shoe and dress in seeds and rng.random() < _ONE_PIECE else seed
        seeds[dress] = seed
        if changes:
            _dress(image, garments, n, np.random.default_rng(seed))
    return torch.from_numpy(np.stack(cv2.split(image)))


def _dress(image: Float[np.ndarray, "height width 3"], garments: Garments, n: int, rng: np.random.Generator) -> None:
    """Change one garment of a texture, in place."""
    half = _window(garments.cover[n])
    # Half a texture's odd last row or column stays as it is.
    full = tuple(slice(2 * s.start, 2 * s.stop) for s in half)
    own, size = image[full], tuple(2 * (s.stop - s.start) for s in reversed(half))

    def at_full_size(values: np.ndarray) -> np.ndarray:
        return cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)

    # Bilinear edges are soft, and would reach half a texel into hands and neck.
    bare = cv2.resize(garments.bare[half].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    cover = np.where(bare, 0, at_full_size(garments.cover[n][half]))[..., None]
    if garments.shoes[n] or rng.random() < _DYED:
        new = _dyed(own, rng)
    else:
        color = at_full_size(_colors(garments, n, half, rng))
        new = np.clip(color * _folds(own, cover[..., 0], at_full_size(garments.shown[half].astype(np.float32))), 0, 1)
    own += cover * (new - own)


def _window(cover: Float[np.ndarray, "height width"]) -> tuple[slice, slice]:
    """Rows and columns that hold all of a garment."""
    rows, columns = (np.flatnonzero(cover.any(axis)) for axis in (1, 0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _dyed(own: Float[np.ndarray, "height width 3"], rng: np.random.Generator) -> Float[np.ndarray, "height width 3"]:
    """Hues turned, colours stronger or paler, lighter or darker, and tinted: what is grey takes a colour, too."""
    turn, strength, gain = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 1.2), np.exp(rng.uniform(-0.35, 0.45))
    axis = np.full(3, 3**-0.5)
    across = np.cross(np.eye(3), axis)
    rotation = np.cos(turn) * np.eye(3) + np.sin(turn) * across + (1 - np.cos(turn)) * np.outer(axis, axis)
    gray = np.tile(_GRAY.astype(np.float64), (3, 1))
    tint = np.exp(rng.normal(0, 0.2, 3))
    matrix = gain * np.diag(tint / (_GRAY @ tint)) @ (gray + strength * rotation @ (np.eye(3) - gray))
    return np.clip(cv2.transform(own, matrix.astype(np.float32)), 0, 1)


def _colors(
    garments: Garments, n: int, window: tuple[slice, slice], rng: np.random.Generator
) -> Float[np.ndarray, "height width 3"]:
    """Another cloth on the garment's window, without folds; beside what faces show its mean around there."""
    chart = _chart(sample_fabric(rng), rng)
    column = (garments.around_m[window] + CHART.width_m / 2) * CHART.px_per_m - 0.5
    row = (CHART.height_m - garments.along_m[window]) * CHART.px_per_m - 0.5
    color = cv2.remap(chart, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT).astype(np.float32) / 255
    shown, part = garments.shown[window], garments.cover[n][window] > 0
    known = (shown & part).astype(np.float32)
    # Wide enough for the margin of any cover (`garments.MARGIN_PX`).
    mean = cv2.blur(color * known[..., None], (13, 13)) / np.maximum(cv2.blur(known, (13, 13)), 1e-4)[..., None]
    return np.where((known > 0)[..., None], color, mean)


def _chart(fabric: Fabric, rng: np.random.Generator) -> UInt8[np.ndarray, "height width 3"]:
    """The cloth on its chart, perhaps with a word across the chest."""
    image = fabric.paint(CHART)
    if fabric.kind in QUIET and rng.random() < _LETTERED:
        word = WORDS[int(rng.integers(len(WORDS)))]
        image = write(image, CHART, word, fabric.colors[2], (0.0, CHEST_M), rng.uniform(0.2, 0.3))
    return (255 * image).astype(np.uint8)


def _folds(
    own: Float[np.ndarray, "height width 3"],
    cover: Float[np.ndarray, "height width"],
    shown: Float[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width 1"]:
    """Light and dark of a garment, about 1; 1 beside what faces show."""
    gray = cv2.transform(own, _GRAY[None])
    weight = cover * shown
    mean = float((gray * weight).sum() / max(float(weight.sum()), 1e-6))
    shade = np.clip((gray + FOLDS) / (mean + FOLDS), 0.45, 1.6)
    return (1 + shown * (shade - 1))[..., None]
