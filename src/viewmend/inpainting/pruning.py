"""Which context tokens are worth keeping: those that the first block of a group looked at most (section 6)."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def most_attended(received: Float[Tensor, "sample key"], k: int) -> Int[Tensor, "sample kept"]:
    """Indices of the k keys that received most attention, in their old order; all of them if there are fewer."""
    return received.topk(min(k, received.shape[1]), 1, sorted=False).indices.sort(1).values


def straight_through(
    received: Float[Tensor, "sample key"], keep: Bool[Tensor, "sample key"], k: int
) -> Float[Tensor, "sample key"]:
    """1 for the k keys that received most attention among those to keep, 0 for the others.

    Its gradient is that of received / (received + threshold), which is 1/2 where the hard mask steps: a key that is
    left out still learns whether it should have been looked at.
    """
    if k >= received.shape[1]:
        return keep.to(received.dtype)
    ranked = received.masked_fill(~keep, -1.0)
    kept = torch.zeros_like(keep).scatter(1, most_attended(ranked, k), True) & keep
    threshold = ranked.topk(k, 1).values[:, -1:].clamp_min(1e-9).detach()
    soft = received / (received + threshold)
    return kept.to(received.dtype) + torch.where(keep, soft - soft.detach(), 0.0)
