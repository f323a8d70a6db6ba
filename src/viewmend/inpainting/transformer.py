"""Input tokens attend to context tokens (section 6): P <- P + A(W_Q norm(P), W_K R, W_V R); P <- P + FFN(norm(P))."""

from dataclasses import dataclass

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor, nn

from viewmend.inpainting import rope
from viewmend.inpainting.attention import attend, attend_and_sum, attend_weighted
from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.correspondences import AttentionGuide
from viewmend.inpainting.pruning import most_attended, straight_through

PRIOR_SPACE = (1.0, 2.0)
"""How much a pair of u or v adds to the score of a patch at no distance, at the start: first and last block."""
PRIOR_TIME = 0.25
"""The same of a pair of s, as a share."""
CONTENT_GAIN = 0.5
"""Size of the untrained content scores' weights, against the usual."""
COPY_GAIN = 0.5
"""How much of what it looks at an untrained block adds to a token."""


@dataclass(frozen=True)
class TokenPositions:
    """Where a padded batch of tokens is."""

    uvs: Float[Tensor, "sample token 3"]
    """(u, v, s) of section 5."""
    steps: Float[Tensor, "sample token 3"]
    """(u, v) in patch steps of the novel view, and s."""
    present: Bool[Tensor, "sample token"]
    """False for padding and for patches that do not count."""


class Block(nn.Module):
    """One layer's own parameters; its keys and values come from `Transformer.project_context`."""

    def __init__(self, config: InpainterConfig) -> None:
        super().__init__()
        dim = config.dim
        self.norm_query = nn.LayerNorm(dim)
        self.query = nn.Linear(dim, dim)
        self.norm_ffn = nn.LayerNorm(dim)
        self.ffn = nn.Sequential(
            nn.Linear(dim, config.ffn_ratio * dim), nn.GELU(), nn.Linear(config.ffn_ratio * dim, dim)
        )


