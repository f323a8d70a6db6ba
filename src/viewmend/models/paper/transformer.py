"""The transformer (section 6): rotary embedding, attention, pruning, and blocks.

P <- P + A(W_Q norm(P), W_K R, W_V R); P <- P + FFN(norm(P)).
"""

import math
from dataclasses import dataclass

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.models.paper.config import PaperConfig
from viewmend.utils.cancellation import stop_if_cancelled

Queries = Float[Tensor, "sample head query channel"]
Keys = Float[Tensor, "sample head key channel"]
"""Keys, or the values that belong to them."""
KeysValues = Float[Tensor, "block 2 sample key dim"]
"""K and V of every block, before rotation."""
PerKey = Float[Tensor, "sample key"]
Tokens = Float[Tensor, "sample query dim"]
LONGEST = 2.0
"""Wavelength of the slowest rotation, in image widths (or temporal windows)."""
SHORTEST = 0.1
"""Wavelength of the fastest rotation: two patch steps of a 320 pixel image."""
CHUNK_ENTRIES = 1 << 22
"""Number of attention weights held in memory at once by `attend_and_sum`."""


def rope_frequencies(head_dim: int) -> Float[Tensor, "3 pair"]:
    """Radians per unit of (u, v, s) for each pair of channels: geometric along its axis, 0 for the other axes."""
    pairs = head_dim // 2
    three_eighths = 3 * pairs // 8
    per_axis = (three_eighths, three_eighths, pairs - 2 * three_eighths)  # of u, v and s
    octaves = (torch.linspace(0, 1, count, dtype=torch.float64) for count in per_axis)
    return torch.block_diag(*(2 * math.pi / LONGEST * (LONGEST / SHORTEST) ** x for x in octaves)).float()


def rope_factors(
    coordinates: Float[Tensor, "*batch 3"], frequencies: Float[Tensor, "3 pair"]
) -> Float[Tensor, "2 *batch channel"]:
    """The factors of each channel and of the other channel of its pair in `rotate`, at these (u, v, s)."""
    # A sum of products, not a matrix product: autocast would round the angles to bfloat16.
    angles = (coordinates[..., None] * frequencies).sum(-2)
    cos = angles.cos()
    sin = angles.sin()
    return torch.stack([torch.cat([cos, cos], -1), torch.cat([-sin, sin], -1)])


