"""The transformer (section 6): P <- P + A(W_Q norm(P), W_K R, W_V R); P <- P + FFN(norm(P))."""

from dataclasses import dataclass

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from viewmend.models.paper.attention import (
    attend,
    attend_and_sum,
    attend_weighted,
    most_attended,
    rope_cos_sin,
    rope_frequencies,
    rotate,
    straight_through,
)
from viewmend.models.paper.config import PaperConfig


@dataclass(frozen=True)
class TokenPositions:
    """Positions of a padded batch of tokens."""

    uvs: Float[Tensor, "sample token 3"]
    """(u, v, s) in the novel view (section 5)."""
    present: Bool[Tensor, "sample token"]
    """False for padding and for patches without depth."""


class Block(nn.Module):
    """W_Q, norms and FFN of one block; its keys and values come from `Transformer.project_context`."""

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        dim = config.dim
        self.norm_query = nn.LayerNorm(dim)
        self.query = nn.Linear(dim, dim)
        self.norm_ffn = nn.LayerNorm(dim)
        self.ffn = nn.Sequential(
            nn.Linear(dim, config.ffn_ratio * dim), nn.GELU(), nn.Linear(config.ffn_ratio * dim, dim)
        )


@dataclass(frozen=True)
class Context:
    """Keys and values of the context tokens, and the rotations shared by all blocks (None without RoPE)."""

    keys_values: Float[Tensor, "block 2 sample key dim"]
    """K and V of every block, before rotation."""
    present: Bool[Tensor, "sample key"]
    key_rotation: Float[Tensor, "2 sample 1 key pair"] | None
    query_rotation: Float[Tensor, "2 sample 1 query pair"] | None


class Transformer(nn.Module):
    """n_g groups of n_b blocks. Keys and values of all blocks depend on the context tokens alone."""

    frequencies: Tensor

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        self.config = config
        self.scale = config.dim**-0.5
        self.keys_values = nn.Linear(config.dim, config.total_blocks * 2 * config.dim)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.total_blocks))
        self.register_buffer("frequencies", rope_frequencies(config.dim // config.heads), persistent=False)

    def project_context(self, tokens: Float[Tensor, "token dim"]) -> Float[Tensor, "block 2 token dim"]:
        """K = W_K R and V = W_V R of every block, before rotation. They are cached with the tokens (section 9)."""
        return rearrange(self.keys_values(tokens), "n (b two d) -> b two n d", two=2, d=self.config.dim)

    def forward(
        self,
        tokens: Float[Tensor, "sample query dim"],
        at: TokenPositions,
        keys_values: Float[Tensor, "block 2 sample key dim"],
        context_at: TokenPositions,
        top_k: int | None,
    ) -> Float[Tensor, "sample query dim"]:
        """The input tokens P after all blocks; each group prunes its context to `top_k` tokens, None for no pruning."""
        context = self.place_context(at, keys_values, context_at)
        for group in range(self.config.groups):
            tokens = self.run_group(group, tokens, at.present, context, top_k)
        return tokens

    def place_context(
        self, at: TokenPositions, keys_values: Float[Tensor, "block 2 sample key dim"], context_at: TokenPositions
    ) -> Context:
        """The context with the rotations of its keys and of the queries at these positions."""
        rotations = [None, None]
        if self.config.rope:
            rotations = [rope_cos_sin(x.uvs, self.frequencies)[:, :, None] for x in (context_at, at)]
        return Context(keys_values, context_at.present, *rotations)

    def run_group(
        self,
        group: int,
        tokens: Float[Tensor, "sample query dim"],
        counted: Bool[Tensor, "sample query"],
        context: Context,
        top_k: int | None,
    ) -> Float[Tensor, "sample query dim"]:
        """The input tokens after one group. Attention of the counted tokens decides what its first block prunes."""
        kept: Tensor | None = None
        weight: Tensor | None = None
        for number in range(self.config.blocks):
            index = group * self.config.blocks + number
            block = self.blocks[index]
            assert isinstance(block, Block)
            Q, K, V, present = self.project(index, tokens, context, kept)
            if number == 0 and self.config.blocks > 1 and top_k is not None and top_k < K.shape[2]:
                attended, received = attend_and_sum(Q, K, V, present, counted, self.scale)
                if torch.is_grad_enabled():
                    weight = straight_through(received, present, top_k)
                else:
                    kept = most_attended(received.masked_fill(~present, -1.0), top_k)
            elif weight is not None:
                attended = attend_weighted(Q, K, V, weight.to(Q.dtype), self.scale)
            else:
                attended = attend(Q, K, V, present, self.scale)
            tokens = tokens + rearrange(attended, "b h n c -> b n (h c)")
            tokens = tokens + block.ffn(block.norm_ffn(tokens))
        return tokens

    def project(
        self,
        index: int,
        tokens: Float[Tensor, "sample query dim"],
        context: Context,
        kept: Int[Tensor, "sample kept"] | None = None,
    ) -> tuple[
        Float[Tensor, "sample head query channel"],
        Float[Tensor, "sample head key channel"],
        Float[Tensor, "sample head key channel"],
        Bool[Tensor, "sample key"],
    ]:
        """RoPE(Q), RoPE(K) and V of a block, and which keys count; of the kept keys alone, if given."""
        block, heads = self.blocks[index], self.config.heads
        assert isinstance(block, Block)
        Q = rearrange(block.query(block.norm_query(tokens)), "b n (h c) -> b h n c", h=heads)
        KV = rearrange(context.keys_values[index], "two b n (h c) -> two b h n c", h=heads)
        present, rotation = context.present, context.key_rotation
        if kept is not None:
            present, pick = present.gather(1, kept), kept[:, None, :, None]
            KV = KV.gather(3, pick.expand(2, -1, heads, -1, KV.shape[4]))
            if rotation is not None:
                rotation = rotation.gather(3, pick.expand(2, -1, -1, -1, rotation.shape[4]))
        K, V = KV
        if rotation is not None and context.query_rotation is not None:
            Q, K = rotate(Q, context.query_rotation), rotate(K, rotation)
        return Q, K, V, present
