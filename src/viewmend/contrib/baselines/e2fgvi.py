"""E2FGVI and E2FGVI-HQ: flow completion, feature propagation and focal transformer (Li et al. 2022)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.contrib.baselines.clips import Clip, Frames
from viewmend.contrib.baselines.e2fgvi_propagation import AlignedConvolution, Propagated, Propagation
from viewmend.contrib.baselines.focal_attention import WINDOW, FocalAttention, FocalTokens
from viewmend.contrib.baselines.frame_coder import STRIDE_PX, FrameDecoder, HierarchicalEncoder
from viewmend.contrib.baselines.soft_split import DIM, STEP_PX, FusionFeedForward, SoftComposition, SoftSplit
from viewmend.contrib.baselines.spynet import SPyNet
from viewmend.contrib.baselines.token_transformer import BLOCKS, HEADS, NATIVE_PX, initialise

CELLS = (NATIVE_PX[0] // STRIDE_PX, NATIVE_PX[1] // STRIDE_PX)
"""Rows and columns of the feature map that E2FGVI's learned bias map fixes."""
MULTIPLE_PX = (WINDOW[0] * STEP_PX, WINDOW[1] * STEP_PX)
"""Height and width of one attention window: 60 x 108."""

Clips = Float[Tensor, "sample frame 3 height width"]
"""Frames in [-1, 1], 0 in the holes."""
Features = Float[Tensor, "sample frame 128 rows cols"]
"""Features of clips, at a quarter of the frames' size."""


@dataclass(frozen=True)
class LocalFlows:
    """Flow between consecutive frames at a quarter of their size, (right, down) in its pixels."""

    to_next: Float[Tensor, "sample pair 2 rows cols"]
    to_previous: Float[Tensor, "sample pair 2 rows cols"]


@dataclass(frozen=True)
class E2FGVIMemory:
    """What one time of a stream leaves behind (OM)."""

    small: Float[Tensor, "1 3 rows cols"]
    """The view as the flow network takes it."""
    propagated: Propagated
    """The forward sweep's last results."""
    tokens: tuple[FocalTokens, ...]
    """The tokens of all frames of that time, block by block."""


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
        self,
        tokens: Float[Tensor, "sample frame row column 512"],
        size: tuple[int, int],
        past: Sequence[FocalTokens] = (),
    ) -> tuple[Float[Tensor, "sample frame row column 512"], FocalTokens]:
        """The tokens after the block, which also sees the `past` frames, and what later frames need of these."""
        normed = self.norm1(tokens)
        windows = rearrange(normed, "b t (i y) (j x) c -> b t i j c (y x)", y=WINDOW[0], x=WINDOW[1])
        own = FocalTokens(normed, self.pool_layers[0](windows)[..., 0])
        tokens = tokens + self.attn(own, past)
        mixed = self.mlp(self.norm2(tokens).flatten(0, 1), size)
        return tokens + mixed.unflatten(0, tokens.shape[:2]), own