def rotate(
    x: Float[Tensor, "*batch channel"], factors: Float[Tensor, "2 *#batch channel"]
) -> Float[Tensor, "*batch channel"]:
    """RoPE(x): pairs of channels (i, i + channel / 2) rotated by `rope_factors`, which have the type of x."""
    of_own, of_other = factors
    return torch.addcmul(x * of_own, x.roll(x.shape[-1] // 2, -1), of_other)


@dataclass(frozen=True)
class KeyMask:
    """The keys that attention keeps."""

    added: Float[Tensor, "sample 1 1 key"]
    """Added to scores: 0 for a key to keep, -inf for others; 0 for all keys of a sample that keeps none."""
    any_kept: Bool[Tensor, "sample 1 1 1"]
    """Whether a sample keeps any key."""

    @classmethod
    def of(cls, keep: Bool[Tensor, "sample key"], dtype: torch.dtype) -> "KeyMask":
        """The mask of these keys, for scores of this type."""
        any_kept = keep.any(1)[:, None, None, None]
        added = torch.where(keep[:, None, None] | ~any_kept, 0.0, -torch.inf).to(dtype)
        return cls(added, any_kept)


def attend(Q: Queries, K: Keys, V: Keys, mask: KeyMask, scale: float) -> Queries:
    """softmax(Q K^T scale) V over the keys to keep, by the fused kernel; 0 for a sample that keeps none."""
    added = mask.added.expand(-1, -1, Q.shape[2], -1)
    return F.scaled_dot_product_attention(Q, K, V, attn_mask=added, scale=scale) * mask.any_kept


def attend_and_sum(
    Q: Queries,
    K: Keys,
    V: Keys,
    mask: KeyMask,
    counted: Bool[Tensor, "sample query"],
    scale: float,
) -> tuple[Queries, PerKey]:
    """`attend`, and the attention that each key received, summed over heads and the counted queries.

    Queries are processed in chunks, so that the whole attention matrix is never in memory.
    """
    samples, heads, queries, _ = Q.shape
    step = max(1, CHUNK_ENTRIES // (samples * heads * K.shape[2]))
    outs = []
    received = Q.new_zeros(K.shape[0], K.shape[2], dtype=torch.float32)
    for start in range(0, queries, step):
        scores = (Q[:, :, start : start + step] @ K.mT) * scale + mask.added
        weights = scores.float().softmax(-1) * mask.any_kept
        outs.append(weights.to(V.dtype) @ V)
        received = received + (weights * counted[:, None, start : start + step, None]).sum((1, 2))
    return torch.cat(outs, 2), received


def attend_weighted(Q: Queries, K: Keys, V: Keys, weight: PerKey, scale: float) -> Queries:
    """Attention with a weight per key (0 leaves it out) that has a gradient even where it is 0."""
    scores = (Q @ K.mT) * scale
    top = scores.masked_fill(weight[:, None, None] <= 0, -torch.inf).amax(-1, keepdim=True).detach()
    # A pruned key may score far above the kept ones; without the bound its gradient could overflow.
    odds = (scores - top.nan_to_num(neginf=0.0)).clamp_max(20).exp() * weight[:, None, None]
    return (odds / odds.sum(-1, keepdim=True).clamp_min(1e-20)) @ V


def most_attended(received: PerKey, k: int) -> Int[Tensor, "sample kept"]:
    """Indices of the k keys that received most attention, in ascending order; all keys if there are fewer."""
    return received.topk(min(k, received.shape[1]), 1, sorted=False).indices.sort(1).values


def straight_through(received: PerKey, keep: Bool[Tensor, "sample key"], k: int) -> PerKey:
    """1 for the k keys to keep that received most attention, 0 for the others.

    The gradient is that of received / (received + threshold), 1/2 where the hard mask steps from 0
    to 1, so that pruned keys are trained, too.
    """
    if k >= received.shape[1]:
        return keep.to(received.dtype)
    ranked = received.masked_fill(~keep, -1.0)
    kept = torch.zeros_like(keep).scatter(1, most_attended(ranked, k), True) & keep
    threshold = ranked.topk(k, 1).values[:, -1:].clamp_min(1e-9).detach()
    soft = received / (received + threshold)
    return kept.to(received.dtype) + torch.where(keep, soft - soft.detach(), 0.0)


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
        hidden = config.ffn_ratio * config.dim
        self.norm_query = nn.LayerNorm(dim)
        self.query = nn.Linear(dim, dim)
        self.norm_ffn = nn.LayerNorm(dim)
        self.ffn = nn.Sequential(nn.Linear(dim, hidden), nn.GELU(), nn.Linear(hidden, dim))


@dataclass(frozen=True)
class Context:
    """Keys and values of the context tokens, and the rotations shared by all blocks (None without RoPE)."""

    keys_values: KeysValues
    present: Bool[Tensor, "sample key"]
    key_rotation: Float[Tensor, "2 sample 1 key channel"] | None
    query_rotation: Float[Tensor, "2 sample 1 query channel"] | None


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
        tokens: Tokens,
        at: TokenPositions,
        keys_values: KeysValues,
        context_at: TokenPositions,
        top_k: int | None,
    ) -> Tokens:
        """The input tokens P after all blocks; each group prunes its context to `top_k` tokens, None for no pruning."""
        rotations = [None, None]
        if self.config.rope:
            factors = [rope_factors(x.uvs, self.frequencies) for x in (context_at, at)]
            rotations = [own[:, :, None].to(keys_values.dtype) for own in factors]
        context = Context(keys_values, context_at.present, *rotations)
        for group in range(self.config.groups):
            tokens = self.run_group(group, tokens, at.present, context, top_k)
        return tokens

    def run_group(
        self,
        group: int,
        tokens: Tokens,
        counted: Bool[Tensor, "sample query"],
        context: Context,
        top_k: int | None,
    ) -> Tokens:
        """The input tokens after one group. Attention of the counted tokens decides what its first block prunes."""
        present = context.present
        mask = KeyMask.of(present, context.keys_values.dtype)
        kept: Tensor | None = None
        weight: Tensor | None = None
        for number in range(self.config.blocks):
            stop_if_cancelled()
            index = group * self.config.blocks + number
            block = self.blocks[index]
            assert isinstance(block, Block)
            Q, K, V = self.project(index, tokens, context, kept)
            if number == 0 and self.config.blocks > 1 and top_k is not None and top_k < K.shape[2]:
                attended, received = attend_and_sum(Q, K, V, mask, counted, self.scale)
                if torch.is_grad_enabled():
                    weight = straight_through(received, present, top_k)
                else:
                    kept = most_attended(received.masked_fill(~present, -1.0), top_k)
                    mask = KeyMask.of(present.gather(1, kept), K.dtype)
            elif weight is not None:
                attended = attend_weighted(Q, K, V, weight.to(Q.dtype), self.scale)
            else:
                attended = attend(Q, K, V, mask, self.scale)
            tokens = tokens + rearrange(attended, "b h n c -> b n (h c)")
            tokens = tokens + block.ffn(block.norm_ffn(tokens))
        return tokens

    def project(
        self, index: int, tokens: Tokens, context: Context, kept: Int[Tensor, "sample kept"] | None = None
    ) -> tuple[Queries, Keys, Keys]:
        """RoPE(Q), RoPE(K) and V of a block; of the kept keys alone, if given."""
        block = self.blocks[index]
        heads = self.config.heads
        assert isinstance(block, Block)
        Q = rearrange(block.query(block.norm_query(tokens)), "b n (h c) -> b h n c", h=heads)
        KV = rearrange(context.keys_values[index], "two b n (h c) -> two b h n c", h=heads)
        rotation = context.key_rotation
        if kept is not None:
            pick = kept[:, None, :, None]
            KV = KV.gather(3, pick.expand(2, -1, heads, -1, KV.shape[4]))
            if rotation is not None:
                rotation = rotation.gather(3, pick.expand(2, -1, -1, -1, rotation.shape[4]))
        K, V = KV
        if rotation is not None and context.query_rotation is not None:
            Q = rotate(Q, context.query_rotation)
            K = rotate(K, rotation)
        return Q, K, V
