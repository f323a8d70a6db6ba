"""Attention supervised by true correspondences, for `pretrain_paper.py`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.models.paper.context import ContextFrame
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.paper.patches import PATCH_PX, STEP_PX
from viewmend.types import IncompleteView


@dataclass(frozen=True)
class Correspondences:
    """Where cameras truly saw, now and before, the surface points that some pixels of a view are missing."""

    names: tuple[str, ...]
    """The cameras."""
    pixels: Int[Tensor, "match 2"]
    """Row and column in the view."""
    camera: Int[Tensor, "match"]
    """Index into `names` of the camera that saw the point."""
    time: Int[Tensor, "match"]
    """Frame number at which it did."""
    uv_px: Float[Tensor, "match 2"]
    """Position in that camera's image, in pixels."""


def attention_losses(
    net: PatchTransformer,
    views: Sequence[IncompleteView],
    contexts: Sequence[Sequence[ContextFrame]],
    matches: Sequence[Correspondences],
) -> list[Float[Tensor, ""]]:
    """`missed_attention` of the last group's first block, for each view that has sought keys.

    Args:
        net: the model.
        views: the views to complete.
        contexts: their encoded context.
        matches: where the cameras truly saw what each view is missing.
    """
    targets = net.encode_targets(views)
    chosen = [i for i, target in enumerate(targets) if bool(target.incomplete.any())]
    if not chosen:
        return []
    targets, contexts = [targets[i] for i in chosen], [contexts[i] for i in chosen]
    batch, transformer, last = net.collate(targets, contexts), net.transformer, net.config.groups - 1
    size = (len(chosen), batch.at.present.shape[1], batch.context_at.present.shape[1])
    sought = torch.zeros(size, dtype=torch.bool, device=batch.queries.device)
    for n, (target, frames) in enumerate(zip(targets, contexts, strict=True)):
        found = find_sought_keys(matches[chosen[n]], target.places[target.incomplete], frames)
        sought[n, : found.shape[0], : found.shape[1]] = found
    with net.autocast():
        context, tokens = transformer.place_context(batch.at, batch.keys_values, batch.context_at), batch.queries
        for group in range(last):
            tokens = transformer.run_group(group, tokens, batch.at.present, context, net.config.top_k)
        Q, K, _, present = transformer.project(last * net.config.blocks, tokens, context)
        return [loss for loss in missed_attention(Q, K, present, sought, transformer.scale) if loss is not None]


def missed_attention(
    Q: Float[Tensor, "sample head query channel"],
    K: Float[Tensor, "sample head key channel"],
    present: Bool[Tensor, "sample key"],
    sought: Bool[Tensor, "sample query key"],
    scale: float,
) -> list[Float[Tensor, ""] | None]:
    """Cross-entropy of each sample's attention in nats; None for a sample without sought keys.

    It is -log of the share of attention, averaged over heads, that sought keys receive, averaged over the queries that
    have any.
    """
    scores = ((Q @ K.mT) * scale).float().masked_fill(~present[:, None, None], -torch.inf)
    sought = sought & present[:, None]
    seeking = sought.any(2)
    scores = torch.where(seeking[:, None, :, None], scores, 0.0)  # without a present key all would be -inf
    masked = scores.masked_fill(~(sought | ~seeking[..., None])[:, None], -torch.inf)
    found = masked.logsumexp(3) - scores.logsumexp(3)
    per_query = -(found.logsumexp(1) - math.log(found.shape[1]))
    return [loss[own].mean() if bool(own.any()) else None for loss, own in zip(per_query, seeking, strict=True)]


def find_sought_keys(
    matches: Correspondences, queries: Int[Tensor, "query 3"], frames: Sequence[ContextFrame]
) -> Bool[Tensor, "query key"]:
    """Which patches of the frames, one frame after the other, contain a surface point that a query is missing.

    Args:
        matches: of the view.
        queries: places of its incomplete patches; a pixel belongs to the patch with the nearest centre.
        frames: its context.
    """
    of_pixel = _find_patches((matches.pixels + 0.5).flip(1), queries[:, 1:], STEP_PX / 2)
    parts = []
    for frame in frames:
        there = matches.time == frame.time
        if frame.name in matches.names:
            there = there & (matches.camera == matches.names.index(frame.name))
        else:
            there = torch.zeros_like(there)
        holds = _find_patches(matches.uv_px[there], frame.places, PATCH_PX / 2)
        parts.append((of_pixel[there].float().mT @ holds.float()) > 0)
    return torch.cat(parts, 1) if parts else of_pixel.new_zeros(len(queries), 0)


def _find_patches(
    uv_px: Float[Tensor, "point 2"], places: Int[Tensor, "patch 2"], reach_px: float
) -> Bool[Tensor, "point patch"]:
    """Which patches (row, column) have a point within this distance of their centre, along both axes."""
    offset = uv_px[:, None] - (places.flip(1) * STEP_PX + PATCH_PX / 2)
    return ((offset >= -reach_px) & (offset < reach_px)).all(2)
