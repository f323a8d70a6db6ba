"""DSTT (Liu et al. 2021, "Decoupled Spatial-Temporal Transformer for Video Inpainting")."""

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.contrib.baselines.layers import (
    DIM,
    FEATURES,
    MARGIN_CELLS,
    PATCH_CELLS,
    STEP_CELLS,
    STEP_PX,
    DeepLayers,
    FrameDecoder,
    SoftComposition,
    shallow_layers,
)
from viewmend.contrib.baselines.token_transformer import BLOCKS, TokenBlock, TokenClips, TokenTransformer, initialise

ZONES = 2
"""Temporal attention stays within a zone; a frame has ZONES x ZONES."""
HIDDEN = 2048
SIZE_STEP_PX = STEP_PX * ZONES
"""Heights and widths are multiples of this, so that zones are equal."""


class FeedForward(nn.Module):
    """Linear, ReLU, linear; keys `conv.0` and `conv.3` (the official dropout between them is inactive)."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Sequential(nn.Linear(DIM, HIDDEN), nn.ReLU(inplace=True), nn.Identity(), nn.Linear(HIDDEN, DIM))

    def forward(self, tokens: TokenClips) -> TokenClips:
        """The same grid of tokens."""
        return self.conv(tokens)


class DecoupledBlock(TokenBlock):
    """Attention over all frames within each zone (`temporal`), or over all tokens of each frame.

    The residual starts from the normalised tokens, not from those that came in.
    """

    def __init__(self, temporal: bool) -> None:
        super().__init__(FeedForward())
        self.temporal = temporal

    def forward(
        self, tokens: TokenClips, memory: Float[Tensor, "sample slot rows cols 512"] | None = None
    ) -> tuple[TokenClips, TokenClips]:
        """See `TokenBlock`; a spatial block does not use the memory."""
        own = self.norm1(tokens)
        x = own + (self._over_time(own, memory) if self.temporal else self._over_frames(own))
        return x + self.ffn(self.norm2(x)), own

    def _over_time(self, own: TokenClips, memory: Tensor | None) -> TokenClips:
        samples, frames, rows, cols, _ = own.shape
        sources = own if memory is None else torch.cat([own, memory], 1)
        mixed = self.attention(_zones(own), _zones(sources))
        return rearrange(
            mixed,
            "(b i j) (f r c) d -> b f (i r) (j c) d",
            b=samples,
            f=frames,
            i=ZONES,
            j=ZONES,
            r=rows // ZONES,
            c=cols // ZONES,
        )

    def _over_frames(self, own: TokenClips) -> TokenClips:
        flat = rearrange(own, "b f r c d -> (b f) (r c) d")
        return self.attention(flat, flat).reshape(own.shape)


def _zones(tokens: TokenClips) -> Float[Tensor, "zone token 512"]:
    return rearrange(tokens, "b f (i r) (j c) d -> (b i j) (f r c) d", i=ZONES, j=ZONES)


class DSTT(TokenTransformer):
    """34.5 M parameters; 158 tensors, named as in the official checkpoint's `netG`. Takes multiples of 24 x 24 px."""

    name = "DSTT"

    def __init__(self) -> None:
        super().__init__()
        self.encoder = shallow_layers()
        self.hier_enc = DeepLayers()
        self.patch2vec = nn.Conv2d(FEATURES, DIM, PATCH_CELLS, STEP_CELLS, MARGIN_CELLS)
        self.transformer = nn.ModuleList(DecoupledBlock(temporal=i % 2 == 0) for i in range(BLOCKS))
        self.vec2patch = SoftComposition()
        self.decoder = FrameDecoder()
        initialise(self)

    def check_size(self, height: int, width: int) -> None:
        """ValueError unless both are multiples of 24: zones of equal size."""
        if height % SIZE_STEP_PX or width % SIZE_STEP_PX or not height or not width:
            raise ValueError(
                f"DSTT: expected frames of a height and width that are multiples of {SIZE_STEP_PX}, got "
                f"{width}x{height}; resize them, to 432x240 for the official weights"
            )

    def encode(self, frames: Float[Tensor, "frame 3 height width"]) -> Float[Tensor, "frame 128 rows cols"]:
        """Features at a quarter of the size."""
        return self.hier_enc(self.encoder(frames))

    def split(self, features: Float[Tensor, "frame 128 height width"]) -> Float[Tensor, "frame rows cols 512"]:
        """Tokens of overlapping patches; the convolution is soft split's linear layer."""
        return self.patch2vec(features).movedim(1, -1)

    def decode(
        self, features: Float[Tensor, "frame 128 height width"], tokens: Float[Tensor, "frame rows cols 512"]
    ) -> Float[Tensor, "frame 3 fullheight fullwidth"]:
        """Frames in [-1, 1]."""
        rows, cols = features.shape[-2:]
        return self.decoder(features + self.vec2patch(tokens, (rows, cols)))