class Transformer(nn.Module):
    """n_g groups of n_b blocks. Keys and values of all blocks depend on the context tokens alone."""

    score_frequencies: Tensor
    value_frequencies: Tensor

    def __init__(self, config: InpainterConfig) -> None:
        super().__init__()
        self.config = config
        head_dim = config.dim // config.heads
        self.scale = config.dim**-0.5
        self.keys_values = nn.Linear(config.dim, config.total_blocks * 2 * config.dim)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.total_blocks))
        self.register_buffer("score_frequencies", rope.score_frequencies(head_dim), persistent=False)
        self.register_buffer("value_frequencies", rope.value_frequencies(head_dim), persistent=False)
        if config.identity_init:
            self._identity_init()

    def _identity_init(self) -> None:
        """Begin by looking at what lands nearest, and adding half of it.

        With RoPE, constant biases of queries and keys make the score contain the sum of cos(frequency x distance).
        """
        dim, heads = self.config.dim, self.config.heads
        weights = self.keys_values.weight.data.unflatten(0, (-1, 2, dim))
        biases = self.keys_values.bias.data.unflatten(0, (-1, 2, dim))
        weights.normal_(0, 0.005)
        weights[:, 0].normal_(0, CONTENT_GAIN * dim**-0.5)
        weights[:, 1] += COPY_GAIN * torch.eye(dim)
        biases.zero_()
        counts = rope.pairs_per_axis(dim // heads)
        share = torch.tensor([1.0] * (counts[0] + counts[1]) + [PRIOR_TIME] * counts[2])
        strength = PRIOR_SPACE[0] * torch.logspace(0, 1, len(biases), PRIOR_SPACE[1] / PRIOR_SPACE[0])
        prior = (strength[:, None] * share / self.scale).sqrt() * self.config.rope
        prior = torch.cat([prior, torch.zeros_like(prior)], 1).repeat(1, heads)
        biases[:, 0] = prior
        for block, bias in zip(self.blocks, prior, strict=True):
            assert isinstance(block, Block)
            nn.init.normal_(block.query.weight, 0, CONTENT_GAIN * dim**-0.5)
            block.query.bias.data.copy_(bias)
            last = block.ffn[-1]
            assert isinstance(last, nn.Linear)
            last.weight.data.mul_(0.2)
            nn.init.zeros_(last.bias)

    def project_context(self, tokens: Float[Tensor, "token dim"]) -> Float[Tensor, "block 2 token dim"]:
        """K = W_K R and V = W_V R of every block, before any rotation: what a cache keeps."""
        return rearrange(self.keys_values(tokens), "n (b two d) -> b two n d", two=2, d=self.config.dim)

    def forward(
        self,
        tokens: Float[Tensor, "sample query dim"],
        at: TokenPositions,
        keys_values: Float[Tensor, "block 2 sample key dim"],
        context_at: TokenPositions,
        top_k: int | None,
        guide: AttentionGuide | None = None,
    ) -> Float[Tensor, "sample query dim"]:
        """The input tokens after all blocks; only they change.

        A guide sees what the last group's first block looks at: all keys, by queries that have looked around before.
        """
        rotations = _Rotations(self, at, context_at)
        count = keys_values.shape[3]
        prune = top_k is not None and top_k < count
        for first in range(0, self.config.total_blocks, self.config.blocks):
            kept: Tensor | None = None
            weight: Tensor | None = None
            for number in range(first, first + self.config.blocks):
                block = self.blocks[number]
                assert isinstance(block, Block)
                KV = rearrange(keys_values[number], "two b n (h c) -> two b h n c", h=self.config.heads)
                Q = rearrange(block.query(block.norm_query(tokens)), "b n (h c) -> b h n c", h=self.config.heads)
                Q = rotations.query(Q)
                if guide is not None and number == self.config.total_blocks - self.config.blocks:
                    guide.look(Q, rotations.context(KV, None)[0], context_at.present, self.scale)
                if number == first and prune and self.config.blocks > 1:
                    assert top_k is not None
                    K, V, present = rotations.context(KV, None)
                    looked, received = attend_and_sum(Q, K, V, present, at.present, self.scale)
                    if torch.is_grad_enabled():
                        weight = straight_through(received, present, top_k)
                    else:
                        kept = most_attended(received.masked_fill(~present, -1.0), top_k)
                elif weight is not None:
                    K, V, _ = rotations.context(KV, None)
                    looked = attend_weighted(Q, K, V, weight.to(Q.dtype), self.scale)
                else:
                    K, V, present = rotations.context(KV, kept)
                    looked = attend(Q, K, V, present, self.scale)
                tokens = tokens + rearrange(rotations.back(looked), "b h n c -> b n (h c)")
                tokens = tokens + block.ffn(block.norm_ffn(tokens))
        return tokens


class _Rotations:
    """The rotations of one forward pass, which all blocks share."""

    def __init__(self, transformer: Transformer, at: TokenPositions, context_at: TokenPositions) -> None:
        config = transformer.config
        self.present = context_at.present
        self.score = self.value = None
        if config.rope:
            f = transformer.score_frequencies
            unit = f.new_tensor([rope.UNIT_STEPS, rope.UNIT_STEPS, 1.0])
            where = [x.uvs if config.rope_unit == "image" else x.steps / unit for x in (at, context_at)]
            self.score = tuple(_cos_sin(rope.angles(x, f)) for x in where)
        if config.rope_values:
            f = transformer.value_frequencies
            at_query, at_key = (rope.angles(x.steps, f) for x in (at, context_at))
            self.value = (_cos_sin(-at_query), _cos_sin(at_key))

    def query(self, Q: Tensor) -> Tensor:
        return Q if self.score is None else rope.rotate(Q, self.score[0])

    def back(self, looked: Tensor) -> Tensor:
        return looked if self.value is None else rope.rotate(looked, self.value[0])

    def context(self, KV: Tensor, kept: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Rotated K and V of the kept keys and which of these count."""
        present, rotations = self.present, [None if r is None else r[1] for r in (self.score, self.value)]
        if kept is not None:
            present = present.gather(1, kept)
            index = kept[:, None, :, None]
            KV = KV.gather(3, index.expand(2, -1, KV.shape[2], -1, KV.shape[4]))
            rotations = [None if r is None else r.gather(3, index.expand(2, -1, -1, -1, r.shape[4])) for r in rotations]
        K, V = (x if r is None else rope.rotate(x, r) for x, r in zip(KV, rotations, strict=True))
        return K, V, present


def _cos_sin(angle: Float[Tensor, "sample token pair"]) -> Float[Tensor, "2 sample 1 token pair"]:
    """Every head and block is rotated by the same angles."""
    return rope.cos_sin(angle)[:, :, None]
