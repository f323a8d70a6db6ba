"""Recognises masks whose values are labels, or whose opaque level is low, and makes them opaque."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import UInt8
from torch import Tensor

from viewmend.data.images import MAX_LABELS

Masks = UInt8[Tensor, "view height width"]


@dataclass(frozen=True)
class LabelMaskRule:
    """Thresholds by which masks are recognised as labels, or as opacities with a low opaque level."""

    opaque: int = 250
    """A mask is opaque if some pixel has at least this value of 255."""
    max_labels: int = MAX_LABELS
    """Masks without an opaque pixel hold labels if they have at most this many values in all."""
    min_compact: float = 0.5
    """Masks of which none is opaque hold labels only if at least this share of the foreground has foreground
    to its right and below it; noise has less."""
    min_share: float = 0.005
    """A single mask holds a label only if at least this share of its pixels has it, and at least
    this share is 0."""
    min_one_level: float = 0.8
    """A mask has one level if at least this share of its foreground is at that level; edges have
    other values."""
    max_spread: float = 0.25
    """A pixel of masks with many values is at their level if it differs from it by at most this
    share of the level."""


@dataclass(frozen=True)
class ConvertedMasks:
    """Masks that were made opaque, and how."""

    mask: Masks
    views: tuple[int, ...] | None
    """The views whose masks were converted; None for all."""
    highest: int
    """The highest value of these masks before."""
    explanation: str
    """How the masks were converted, for a message."""


class LabelMasks:
    """Converts the masks of the frames of a capture. It remembers whether any mask so far was opaque."""

    def __init__(self) -> None:
        self._rule = LabelMaskRule()
        self._seen_opaque = False

    def convert(self, mask: Masks) -> ConvertedMasks | None:
        """The masks of a frame with labels as 255; None if they stay as they are.

        As long as no mask was opaque, all masks hold labels if they have few values and these form areas;
        they have a low opaque level if nearly all of their foreground is at one level. Once a mask was
        opaque, each other mask is judged by itself: it holds a label if it consists of 0 and one low value.
        """
        highest = mask.flatten(1).amax(1).tolist()
        self._seen_opaque = self._seen_opaque or max(highest) >= self._rule.opaque
        if self._seen_opaque:
            views = _views_with_one_label(mask, highest, self._rule)
            return (
                _from_labels(mask, views, tuple(views), max(highest[view] for view in views))
                if views
                else None
            )
        if not any(highest):
            return None
        count = len(torch.bincount(mask.flatten(), minlength=256).nonzero())
        if count <= self._rule.max_labels:
            if _compact_share(mask) < self._rule.min_compact:
                return None
            return _from_labels(mask, range(len(mask)), None, max(highest))
        return _from_low_level(mask, max(highest), self._rule)


def _compact_share(mask: Masks) -> float:
    """The share of the foreground whose right and lower neighbours are foreground as well."""
    inside = mask > 0
    inner = inside[:, :-1, :-1]
    is_compact = inner & inside[:, :-1, 1:] & inside[:, 1:, :-1]
    return int(is_compact.sum()) / max(int(inner.sum()), 1)


def _views_with_one_label(mask: Masks, highest: Sequence[int], rule: LabelMaskRule) -> list[int]:
    """The views whose masks consist of 0 and one low value.

    Such a mask may also be nearly transparent; it counts as a label if neither 0 nor the value is rare.
    """
    size = mask[0].numel()
    least = rule.min_share * size
    found = []
    for view, top in enumerate(highest):
        if top >= rule.opaque:
            continue
        inside = int(mask[view].count_nonzero())
        labelled = int((mask[view] == top).sum())
        is_common = least < inside < size - least
        if is_common and labelled >= max(least, rule.min_one_level * inside):
            found.append(view)
    return found


def _from_labels(
    mask: Masks, views: Sequence[int], named: tuple[int, ...] | None, highest: int
) -> ConvertedMasks:
    converted = mask.clone()
    chosen = list(views)
    converted[chosen] = 255 * (mask[chosen] > 0).to(torch.uint8)
    return ConvertedMasks(converted, named, highest, "they are read as labels, with 0 as background")


def _from_low_level(mask: Masks, highest: int, rule: LabelMaskRule) -> ConvertedMasks | None:
    """The masks scaled so that the level of their foreground is opaque; None if it has no common level."""
    values = mask[mask > highest // 4].float()
    level = float(values.median()) if len(values) else 0.0
    at_level = (values - level).abs() <= rule.max_spread * level
    if float(at_level.float().mean()) < rule.min_one_level:
        return None
    scaled = (mask * (255 / level)).round().clamp(max=255).to(torch.uint8)
    return ConvertedMasks(scaled, None, highest, f"they are scaled, with {level:.0f} as opaque")
