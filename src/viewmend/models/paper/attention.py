"""Rotary embedding, attention of input tokens to context tokens, and pruning of the context (section 6)."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

LONGEST = 2.0
"""Wavelength of the slowest rotation, in image widths (or temporal windows)."""
SHORTEST = 0.1
"""Wavelength of the fastest rotation: two patch steps of a 320 pixel image."""
CHUNK_ENTRIES = 1 << 22
"""Number of attention weights held in memory at once by `attend_and_sum`."""


def pairs_per_axis(head_dim: int) -> tuple[int, int, int]:
    """Pairs of channels of a head rotated by u, v and s: three eighths, three eighths and a quarter."""
    pairs = head_dim // 2
    return 3 * pairs // 8, 3 * pairs // 8, pairs - 2 * (3 * pairs // 8)


def rope_frequencies(head_dim: int) -> Float[Tensor, "3 pair"]:
    """Radians per unit of (u, v, s) for each pair of channels: geometric along its axis, 0 for the other axes."""
    octaves = (torch.linspace(0, 1, pairs, dtype=torch.float64) for pairs in pairs_per_axis(head_dim))
    return torch.block_diag(*(2 * math.pi / LONGEST * (LONGEST / SHORTEST) ** x for x in octaves)).float()


def rope_cos_sin(
    coordinates: Float[Tensor, "*batch 3"], frequencies: Float[Tensor, "3 pair"]
) -> Float[Tensor, "2 *batch pair"]:
    """Cosine and sine of the rotation angles at these (u, v, s)."""
    # A sum of products, not a matrix product: autocast would round the angles to bfloat16.
    angles = (coordinates[..., None] * frequencies).sum(-2)
    return torch.stack([angles.cos(), angles.sin()])


def rotate(
    x: Float[Tensor, "*batch channel"], cos_sin: Float[Tensor, "2 *#batch channel/2"]
) -> Float[Tensor, "*batch channel"]:
    """RoPE(x): pairs (i, i + channel / 2) rotated by the angles of `rope_cos_sin`, in the precision of x."""
    cos, sin = cos_sin.to(x.dtype)
    first, second = x.chunk(2, -1)
    return torch.cat([first * cos - second * sin, second * cos + first * sin], -1)


def attend(
    Q: Float[Tensor, "sample head query channel"],
    K: Float[Tensor, "sample head key channel"],
    V: Float[Tensor, "sample head key channel"],
    keep: Bool[Tensor, "sample key"] | None,
    scale: float,
) -> Float[Tensor, "sample head query channel"]:
    """softmax(Q K^T scale) V over the keys to keep, by the fused kernel; 0 for a sample that keeps none."""
    if keep is None:
        return F.scaled_dot_product_attention(Q, K, V, scale=scale)
    any_kept = keep.any(1)
    mask = (keep | ~any_kept[:, None])[:, None, None].expand(-1, -1, Q.shape[2], -1)
    out = F.scaled_dot_product_attention(Q, K, V, attn_mask=mask, scale=scale)
    return torch.where(any_kept[:, None, None, None], out, 0.0)


def attend_and_sum(
    Q: Float[Tensor, "sample head query channel"],
    K: Float[Tensor, "sample head key channel"],
    V: Float[Tensor, "sample head key channel"],
    keep: Bool[Tensor, "sample key"],
    counted: Bool[Tensor, "sample query"],
    scale: float,
) -> tuple[Float[Tensor, "sample head query channel"], Float[Tensor, "sample key"]]:
    """`attend`, and the attention that each key received, summed over heads and the counted queries.

    Queries are processed in chunks, so that the whole attention matrix is never in memory.
    """
    samples, heads, queries, _ = Q.shape
    step = max(1, CHUNK_ENTRIES // (samples * heads * K.shape[2]))
    any_kept = keep.any(1)[:, None, None, None]
    mask = torch.where(keep[:, None, None] | ~any_kept, 0.0, -torch.inf).to(Q.dtype)
    outs, received = [], Q.new_zeros(K.shape[0], K.shape[2], dtype=torch.float32)
    for start in range(0, queries, step):
        scores = (Q[:, :, start : start + step] @ K.mT) * scale + mask
        weights = scores.float().softmax(-1) * any_kept
        outs.append(weights.to(V.dtype) @ V)
        received = received + (weights * counted[:, None, start : start + step, None]).sum((1, 2))
    return torch.cat(outs, 2), received


def attend_weighted(
    Q: Float[Tensor, "sample head query channel"],
    K: Float[Tensor, "sample head key channel"],
    V: Float[Tensor, "sample head key channel"],
    weight: Float[Tensor, "sample key"],
    scale: float,
) -> Float[Tensor, "sample head query channel"]:
    """Attention with a weight per key (0 leaves it out) that has a gradient even where it is 0."""
    scores = (Q @ K.mT) * scale
    top = scores.masked_fill(weight[:, None, None] <= 0, -torch.inf).amax(-1, keepdim=True).detach()
    # A pruned key may score far above the kept ones; without the bound its gradient could overflow.
    odds = (scores - top.nan_to_num(neginf=0.0)).clamp_max(20).exp() * weight[:, None, None]
    return (odds / odds.sum(-1, keepdim=True).clamp_min(1e-20)) @ V


def most_attended(received: Float[Tensor, "sample key"], k: int) -> Int[Tensor, "sample kept"]:
    """Indices of the k keys that received most attention, in ascending order; all keys if there are fewer."""
    return received.topk(min(k, received.shape[1]), 1, sorted=False).indices.sort(1).values


def straight_through(
    received: Float[Tensor, "sample key"], keep: Bool[Tensor, "sample key"], k: int
) -> Float[Tensor, "sample key"]:
    """1 for the k keys to keep that received most attention, 0 for the others.

    The gradient is that of received / (received + threshold), 1/2 where the hard mask steps from 0 to 1, so that
    pruned keys are trained, too.
    """
    if k >= received.shape[1]:
        return keep.to(received.dtype)
    ranked = received.masked_fill(~keep, -1.0)
    kept = torch.zeros_like(keep).scatter(1, most_attended(ranked, k), True) & keep
    threshold = ranked.topk(k, 1).values[:, -1:].clamp_min(1e-9).detach()
    soft = received / (received + threshold)
    return kept.to(received.dtype) + torch.where(keep, soft - soft.detach(), 0.0)
