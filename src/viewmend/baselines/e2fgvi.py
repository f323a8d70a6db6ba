"""E2FGVI and E2FGVI-HQ: flow completion, feature propagation and focal transformer in one network."""

from dataclasses import dataclass

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.baselines.e2fgvi_propagation import Propagation
from viewmend.baselines.focal_attention import WINDOW, FocalAttention, FocalKeys
from viewmend.baselines.frame_decoder import FrameDecoder
from viewmend.baselines.hierarchical_encoder import STRIDE_PX, HierarchicalEncoder
from viewmend.baselines.soft_split import (
    DIM,
    STEP_CELLS,
    FusionFeedForward,
    SoftComposition,
    SoftSplit,
)
from viewmend.baselines.spynet import SPyNet

BLOCKS, HEADS = 8, 4
SIZE_PX = (240, 432)
"""Height and width that E2FGVI's learned bias map fixes."""
MULTIPLE_PX = (WINDOW[0] * STEP_CELLS * STRIDE_PX, WINDOW[1] * STEP_CELLS * STRIDE_PX)
"""Height and width of one attention window: 60 x 108."""


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
        self, tokens: Float[Tensor, "sample frame row column 512"], size: tuple[int, int], past: FocalKeys | None = None
    ) -> tuple[Float[Tensor, "sample frame row column 512"], FocalKeys]:
        """The tokens after the block, which also saw the `past` frames, and what later frames need of these."""
        normed = self.norm1(tokens)
        windows = rearrange(normed, "b t (i y) (j x) c -> b t i j c (y x)", y=WINDOW[0], x=WINDOW[1])
        looked, keys = self.attn(normed, self.pool_layers[0](windows)[..., 0], past)
        tokens = tokens + looked
        mixed = self.mlp(self.norm2(tokens).flatten(0, 1), size)
        return tokens + mixed.unflatten(0, tokens.shape[:2]), keys


class E2FGVI(nn.Module):
    """The published generator; state-dict keys are the official ones. `hq` takes any multiple of 60 x 108 pixels."""

    def __init__(self, hq: bool = False) -> None:
        super().__init__()
        self.hq = hq
        self.encoder = HierarchicalEncoder()
        self.decoder = FrameDecoder()
        self.feat_prop_module = Propagation()
        self.ss = SoftSplit()
        self.sc = SoftComposition(None if hq else (SIZE_PX[0] // STRIDE_PX, SIZE_PX[1] // STRIDE_PX), hq)
        self.transformer = nn.ModuleList(FocalBlock() for _ in range(BLOCKS))
        self.update_spynet = SPyNet()

    def forward(
        self, frames: Float[Tensor, "sample frame 3 height width"], local: int
    ) -> Float[Tensor, "sample frame 3 height width"]:
        """All frames completed, in [-1, 1].

        Args:
            frames: RGB in [-1, 1], 0 in the holes.
            local: how many of them, from the first on, are consecutive; the others are references.

        Raises:
            ValueError: a size that the network does not take, or not 1 to all frames local.
        """
        return self.with_flows(frames, local)[0]

    def with_flows(
        self, frames: Float[Tensor, "sample frame 3 height width"], local: int
    ) -> tuple[Float[Tensor, "sample frame 3 height width"], LocalFlows]:
        """`forward`, and the completed flows of the local frames, which training compares with the true ones."""
        self.check_size(frames.shape[-2], frames.shape[-1])
        if not 1 <= local <= frames.shape[1]:
            raise ValueError(f"expected 1 to {frames.shape[1]} local frames of {frames.shape[1]}, got {local}")
        flows = self.flows(frames[:, :local])
        features = self.encode(frames)
        consecutive = self.feat_prop_module(features[:, :local], flows.to_next, flows.to_previous)
        features = torch.cat([consecutive, features[:, local:]], 1)
        completed, _ = self.transform(features)
        return self.decode(completed), flows

    def check_size(self, height: int, width: int) -> None:
        """ValueError unless the network takes frames of this many pixels."""
        if not self.hq and (height, width) != SIZE_PX:
            raise ValueError(
                f"E2FGVI takes frames of {SIZE_PX[0]} x {SIZE_PX[1]} pixels (height x width), got {height} x {width}; "
                "resize or tile them, or use E2FGVI-HQ"
            )
        if height <= 0 or width <= 0 or height % MULTIPLE_PX[0] or width % MULTIPLE_PX[1]:
            raise ValueError(
                f"E2FGVI-HQ takes frames whose height is a multiple of {MULTIPLE_PX[0]} and whose width is one of "
                f"{MULTIPLE_PX[1]} pixels, got {height} x {width}; pad or resize them"
            )

    def flows(self, frames: Float[Tensor, "sample frame 3 height width"]) -> LocalFlows:
        """Flows between consecutive frames, holes and all: the network learned to complete them."""
        small = self.shrink(frames)
        first, second = small[:, :-1].flatten(0, 1), small[:, 1:].flatten(0, 1)
        if not len(first):
            none = small.new_zeros(len(frames), 0, 2, *small.shape[-2:])
            return LocalFlows(none, none)
        both = self.update_spynet(torch.cat([first, second]), torch.cat([second, first]))
        to_next, to_previous = rearrange(both, "(two b t) c h w -> two b t c h w", two=2, b=len(frames))
        return LocalFlows(to_next, to_previous)

    def shrink(self, frames: Float[Tensor, "sample frame 3 height width"]) -> Float[Tensor, "sample frame 3 rows cols"]:
        """Frames as the flow network takes them: in [0, 1], a quarter of the size."""
        size = [side // STRIDE_PX for side in frames.shape[-2:]]
        small = F.interpolate((frames.flatten(0, 1) + 1) / 2, size=size, mode="bilinear", align_corners=True)
        return small.unflatten(0, frames.shape[:2])

    def encode(
        self, frames: Float[Tensor, "sample frame 3 height width"]
    ) -> Float[Tensor, "sample frame 128 rows cols"]:
        """Features of each frame by itself, at a quarter of its size."""
        return self.encoder(frames.flatten(0, 1)).unflatten(0, frames.shape[:2])

    def transform(
        self,
        features: Float[Tensor, "sample frame 128 rows cols"],
        past: tuple[FocalKeys | None, ...] = (None,) * BLOCKS,
    ) -> tuple[Float[Tensor, "sample frame 128 rows cols"], tuple[FocalKeys, ...]]:
        """Features after the transformer, and each block's keys and values of these frames.

        `past` has the keys and values of earlier frames, block by block.
        """
        size = (features.shape[-2], features.shape[-1])
        tokens = self.ss(features.flatten(0, 1)).unflatten(0, features.shape[:2])
        kept = []
        for block, before in zip(self.transformer, past, strict=True):
            tokens, keys = block(tokens, size, before)
            kept.append(keys)
        return features + self.sc(tokens.flatten(0, 1), size).unflatten(0, features.shape[:2]), tuple(kept)

    def decode(
        self, features: Float[Tensor, "sample frame 128 rows cols"]
    ) -> Float[Tensor, "sample frame 3 height width"]:
        """Frames in [-1, 1]."""
        return self.decoder(features.flatten(0, 1)).unflatten(0, features.shape[:2])
