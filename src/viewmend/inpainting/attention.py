"""Attention of the input tokens to the context tokens (section 6)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

CHUNK_ENTRIES = 1 << 22
"""Attention weights in memory at once where their sums are wanted."""


def attend(
    Q: Float[Tensor, "sample head query channel"],
    K: Float[Tensor, "sample head key channel"],
    V: Float[Tensor, "sample head key channel"],
    keep: Bool[Tensor, "sample key"] | None,
    scale: float,
) -> Float[Tensor, "sample head query channel"]:
    """softmax(Q K^T scale) V over the keys to keep, by the fused kernel; zeros for a sample that keeps none."""
    if keep is None:
        return F.scaled_dot_product_attention(Q, K, V, scale=scale)
    some = keep.any(1)
    mask = (keep | ~some[:, None])[:, None, None].expand(-1, -1, Q.shape[2], -1)
    out = F.scaled_dot_product_attention(Q, K, V, attn_mask=mask, scale=scale)
    return torch.where(some[:, None, None, None], out, 0.0)


def attend_weighted(
    Q: Float[Tensor, "sample head query channel"],
    K: Float[Tensor, "sample head key channel"],
    V: Float[Tensor, "sample head key channel"],
    weight: Float[Tensor, "sample key"],
    scale: float,
) -> Float[Tensor, "sample head query channel"]:
    """Attention whose keys count by a weight (0: left out), through which gradients flow even where it is 0."""
    scores = (Q @ K.mT) * scale
    top = scores.masked_fill(weight[:, None, None] <= 0, -torch.inf).amax(-1, keepdim=True).detach()
    # A left-out key may score far above the kept ones: without the bound its gradient could overflow.
    odds = (scores - top.nan_to_num(neginf=0.0)).clamp_max(20).exp() * weight[:, None, None]
    return (odds / odds.sum(-1, keepdim=True).clamp_min(1e-20)) @ V


def attend_and_sum(
    Q: Float[Tensor, "sample head query channel"],
    K: Float[Tensor, "sample head key channel"],
    V: Float[Tensor, "sample head key channel"],
    keep: Bool[Tensor, "sample key"],
    asks: Bool[Tensor, "sample query"],
    scale: float,
) -> tuple[Float[Tensor, "sample head query channel"], Float[Tensor, "sample key"]]:
    """`attend`, and the attention each key received, summed over heads and the queries that ask.

    A few queries at a time, so that the whole matrix of weights never exists.
    """
    samples, heads, queries, _ = Q.shape
    step = max(1, CHUNK_ENTRIES // (samples * heads * K.shape[2]))
    some = keep.any(1)[:, None, None, None]
    mask = torch.where(keep[:, None, None] | ~some, 0.0, -torch.inf).to(Q.dtype)
    outs, received = [], Q.new_zeros(K.shape[0], K.shape[2], dtype=torch.float32)
    for start in range(0, queries, step):
        scores = (Q[:, :, start : start + step] @ K.mT) * scale + mask
        weights = scores.float().softmax(-1) * some
        outs.append(weights.to(V.dtype) @ V)
        counted = asks[:, None, start : start + step, None]
        received = received + (weights * counted).sum((1, 2))
    return torch.cat(outs, 2), received
