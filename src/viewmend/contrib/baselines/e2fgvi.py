"""E2FGVI and E2FGVI-HQ: flow completion, feature propagation and focal transformer (Li et al. 2022)."""

from dataclasses import dataclass
from functools import partial

import torch
from einops import rearrange, repeat
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.contrib.baselines.e2fgvi_propagation import AlignedConvolution, Propagation, SPyNet
from viewmend.contrib.baselines.layers import (
    DIM,
    STEP_PX,
    STRIDE_PX,
    FrameDecoder,
    FusionFeedForward,
    HierarchicalEncoder,
    SoftComposition,
    SoftSplit,
)
from viewmend.contrib.baselines.online import Clip
from viewmend.contrib.baselines.token_transformers import BLOCKS, CELLS, HEADS, NATIVE_PX, Clips, initialise

WINDOW = (5, 9)
"""Rows and columns of tokens in a window."""
REACH = (WINDOW[0] // 2, WINDOW[1] // 2)
"""How far around a window its surroundings reach, in tokens; and around a pooled token, in windows."""
MULTIPLE_PX = (WINDOW[0] * STEP_PX, WINDOW[1] * STEP_PX)
"""Height and width of one attention window: 60 x 108."""


class FocalAttention(nn.Module):
    """Temporal focal attention: each window, over all frames, to 45 own tokens, 120 around and up to 45 pooled ones."""

    valid_ind_rolled: Tensor

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        # Tokens of the four rolled windows, one after the other, that lie outside of the own
        # window: of the middle one of nine windows, whose rolled windows do not wrap around.
        own, rolled = window_places((3, 3))
        self.register_buffer("valid_ind_rolled", torch.nonzero(~torch.isin(rolled[4], own[4]))[:, 0])

    def forward(
        self,
        tokens: Float[Tensor, "sample frame row column dim"],
        pooled: Float[Tensor, "sample frame window_row window_column dim"],
    ) -> Float[Tensor, "sample frame row column dim"]:
        """The frames' tokens after attention to the tokens of all frames; `pooled` has one token of each window."""
        dim = tokens.shape[-1]
        grid = (pooled.shape[2], pooled.shape[3])
        device = tokens.device

        # Keys and values of every window: the same places in all frames.
        weight = self.qkv.weight.split([dim, 2 * dim])
        bias = self.qkv.bias.split([dim, 2 * dim])
        fine, coarse = (F.linear(x, weight[1], bias[1]).flatten(2, 3) for x in (tokens, pooled))
        own, rolled = window_places(grid)
        places = torch.cat([own, rolled[:, self.valid_ind_rolled.to(rolled.device)]], 1).to(device)
        cells, near = (x.to(device) for x in pooled_places(grid))
        KV = torch.cat([fine[:, :, places], coarse[:, :, cells]], 3)
        K, V = rearrange(KV, "b t n k (two heads c) -> two (b n) heads (t k) c", two=2, heads=self.heads)
        present = torch.cat([near.new_ones(places.shape), near], 1)
        present = repeat(present, "n k -> (b n) 1 1 (t k)", b=len(tokens), t=tokens.shape[1])

        split = {"i": grid[0], "j": grid[1], "y": WINDOW[0], "x": WINDOW[1], "heads": self.heads}
        Q = F.linear(tokens, weight[0], bias[0])
        Q = rearrange(Q, "b t (i y) (j x) (heads c) -> (b i j) heads (t y x) c", **split)
        looked = F.scaled_dot_product_attention(Q, K, V, present)
        return self.proj(rearrange(looked, "(b i j) heads (t y x) c -> b t (i y) (j x) (heads c)", **split))


def window_places(grid: tuple[int, int]) -> tuple[Int[Tensor, "window own"], Int[Tensor, "window rolled"]]:
    """Places of each window's tokens, and of those in the windows shifted up left, up right, down left, down right.

    Shifts wrap around the frame.
    """
    rows = grid[0] * WINDOW[0]
    columns = grid[1] * WINDOW[1]
    places = torch.arange(rows * columns).view(rows, columns)

    def windows(of: Tensor) -> Tensor:
        return rearrange(of, "(i y) (j x) -> (i j) (y x)", y=WINDOW[0], x=WINDOW[1])

    shifts = [(y * REACH[0], x * REACH[1]) for y in (-1, 1) for x in (-1, 1)]
    return windows(places), torch.cat([windows(places.roll(shift, (0, 1))) for shift in shifts], 1)


def pooled_places(grid: tuple[int, int]) -> tuple[Int[Tensor, "window key"], Bool[Tensor, "window key"]]:
    """Indices of pooled tokens for each window, and which of them are in its 5 x 9 neighbourhood."""
    (rows, near_rows), (columns, near_columns) = (
        _around(n, size) for n, size in zip(grid, WINDOW, strict=True)
    )
    cells = rows[:, None, :, None] * grid[1] + columns[None, :, None, :]
    near = near_rows[:, None, :, None] & near_columns[None, :, None, :]
    return cells.flatten(2).flatten(0, 1), near.flatten(2).flatten(0, 1)


def _around(count: int, size: int) -> tuple[Int[Tensor, "place neighbour"], Bool[Tensor, "place neighbour"]]:
    """Neighbours of each place along an axis, and whether they are at most size // 2 away.

    All places have equally many neighbours, all of them inside the axis.
    """
    at = torch.arange(count)[:, None]
    first = (at - size // 2).clamp(0, max(0, count - size))
    neighbours = first + torch.arange(min(size, count))
    return neighbours, (neighbours - at).abs() <= size // 2


@dataclass(frozen=True)
class LocalFlows:
    """Flow between consecutive frames at a quarter of their size, (right, down) in its pixels."""

    to_next: Float[Tensor, "sample pair 2 rows cols"]
    to_previous: Float[Tensor, "sample pair 2 rows cols"]


class FocalBlock(nn.Module):
    """One pre-norm block: focal attention, then the fusion feed-forward."""

    def __init__(self) -> None:
        super().__init__()
        self.pool_layers = nn.ModuleList([nn.Linear(WINDOW[0] * WINDOW[1], 1)])
        self.norm1 = nn.LayerNorm(DIM)
        self.attn = FocalAttention(DIM, HEADS)
        self.norm2 = nn.LayerNorm(DIM)
        self.mlp = FusionFeedForward(nn.GELU())

    def forward(
        self, tokens: Float[Tensor, "sample frame row column 512"], size: tuple[int, int]
    ) -> Float[Tensor, "sample frame row column 512"]:
        """The tokens after the block; `size` is that of the feature map."""
        normed = self.norm1(tokens)
        windows = rearrange(normed, "b t (i y) (j x) c -> b t i j c (y x)", y=WINDOW[0], x=WINDOW[1])
        tokens = tokens + self.attn(normed, self.pool_layers[0](windows)[..., 0])
        mixed = self.mlp(self.norm2(tokens).flatten(0, 1), size)
        return tokens + mixed.unflatten(0, tokens.shape[:2])


class E2FGVI(nn.Module):
    """41.8 M parameters; 243 tensors, named as in the official checkpoint. Takes 432x240; in training, also less."""

    composition = partial(SoftComposition, bias_size=CELLS)

    def __init__(self) -> None:
        super().__init__()
        self.encoder = HierarchicalEncoder()
        self.decoder = FrameDecoder()
        self.feat_prop_module = Propagation()
        self.ss = SoftSplit()
        self.sc = self.composition()
        self.transformer = nn.ModuleList(FocalBlock() for _ in range(BLOCKS))
        self.update_spynet = SPyNet()
        initialise(self)
        for module in self.modules():
            if isinstance(module, AlignedConvolution):
                module.initialise()

    def forward(self, frames: Clips, local: int) -> Clips:
        """All frames completed, in [-1, 1].

        Args:
            frames: RGB in [-1, 1], 0 in the holes.
            local: how many of them, from the first on, are consecutive; the others are references.

        Raises:
            ValueError: a size that the network does not take, or not 1 to all frames local.
        """
        return self.with_flows(frames, local)[0]

    def with_flows(self, frames: Clips, local: int) -> tuple[Clips, LocalFlows]:
        """`forward`, and the completed flows of the local frames, which training compares with the true ones."""
        self.check_size(frames.shape[-2], frames.shape[-1])
        if not 1 <= local <= frames.shape[1]:
            raise ValueError(
                f"expected 1 to {frames.shape[1]} local frames of {frames.shape[1]}, got {local}"
            )
        clips = frames.shape[:2]
        flows = self.flows(frames[:, :local])
        features = self.encoder(frames.flatten(0, 1)).unflatten(0, clips)
        consecutive = self.feat_prop_module(features[:, :local], flows.to_next, flows.to_previous)
        features = torch.cat([consecutive, features[:, local:]], 1).flatten(0, 1)
        size = (features.shape[-2], features.shape[-1])
        tokens = self.ss(features).unflatten(0, clips)
        for block in self.transformer:
            tokens = block(tokens, size)
        return self.decoder(features + self.sc(tokens.flatten(0, 1), size)).unflatten(0, clips), flows

    def check_size(self, height: int, width: int) -> None:
        """ValueError unless the frame is 432x240: the bias map is learned for this size.

        In training, smaller frames of whole attention windows are allowed; each uses a part of the map.
        """
        part = _is_covered(height, width) and height <= NATIVE_PX[0] and width <= NATIVE_PX[1]
        if (height, width) != NATIVE_PX and not (self.training and part):
            raise ValueError(
                f"E2FGVI: expected frames of {NATIVE_PX[1]}x{NATIVE_PX[0]}, the size of its learned bias map, got "
                f"{width}x{height}; resize them, run windows of that size, or use E2FGVI-HQ"
            )

    def flows(self, frames: Clips) -> LocalFlows:
        """Flows between consecutive frames, holes and all: the network learned to complete them."""
        size = [side // STRIDE_PX for side in frames.shape[-2:]]
        small = F.interpolate((frames.flatten(0, 1) + 1) / 2, size=size, mode="bilinear", align_corners=True)
        small = small.unflatten(0, frames.shape[:2])
        first = small[:, :-1].flatten(0, 1)
        second = small[:, 1:].flatten(0, 1)
        if not len(first):
            none = small.new_zeros(len(frames), 0, 2, *small.shape[-2:])
            return LocalFlows(none, none)
        both = self.update_spynet(torch.cat([first, second]), torch.cat([second, first]))
        to_next, to_previous = rearrange(both, "(two b t) c h w -> two b t c h w", two=2, b=len(frames))
        return LocalFlows(to_next, to_previous)

    def complete_clip(self, clip: Clip) -> Float[Tensor, "3 height width"]:
        """See `OnlineNetwork`. Local are the view's own frames in the order of time; all others are references.

        Other cameras' images are references too: flow is between times, not between cameras.
        """
        times = (*reversed(clip.neighbours), clip.now)
        ordered = [*(frames[:1] for frames in times), *(frames[1:] for frames in times), *clip.references]
        return self(torch.cat(ordered)[None], len(times))[0, len(times) - 1]


class E2FGVIHQ(E2FGVI):
    """41.1 M parameters; 244 tensors. Takes any multiple of 60 x 108 pixels (height x width)."""

    composition = partial(SoftComposition, bias_convolution=True)

    def check_size(self, height: int, width: int) -> None:
        """ValueError unless attention windows of 60 x 108 pixels cover the frame."""
        if not _is_covered(height, width):
            raise ValueError(
                f"E2FGVI-HQ: expected frames whose height is a multiple of {MULTIPLE_PX[0]} and whose width is one of "
                f"{MULTIPLE_PX[1]}, got {width}x{height}; pad or resize them, or run windows of such a size"
            )


def _is_covered(height: int, width: int) -> bool:
    """Whether attention windows cover a frame."""
    return min(height, width) > 0 and not (height % MULTIPLE_PX[0] or width % MULTIPLE_PX[1])
