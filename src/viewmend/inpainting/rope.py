"""Rotary embedding over the three axes u, v and s (section 6).

A head's channels are pairs; a pair belongs to one axis and turns by coordinate x frequency. Three eighths of the
pairs belong to u, three eighths to v and a quarter to s.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

LONGEST = 2.0
"""Image widths (or windows of time) in one turn of the slowest pair."""
SHORTEST = 0.1
"""The same of the fastest: two patch steps of a 320 pixel image."""
UNIT_STEPS = 20
"""Patch steps that count as one image width where coordinates are measured in patches."""
WAVE_STEPS = 2.5
"""Patch steps in one turn of the slowest wave of values: a patch and its surroundings, 40 pixels."""


def pairs_per_axis(head_dim: int) -> tuple[int, int, int]:
    """Pairs of channels that belong to u, v and s."""
    pairs = head_dim // 2
    return 3 * pairs // 8, 3 * pairs // 8, pairs - 2 * (3 * pairs // 8)


def score_frequencies(head_dim: int) -> Float[Tensor, "3 pair"]:
    """Radians per unit of (u, v, s) by which each pair turns: geometric on its axis, zero for the other axes."""
    return _frequencies(pairs_per_axis(head_dim), LONGEST, SHORTEST)


def value_frequencies(head_dim: int) -> Float[Tensor, "3 pair"]:
    """Radians per patch step of (u, v) for values: a constant, then plane waves from the longest on.

    Where a pair holds a wave's cosine and sine, its turn is the wave's shift: see `copying`.
    """
    pairs = head_dim // 2
    reach = range(-pairs, pairs + 1)
    half_plane = [(u, v) for u in reach for v in reach if u > 0 or (u == 0 and v >= 0)]
    waves = sorted(half_plane, key=lambda wave: (wave[0] ** 2 + wave[1] ** 2, -wave[0], wave[1]))[:pairs]
    turns = torch.tensor([[u for u, _ in waves], [v for _, v in waves], [0] * pairs])
    return turns.float() * (2 * math.pi / WAVE_STEPS)


def _frequencies(counts: tuple[int, ...], longest: float, shortest: float) -> Float[Tensor, "3 pair"]:
    parts = [
        2 * math.pi / longest * (longest / shortest) ** torch.linspace(0, 1, n, dtype=torch.float64) for n in counts
    ]
    return torch.block_diag(*parts).float()


def angles(
    coordinates: Float[Tensor, "*batch 3"], frequencies: Float[Tensor, "3 pair"]
) -> Float[Tensor, "*batch pair"]:
    """Angles by which each pair is rotated at these (u, v, s), radians."""
    # A sum of products, not a matrix product: autocast would round the angles to bfloat16.
    return (coordinates[..., None] * frequencies).sum(-2)


def cos_sin(angle: Float[Tensor, "*batch pair"]) -> Float[Tensor, "2 *batch pair"]:
    """Cosine and sine of angles in radians, for `rotate`."""
    return torch.stack([angle.cos(), angle.sin()])


def rotate(
    x: Float[Tensor, "*batch channel"], cos_sin: Float[Tensor, "2 *#batch channel/2"]
) -> Float[Tensor, "*batch channel"]:
    """Pairs (i, i + channel / 2) of x rotated by the angles of `cos_sin`, in x's own precision."""
    cos, sin = cos_sin.to(x.dtype)
    first, second = x.chunk(2, -1)
    return torch.cat([first * cos - second * sin, second * cos + first * sin], -1)
