"""E2FGVI's temporal focal attention: windows see their own tokens, those around and a pooled map, in all frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from einops import rearrange, repeat
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

WINDOW = (5, 9)
"""Rows and columns of tokens in a window."""
REACH = (WINDOW[0] // 2, WINDOW[1] // 2)
"""How far around a window its surroundings reach, in tokens; and around a pooled token, in windows."""


@dataclass(frozen=True)
class FocalTokens:
    """What attention sees of frames in one block, and all that later frames need of them."""

    fine: Float[Tensor, "sample frame row column dim"]
    """After the block's first norm."""
    pooled: Float[Tensor, "sample frame window_row window_column dim"]
    """One of each window."""


class FocalAttention(nn.Module):
    """Attention of each window, over all frames, to 45 own tokens, 120 around them and up to 45 pooled ones."""

    valid_ind_rolled: Tensor

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        self.register_buffer("valid_ind_rolled", _outside_of_window())

    def forward(
        self, own: FocalTokens, past: Sequence[FocalTokens] = ()
    ) -> Float[Tensor, "sample frame row column dim"]:
        """What the frames' tokens see in them and in the `past` frames."""
        batch, dim, grid = own.fine.shape[0], own.fine.shape[-1], (own.pooled.shape[2], own.pooled.shape[3])
        frames = (own, *past)

        # Keys and values of every window: the same places in all frames.
        weight, bias = self.qkv.weight.split([dim, 2 * dim]), self.qkv.bias.split([dim, 2 * dim])
        fine = F.linear(torch.cat([x.fine for x in frames], 1), weight[1], bias[1]).flatten(2, 3)
        pooled = F.linear(torch.cat([x.pooled for x in frames], 1), weight[1], bias[1]).flatten(2, 3)
        places = self._places(grid).to(fine.device)
        cells, near = (x.to(fine.device) for x in pooled_places(grid))
        KV = torch.cat([fine[:, :, places], pooled[:, :, cells]], 3)
        K, V = rearrange(KV, "b t n k (two heads c) -> two (b n) heads (t k) c", two=2, heads=self.heads)
        present = torch.cat([near.new_ones(places.shape), near], 1)
        present = repeat(present, "n k -> (b n) 1 1 (t k)", b=batch, t=fine.shape[1])

        Q = F.linear(own.fine, weight[0], bias[0])
        Q = rearrange(
            Q, "b t (i y) (j x) (heads c) -> (b i j) heads (t y x) c", y=WINDOW[0], x=WINDOW[1], heads=self.heads
        )
        looked = F.scaled_dot_product_attention(Q, K, V, present)
        looked = rearrange(
            looked,
            "(b i j) heads (t y x) c -> b t (i y) (j x) (heads c)",
            i=grid[0], j=grid[1], y=WINDOW[0], x=WINDOW[1],
        )  # fmt: skip
        return self.proj(looked)

    def _places(self, grid: tuple[int, int]) -> Int[Tensor, "window key"]:
        """Where each window's own and surrounding tokens are, in a frame of `grid` windows read row by row."""
        own, rolled = window_places(grid)
        return torch.cat([own, rolled[:, self.valid_ind_rolled.to(rolled.device)]], 1)


def window_places(grid: tuple[int, int]) -> tuple[Int[Tensor, "window own"], Int[Tensor, "window rolled"]]:
    """Places of each window's tokens, and of those in the windows shifted up left, up right, down left, down right.

    What leaves the frame comes back on the other side.
    """
    rows, columns = grid[0] * WINDOW[0], grid[1] * WINDOW[1]
    places = torch.arange(rows * columns).view(rows, columns)

    def windows(of: Tensor) -> Tensor:
        return rearrange(of, "(i y) (j x) -> (i j) (y x)", y=WINDOW[0], x=WINDOW[1])

    shifts = [(y * REACH[0], x * REACH[1]) for y in (-1, 1) for x in (-1, 1)]
    return windows(places), torch.cat([windows(places.roll(shift, (0, 1))) for shift in shifts], 1)


def pooled_places(grid: tuple[int, int]) -> tuple[Int[Tensor, "window key"], Bool[Tensor, "window key"]]:
    """Which pooled tokens each window may look at, and which of those are near enough: 5 x 9 around it."""
    (rows, near_rows), (columns, near_columns) = (_around(n, size) for n, size in zip(grid, WINDOW, strict=True))
    cells = rows[:, None, :, None] * grid[1] + columns[None, :, None, :]
    near = near_rows[:, None, :, None] & near_columns[None, :, None, :]
    return cells.flatten(2).flatten(0, 1), near.flatten(2).flatten(0, 1)


def _around(count: int, size: int) -> tuple[Int[Tensor, "place neighbour"], Bool[Tensor, "place neighbour"]]:
    """Along one axis: neighbours inside of it, enough of them for all, and which are at most size // 2 away."""
    at = torch.arange(count)[:, None]
    first = (at - size // 2).clamp(0, max(0, count - size))
    neighbours = first + torch.arange(min(size, count))
    return neighbours, (neighbours - at).abs() <= size // 2


def _outside_of_window() -> Int[Tensor, "120"]:
    """Indices, in the four rolled windows one after the other, of tokens that lie outside of the own window."""
    own, rolled = window_places((3, 3))  # the middle one of nine: its rolled windows do not wrap around
    return torch.nonzero(~torch.isin(rolled[4], own[4]))[:, 0]
