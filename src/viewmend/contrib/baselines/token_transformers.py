"""DSTT and FuseFormer: frames to tokens, blocks of attention, tokens to frames.

DSTT: Liu et al. 2021, "Decoupled Spatial-Temporal Transformer for Video Inpainting". FuseFormer:
Liu et al. 2021, "Fusing Fine-Grained Information in Transformers for Video Inpainting".
"""

from abc import ABC, abstractmethod
from collections import OrderedDict

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from viewmend.contrib.baselines.layers import (
    DIM,
    FEATURES,
    MARGIN_CELLS,
    PATCH_CELLS,
    STEP_CELLS,
    STEP_PX,
    STRIDE_PX,
    DeepLayers,
    FeatureMaps,
    FrameDecoder,
    FusionFeedForward,
    HierarchicalEncoder,
    SoftComposition,
    SoftSplit,
    Tokens,
    part_of,
    shallow_layers,
    token_grid,
)
from viewmend.contrib.baselines.online import Clip

HEADS = 4
BLOCKS = 8
NATIVE_PX = (240, 432)
"""Height and width that the official weights were trained at."""
CELLS = (NATIVE_PX[0] // STRIDE_PX, NATIVE_PX[1] // STRIDE_PX)
"""Rows and columns of the feature map, fixed by the learned maps of FuseFormer and E2FGVI."""

Clips = Float[Tensor, "sample frame 3 height width"]
"""Frames in [-1, 1], 0 in the holes."""
TokenClips = Float[Tensor, "sample frame rows cols 512"]
"""Tokens of clips in the grid of their patches."""
ZONES = 2
"""Temporal attention stays within a zone; a frame has ZONES x ZONES."""
HIDDEN = 2048
"""Channels of DSTT's feed-forward layers."""
SIZE_STEP_PX = STEP_PX * ZONES
"""Heights and widths are multiples of this, so that zones are equal."""
TOKENS = token_grid(*CELLS)


class MultiHeadAttention(nn.Module):
    """Attention with 4 heads; keys `query_embedding`, `key_embedding`, `value_embedding`, `output_linear`."""

    def __init__(self) -> None:
        super().__init__()
        self.query_embedding = nn.Linear(DIM, DIM)
        self.value_embedding = nn.Linear(DIM, DIM)
        self.key_embedding = nn.Linear(DIM, DIM)
        self.output_linear = nn.Linear(DIM, DIM)

    def forward(self, tokens: Float[Tensor, "group token 512"]) -> Float[Tensor, "group token 512"]:
        """The tokens after attention within their group."""
        projected = self.query_embedding(tokens), self.key_embedding(tokens), self.value_embedding(tokens)
        Q, K, V = (rearrange(x, "g n (h c) -> g h n c", h=HEADS) for x in projected)
        return self.output_linear(rearrange(scaled_dot_product_attention(Q, K, V), "g h n c -> g n (h c)"))


class TokenBlock(nn.Module):
    """The parts of one block: attention, then a feed-forward. Keys `attention`, `ffn`, `norm1`, `norm2`."""

    def __init__(self, ffn: nn.Module) -> None:
        super().__init__()
        self.attention = MultiHeadAttention()
        self.ffn = ffn
        self.norm1 = nn.LayerNorm(DIM)
        self.norm2 = nn.LayerNorm(DIM)


class TokenTransformer(nn.Module, ABC):
    """Completes frames with holes; subclasses name the parts as the official checkpoints do."""

    encoder: nn.Module
    transformer: nn.ModuleList
    decoder: FrameDecoder

    @abstractmethod
    def check_size(self, height: int, width: int) -> None:
        """ValueError for frames of a size that this network does not support."""

    def encode(self, frames: Float[Tensor, "frame 3 height width"]) -> Float[Tensor, "frame 128 rows cols"]:
        """Features at a quarter of the size."""
        return self.encoder(frames)

    @abstractmethod
    def split(self, features: FeatureMaps) -> Tokens:
        """Tokens of overlapping patches."""

    @abstractmethod
    def compose(self, tokens: Tokens, size: tuple[int, int]) -> FeatureMaps:
        """What the tokens add to the encoder's features, which have this height and width."""

    def forward(self, clips: Clips) -> Clips:
        """All frames of each clip, filled, in [-1, 1].

        Args:
            clips: frames in [-1, 1], 0 in the holes. Frames of a clip have no order.

        Raises:
            ValueError: an unsupported size.
        """
        self.check_size(*clips.shape[-2:])
        features = self.encode(clips.flatten(0, 1))
        tokens = self.split(features).unflatten(0, clips.shape[:2])
        for block in self.transformer:
            tokens = block(tokens)
        added = self.compose(tokens.flatten(0, 1), (features.shape[-2], features.shape[-1]))
        return self.decoder(features + added).unflatten(0, clips.shape[:2])

    def complete_clip(self, clip: Clip) -> Float[Tensor, "3 height width"]:
        """See `OnlineNetwork`."""
        return self(torch.cat([clip.now, *clip.neighbours, *clip.references])[None])[0, 0]


def initialise(network: nn.Module) -> None:
    """Fresh weights as the authors draw them: N(0, 0.02), biases 0."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.normal_(layer.weight, 0, 0.02)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


class DecoupledBlock(TokenBlock):
    """Attention over all frames within each zone (`temporal`), or over all tokens of each frame.

    The residual starts from the normalised tokens, not from those that came in.
    """

    def __init__(self, temporal: bool) -> None:
        # The feed-forward's keys are `conv.0` and `conv.3`; the official dropout between them is inactive.
        layers = nn.Linear(DIM, HIDDEN), nn.ReLU(inplace=True), nn.Identity(), nn.Linear(HIDDEN, DIM)
        super().__init__(nn.Sequential(OrderedDict[str, nn.Module](conv=nn.Sequential(*layers))))
        self.temporal = temporal

    def forward(self, tokens: TokenClips) -> TokenClips:
        """The tokens after the block."""
        own = self.norm1(tokens)
        if self.temporal:
            split = {"i": ZONES, "j": ZONES, "f": own.shape[1], "r": own.shape[2] // ZONES}
            zones = rearrange(own, "b f (i r) (j c) d -> (b i j) (f r c) d", **split)
            looked = rearrange(self.attention(zones), "(b i j) (f r c) d -> b f (i r) (j c) d", **split)
        else:
            looked = self.attention(rearrange(own, "b f r c d -> (b f) (r c) d")).reshape(own.shape)
        x = own + looked
        return x + self.ffn(self.norm2(x))


class DSTT(TokenTransformer):
    """34.5 M parameters; 158 tensors, named as in the official checkpoint's `netG`. Takes multiples of 24 x 24 px."""

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

    def split(self, features: FeatureMaps) -> Tokens:
        """Tokens of overlapping patches; the convolution is soft split's linear layer."""
        return self.patch2vec(features).movedim(1, -1)

    def compose(self, tokens: Tokens, size: tuple[int, int]) -> FeatureMaps:
        """See `TokenTransformer.compose`."""
        return self.vec2patch(tokens, size)


class JointBlock(TokenBlock):
    """Attention over all tokens of all frames, then the fusion feed-forward; both with the usual residual."""

    def __init__(self) -> None:
        super().__init__(FusionFeedForward(nn.ReLU(inplace=True), nn.Identity()))

    def forward(self, tokens: TokenClips) -> TokenClips:
        """The tokens after the block."""
        flat = rearrange(self.norm1(tokens), "b f r c d -> b (f r c) d")
        x = tokens + self.attention(flat).reshape(tokens.shape)
        size = (STEP_CELLS * x.shape[2], STEP_CELLS * x.shape[3])
        fused = self.ffn(self.norm2(x).flatten(0, 1), size)
        return x + fused.reshape(x.shape)


class PositionalEmbedding(nn.Module):
    """A learned vector for each place of a frame, the same in all frames; key `pos_emb`."""

    def __init__(self) -> None:
        super().__init__()
        rows, cols = TOKENS
        self.pos_emb = nn.Parameter(torch.empty(1, 1, rows * cols, DIM))
        nn.init.normal_(self.pos_emb, 0, 0.02)

    def forward(self, tokens: Tokens) -> Tokens:
        """Tokens with their positional embedding."""
        everywhere = self.pos_emb.reshape(*TOKENS, DIM).movedim(-1, 0)
        return tokens + part_of(everywhere, (tokens.shape[1], tokens.shape[2])).movedim(0, -1)


class FuseFormer(TokenTransformer):
    """36.6 M parameters; 160 tensors, named as in the official checkpoint. Takes 432x240; in training, also less."""

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
        part = (
            0 < height <= NATIVE_PX[0]
            and 0 < width <= NATIVE_PX[1]
            and not (height % STEP_PX or width % STEP_PX)
        )
        if (height, width) != NATIVE_PX and not (self.training and part):
            raise ValueError(
                f"FuseFormer: expected frames of {NATIVE_PX[1]}x{NATIVE_PX[0]}, the size of its learned positions, got "
                f"{width}x{height}; resize them or run windows of that size"
            )

    def split(self, features: FeatureMaps) -> Tokens:
        """Tokens of overlapping patches with their positional embedding."""
        return self.add_pos_emb(self.ss(features))

    def compose(self, tokens: Tokens, size: tuple[int, int]) -> FeatureMaps:
        """See `TokenTransformer.compose`."""
        return self.sc(tokens, size)
