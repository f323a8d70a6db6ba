"""FuseFormer (Liu et al. 2021, "Fusing Fine-Grained Information in Transformers for Video Inpainting")."""

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.contrib.baselines.layers import (
    DIM,
    STEP_CELLS,
    STEP_PX,
    STRIDE_PX,
    FrameDecoder,
    FusionFeedForward,
    HierarchicalEncoder,
    SoftComposition,
    SoftSplit,
    part_of,
    token_grid,
)
from viewmend.contrib.baselines.token_transformer import (
    BLOCKS,
    NATIVE_PX,
    TokenBlock,
    TokenClips,
    TokenTransformer,
    initialise,
)

CELLS = (NATIVE_PX[0] // STRIDE_PX, NATIVE_PX[1] // STRIDE_PX)
"""Rows and columns of the feature map, fixed by the learned bias map and positional embedding."""
TOKENS = token_grid(*CELLS)


class JointBlock(TokenBlock):
    """Attention over all tokens of all frames, then the fusion feed-forward; both with the usual residual."""

    def __init__(self) -> None:
        super().__init__(FusionFeedForward(nn.ReLU(inplace=True), nn.Identity()))

    def forward(
        self, tokens: TokenClips, memory: Float[Tensor, "sample slot rows cols 512"] | None = None
    ) -> tuple[TokenClips, TokenClips]:
        """See `TokenBlock`."""
        own = self.norm1(tokens)
        sources = own if memory is None else torch.cat([own, memory], 1)
        queries, keys = (rearrange(x, "b f r c d -> b (f r c) d") for x in (own, sources))
        x = tokens + self.attention(queries, keys).reshape(tokens.shape)
        size = (STEP_CELLS * x.shape[2], STEP_CELLS * x.shape[3])
        fused = self.ffn(self.norm2(x).flatten(0, 1), size)
        return x + fused.reshape(x.shape), own


class PositionalEmbedding(nn.Module):
    """A learned vector for each place of a frame, the same in all frames; key `pos_emb`."""

    def __init__(self) -> None:
        super().__init__()
        rows, cols = TOKENS
        self.pos_emb = nn.Parameter(torch.empty(1, 1, rows * cols, DIM))
        nn.init.normal_(self.pos_emb, 0, 0.02)

    def forward(self, tokens: Float[Tensor, "frame rows cols 512"]) -> Float[Tensor, "frame rows cols 512"]:
        """Tokens with their positional embedding."""
        everywhere = self.pos_emb.reshape(*TOKENS, DIM).movedim(-1, 0)
        return tokens + part_of(everywhere, (tokens.shape[1], tokens.shape[2])).movedim(0, -1)


class FuseFormer(TokenTransformer):
    """36.6 M parameters; 160 tensors, named as in the official checkpoint. Takes 432x240; in training, also less."""

    name = "FuseFormer"

    def __init__(self) -> None:
        super().__init__()
        self.encoder = HierarchicalEncoder()
        self.ss = SoftSplit()
        self.add_pos_emb = PositionalEmbedding()
        self.transformer = nn.ModuleList(JointBlock() for _ in range(BLOCKS))
        self.sc = SoftComposition(bias_size=CELLS)
        self.decoder = FrameDecoder()
        initialise(self)

    def check_size(self, height: int, width: int) -> None:
        """ValueError unless the frame is 432x240: positional embedding and bias map are learned for this size.

        In training, smaller frames of multiples of 12 px are allowed; each uses a part of these maps.
        """
        part = 0 < height <= NATIVE_PX[0] and 0 < width <= NATIVE_PX[1] and not (height % STEP_PX or width % STEP_PX)
        if (height, width) != NATIVE_PX and not (self.training and part):
            raise ValueError(
                f"FuseFormer: expected frames of {NATIVE_PX[1]}x{NATIVE_PX[0]}, the size of its learned positions, got "
                f"{width}x{height}; resize them or run windows of that size"
            )

    def split(self, features: Float[Tensor, "frame 128 height width"]) -> Float[Tensor, "frame rows cols 512"]:
        """Tokens of overlapping patches with their positional embedding."""
        return self.add_pos_emb(self.ss(features))

    def decode(
        self, features: Float[Tensor, "frame 128 height width"], tokens: Float[Tensor, "frame rows cols 512"]
    ) -> Float[Tensor, "frame 3 fullheight fullwidth"]:
        """Frames in [-1, 1]."""
        return self.decoder(features + self.sc(tokens, (features.shape[-2], features.shape[-1])))
