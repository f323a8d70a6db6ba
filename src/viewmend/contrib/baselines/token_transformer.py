"""Base of DSTT and FuseFormer: frames to tokens, blocks of attention, tokens to frames; all at once or online."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from viewmend.contrib.baselines.layers import DIM
from viewmend.contrib.baselines.online import Clip, Frames

HEADS = 4
BLOCKS = 8
NATIVE_PX = (240, 432)
"""Height and width that the official weights were trained at."""

TokenClips = Float[Tensor, "sample frame rows cols 512"]
"""Tokens of clips in the grid of their patches."""
MemorySlot = Float[Tensor, "block frame rows cols 512"]
"""The memory of one time: its frames' tokens as input to each block's attention, after the first norm."""


class MultiHeadAttention(nn.Module):
    """Attention with 4 heads; keys `query_embedding`, `key_embedding`, `value_embedding`, `output_linear`."""

    def __init__(self) -> None:
        super().__init__()
        self.query_embedding = nn.Linear(DIM, DIM)
        self.value_embedding = nn.Linear(DIM, DIM)
        self.key_embedding = nn.Linear(DIM, DIM)
        self.output_linear = nn.Linear(DIM, DIM)

    def forward(
        self, queries: Float[Tensor, "group query 512"], sources: Float[Tensor, "group key 512"]
    ) -> Float[Tensor, "group query 512"]:
        """Each query's mixture of the sources of its group."""
        projected = self.query_embedding(queries), self.key_embedding(sources), self.value_embedding(sources)
        Q, K, V = (rearrange(x, "g n (h c) -> g h n c", h=HEADS) for x in projected)
        return self.output_linear(rearrange(scaled_dot_product_attention(Q, K, V), "g h n c -> g n (h c)"))


class TokenBlock(nn.Module, ABC):
    """One block: attention, then a feed-forward. Keys `attention`, `ffn`, `norm1`, `norm2`."""

    def __init__(self, ffn: nn.Module) -> None:
        super().__init__()
        self.attention = MultiHeadAttention()
        self.ffn = ffn
        self.norm1, self.norm2 = nn.LayerNorm(DIM), nn.LayerNorm(DIM)

    @abstractmethod
    def forward(
        self, tokens: TokenClips, memory: Float[Tensor, "sample slot rows cols 512"] | None = None
    ) -> tuple[TokenClips, TokenClips]:
        """The tokens after the block, and what it remembers of them.

        `memory` is what it remembered of earlier frames: keys and values, never queries.
        """


class TokenTransformer(nn.Module, ABC):
    """From frames with holes to whole frames; subclasses name the parts as the official checkpoints do."""

    encoder: nn.Module
    transformer: nn.ModuleList
    name: str
    """The network's name in messages."""

    @abstractmethod
    def check_size(self, height: int, width: int) -> None:
        """ValueError for frames of a size that this network does not support."""

    def encode(self, frames: Float[Tensor, "frame 3 height width"]) -> Float[Tensor, "frame 128 rows cols"]:
        """Features at a quarter of the size."""
        return self.encoder(frames)

    @abstractmethod
    def split(self, features: Float[Tensor, "frame 128 height width"]) -> Float[Tensor, "frame rows cols 512"]:
        """Tokens of overlapping patches."""

    @abstractmethod
    def decode(
        self, features: Float[Tensor, "frame 128 height width"], tokens: Float[Tensor, "frame rows cols 512"]
    ) -> Float[Tensor, "frame 3 fullheight fullwidth"]:
        """Frames from the encoder's features and what the tokens add to them."""

    def forward(
        self, clips: Float[Tensor, "sample frame 3 height width"]
    ) -> Float[Tensor, "sample frame 3 height width"]:
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
            tokens, _ = block(tokens)
        return self.decode(features, tokens.flatten(0, 1)).unflatten(0, clips.shape[:2])

    def complete_clip(self, clip: Clip) -> Float[Tensor, "3 height width"]:
        """See `OnlineNetwork`."""
        return self(torch.cat([clip.now, *clip.neighbours, *clip.references])[None])[0, 0]

    def complete_remembering(
        self, now: Frames, memory: Sequence[MemorySlot]
    ) -> tuple[Float[Tensor, "3 height width"], MemorySlot]:
        """See `OnlineNetwork`: only the frames of one time go through the network (Thiry et al., OM).

        The order of `memory` does not matter.

        Raises:
            ValueError: an unsupported size, or slots of another size.
        """
        self.check_size(*now.shape[-2:])
        features = self.encode(now)
        tokens = self.split(features)[None]
        if any(slot.shape[2:] != tokens.shape[2:] for slot in memory):
            raise ValueError(
                f"{self.name}: expected memory of {tuple(tokens.shape[2:4])} tokens a frame as this frame has, got "
                f"{[tuple(slot.shape[2:4]) for slot in memory]}; start a new stream for another size"
            )
        remembered = []
        for number, block in enumerate(self.transformer):
            past = torch.cat([slot[number] for slot in memory])[None] if memory else None
            tokens, own = block(tokens, past)
            remembered.append(own[0])
        return self.decode(features[:1], tokens[0, :1])[0], torch.stack(remembered)


def initialise(network: nn.Module) -> None:
    """Fresh weights as the authors draw them: N(0, 0.02), biases 0."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.normal_(layer.weight, 0, 0.02)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