class E2FGVI(nn.Module):
    """41.8 M parameters; 243 tensors, named as in the official checkpoint. Takes 432x240; in training, also less."""

    name = "E2FGVI"

    def __init__(self) -> None:
        super().__init__()
        self.encoder = HierarchicalEncoder()
        self.decoder = FrameDecoder()
        self.feat_prop_module = Propagation()
        self.ss = SoftSplit()
        self.sc = self._composition()
        self.transformer = nn.ModuleList(FocalBlock() for _ in range(BLOCKS))
        self.update_spynet = SPyNet()
        initialise(self)
        for module in self.modules():
            if isinstance(module, AlignedConvolution):
                module.initialise()

    def _composition(self) -> SoftComposition:
        return SoftComposition(bias_size=CELLS)

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
            raise ValueError(f"expected 1 to {frames.shape[1]} local frames of {frames.shape[1]}, got {local}")
        flows = self.flows(frames[:, :local])
        features = self.encode(frames)
        consecutive = self.feat_prop_module(features[:, :local], flows.to_next, flows.to_previous)
        features = torch.cat([consecutive, features[:, local:]], 1)
        completed, _ = self.transform(features)
        return self.decode(completed), flows

    def check_size(self, height: int, width: int) -> None:
        """ValueError unless the frame is 432x240: the bias map is learned for this size.

        In training smaller frames of whole attention windows will do: each looks at a part of the map.
        """
        part = _is_covered(height, width) and height <= NATIVE_PX[0] and width <= NATIVE_PX[1]
        if (height, width) != NATIVE_PX and not (self.training and part):
            raise ValueError(
                f"E2FGVI: expected frames of {NATIVE_PX[1]}x{NATIVE_PX[0]}, the size of its learned bias map, got "
                f"{width}x{height}; resize them, run windows of that size, or use E2FGVI-HQ"
            )

    def flows(self, frames: Clips) -> LocalFlows:
        """Flows between consecutive frames, holes and all: the network learned to complete them."""
        small = self.shrink(frames)
        first, second = small[:, :-1].flatten(0, 1), small[:, 1:].flatten(0, 1)
        if not len(first):
            none = small.new_zeros(len(frames), 0, 2, *small.shape[-2:])
            return LocalFlows(none, none)
        both = self.update_spynet(torch.cat([first, second]), torch.cat([second, first]))
        to_next, to_previous = rearrange(both, "(two b t) c h w -> two b t c h w", two=2, b=len(frames))
        return LocalFlows(to_next, to_previous)

    def shrink(self, frames: Clips) -> Float[Tensor, "sample frame 3 rows cols"]:
        """Frames as the flow network takes them: in [0, 1], a quarter of the size."""
        size = [side // STRIDE_PX for side in frames.shape[-2:]]
        small = F.interpolate((frames.flatten(0, 1) + 1) / 2, size=size, mode="bilinear", align_corners=True)
        return small.unflatten(0, frames.shape[:2])

    def encode(self, frames: Clips) -> Features:
        """Features of each frame by itself, at a quarter of its size."""
        return self.encoder(frames.flatten(0, 1)).unflatten(0, frames.shape[:2])

    def transform(
        self, features: Features, memory: Sequence[E2FGVIMemory] = ()
    ) -> tuple[Features, tuple[FocalTokens, ...]]:
        """Features after the transformer, which also sees what is remembered, and each block's tokens of these."""
        size = (features.shape[-2], features.shape[-1])
        tokens = self.ss(features.flatten(0, 1)).unflatten(0, features.shape[:2])
        kept = []
        for number, block in enumerate(self.transformer):
            tokens, own = block(tokens, size, [slot.tokens[number] for slot in memory])
            kept.append(own)
        return features + self.sc(tokens.flatten(0, 1), size).unflatten(0, features.shape[:2]), tuple(kept)

    def decode(self, features: Features) -> Clips:
        """Frames in [-1, 1]."""
        return self.decoder(features.flatten(0, 1)).unflatten(0, features.shape[:2])

    def complete_clip(self, clip: Clip) -> Float[Tensor, "3 height width"]:
        """See `OnlineNetwork`. Local are the view's own frames in the order of time; all others are references.

        So are what other cameras see: flow leads through time, not from camera to camera.
        """
        times = (*reversed(clip.neighbours), clip.now)
        local = [frames[:1] for frames in times]
        others = [frames[1:] for frames in times]
        return self(torch.cat([*local, *others, *clip.references])[None], len(local))[0, len(local) - 1]

    def complete_remembering(
        self, now: Frames, memory: tuple[E2FGVIMemory, ...]
    ) -> tuple[Float[Tensor, "3 height width"], E2FGVIMemory]:
        """See `OnlineNetwork`. The view's features go on from the latest time remembered, which flow leads to.

        Only the forward sweep remembers; the backward one has no later frame to come from.
        """
        self.check_size(now.shape[-2], now.shape[-1])
        small = self.shrink(now[None, :1])[:, 0]
        last = memory[-1] if memory else None
        if last is not None and last.small.shape != small.shape:
            raise ValueError(
                f"{self.name}: expected memory of frames of {now.shape[-1]}x{now.shape[-2]} as this one is, got one of "
                f"{STRIDE_PX * last.small.shape[-1]}x{STRIDE_PX * last.small.shape[-2]}; start a new stream"
            )
        flow = None if last is None else self.update_spynet(small, last.small)
        features = self.encode(now[None])
        followed, propagated = self.feat_prop_module.follow(
            features[:, 0], flow, Propagated() if last is None else last.propagated
        )
        completed, tokens = self.transform(torch.cat([followed[:, None], features[:, 1:]], 1), memory)
        return self.decode(completed[:, :1])[0, 0], E2FGVIMemory(small, propagated, tokens)


class E2FGVIHQ(E2FGVI):
    """41.1 M parameters; 244 tensors. Takes any multiple of 60 x 108 pixels (height x width)."""

    name = "E2FGVI-HQ"

    def _composition(self) -> SoftComposition:
        return SoftComposition(bias_convolution=True)

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
