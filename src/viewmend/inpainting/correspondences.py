"""Attention taught by true correspondences, which a studio knows: does a query look where its surface is? Ours."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.inpainting.context import ContextFrame
from viewmend.inpainting.patches import PATCH_PX, STEP_PX


@dataclass(frozen=True)
class Correspondences:
    """Where cameras truly saw, now and before, the surface points that some pixels of a view miss."""

    names: tuple[str, ...]
    """The cameras."""
    pixels: Int[Tensor, "match 2"]
    """Row and column in the view."""
    camera: Int[Tensor, "match"]
    """Which of `names` saw it."""
    time: Int[Tensor, "match"]
    """When."""
    uv_px: Float[Tensor, "match 2"]
    """Where in that camera's image."""

    def select(self, kept: Bool[Tensor, "match"]) -> "Correspondences":
        """Some of them."""
        return Correspondences(
            self.names, self.pixels[kept], self.camera[kept], self.time[kept], self.uv_px[kept].contiguous()
        )


def sought_keys(
    matches: Correspondences, queries: Int[Tensor, "query 3"], frames: Sequence[ContextFrame]
) -> Bool[Tensor, "query key"]:
    """Which patches of the frames, one frame after the other, hold a surface point that a query misses.

    Args:
        matches: of the view.
        queries: places of its incomplete patches; a pixel is of the one whose centre is nearest.
        frames: its context.
    """
    of_pixel = _patches_at((matches.pixels + 0.5).flip(1), queries[:, 1:], nearest=True)
    parts = []
    for frame in frames:
        there = matches.time == frame.time
        if frame.name in matches.names:
            there = there & (matches.camera == matches.names.index(frame.name))
        else:
            there = torch.zeros_like(there)
        holds = _patches_at(matches.uv_px[there], frame.places)
        parts.append((of_pixel[there].float().mT @ holds.float()) > 0)
    return torch.cat(parts, 1) if parts else of_pixel.new_zeros(len(queries), 0)


def _patches_at(
    uv_px: Float[Tensor, "point 2"], places: Int[Tensor, "patch 2"], nearest: bool = False
) -> Bool[Tensor, "point patch"]:
    """Which patches (row, column) hold a point; or only the one of the grid whose centre is nearest, if it is there."""
    reach_px = STEP_PX / 2 if nearest else PATCH_PX / 2
    away = uv_px[:, None] - (places.flip(1) * STEP_PX + PATCH_PX / 2)
    return ((away >= -reach_px) & (away < reach_px)).all(2)


class AttentionGuide:
    """What one block of a transformer should look at, and, after its pass, what it has missed."""

    def __init__(self, sought: Bool[Tensor, "sample query key"]) -> None:
        self.sought = sought
        self.missed: list[Float[Tensor, ""] | None] = [None] * len(sought)
        """Cross-entropy of each sample, nats: -log of the share of attention, the mean of all heads, that sought keys
        got, the mean of the queries that seek any; None for a sample without."""

    def look(
        self,
        Q: Float[Tensor, "sample head query channel"],
        K: Float[Tensor, "sample head key channel"],
        present: Bool[Tensor, "sample key"],
        scale: float,
    ) -> None:
        """See a block's attention."""
        scores = ((Q @ K.mT) * scale).float().masked_fill(~present[:, None, None], -torch.inf)
        sought = self.sought & present[:, None]
        asks = sought.any(2)
        scores = torch.where(asks[:, None, :, None], scores, 0.0)  # without a present key all would be -inf
        found = scores.masked_fill(~(sought | ~asks[..., None])[:, None], -torch.inf).logsumexp(3) - scores.logsumexp(3)
        per_query = -(found.logsumexp(1) - math.log(found.shape[1]))
        self.missed = [m[own].mean() if bool(own.any()) else None for m, own in zip(per_query, asks, strict=True)]
