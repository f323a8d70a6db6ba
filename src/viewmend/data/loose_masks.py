"""Loose masks: how far a camera's mask extends beyond the subject, and the mask without that rim.

A mask that is looser than the subject contains background. It shows as a bright rim, and as pale
seams inside the completed subject where a camera's rim is sampled. Along the outline, each pixel is
compared with the mean colours of the subject and of the background nearby. The subject's share of
the pixels rises from 0 to 1 with the distance from the edge of the mask; the subject ends where the
share passes one half. One width per camera is enough: along an outline, widths differ by less than
the share of a single pixel can tell.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8

from viewmend.data.source import limit_size
from viewmend.geometry.hull import FOREGROUND
from viewmend.types import MultiViewFrame

Rgb = UInt8[np.ndarray, "height width 3"]
Mask = UInt8[np.ndarray, "height width"]
Plane = Float32[np.ndarray, "height width"]
Colours = Float32[np.ndarray, "height width 3"]
Inside = Bool[np.ndarray, "height width"]

LONGEST_PX = 1024
"""Masks are measured in images reduced to this longer side, pixels."""
REACH_PX = 8
"""Pixels deeper inside the mask than this are taken for subject."""
MIN_REACH_PX = 4
"""Subjects that are too small for this reach are not measured, pixels."""
SUBJECT_REACH = 1 / 16
"""The reach is at most this share of the root of the mask's area."""
OUTSIDE_PX = 2
"""Pixels farther outside the mask than this are taken for background."""
NEARBY = (3, 6, 12)
"""Mean colours are taken over squares of these sides, in reaches: the smallest in which there is enough."""
MIN_FILLED = 0.02
"""There is enough of the subject, or the background, if it fills this share of a square."""
NOISE = 8.0
"""Standard deviation of a pixel's colour around the mean nearby, of 255, in addition to the measured one."""
MIN_CONTRAST = 1.0
"""The squared distance of the colours of subject and background from which a pixel counts, in
variances."""
FULL_CONTRAST = 9.0
"""The squared distance from which a pixel counts fully, in variances."""
MIN_EVIDENCE = 0.25
"""A camera is measured if its outline's pixels count at least this much on average."""
TIGHT_PX = 1.15
"""The distance at which the subject's share passes one half in an exact mask, pixels. Pixels at its edge have
the distance 1."""
MIN_LOOSE_PX = 1.25
"""Masks that are looser than this are tightened, pixels of the reduced image. Exact masks of studio
scenes are measured to within 0.1, but a rim of a pixel costs less than a part that is cut off."""


@dataclass(frozen=True)
class LooseMasks:
    """The widths by which the masks of some cameras are too wide."""

    names: tuple[str, ...]
    """The cameras whose masks are loose."""
    widths: tuple[float, ...]
    """Width of the rim that is background, as a share of the longer side of the camera's image."""
    widths_px: tuple[float, ...]
    """The same in pixels of the images as stored."""

    @property
    def summary(self) -> str:
        """What was changed, for the user."""
        low = f"{min(self.widths_px):.1f}"
        high = f"{max(self.widths_px):.1f}"
        width = low if low == high else f"{low} to {high}"
        count = len(self.names)
        return (
            f"masks of {count} camera{'s' if count > 1 else ''} extend {width} pixels beyond the subject, judging by "
            "colour, and were tightened by that; use --no-tighten-masks to keep them"
        )

    def apply(self, frame: MultiViewFrame) -> MultiViewFrame:
        """Tighten the masks of a frame, whose images may be reduced; other cameras are unchanged."""
        assert frame.mask is not None, "masks were measured"
        mask = frame.mask.clone()
        for view, name in enumerate(frame.cameras.names):
            if name not in self.names:
                continue
            width, height = (int(side) for side in frame.cameras.size_px[view])
            rim_px = self.widths[self.names.index(name)] * max(width, height)
            own = mask[view, :height, :width]
            own.copy_(torch.from_numpy(tightened(own.cpu().contiguous().numpy(), rim_px)))
        return replace(frame, mask=mask)


def find_loose_masks(frame: MultiViewFrame) -> LooseMasks | None:
    """Measure the masks of one frame by its images; None if none is loose."""
    small = limit_size(frame, LONGEST_PX)
    if small.mask is None:
        return None
    found = {}
    for view, (width, height) in enumerate(small.cameras.size_px.tolist()):
        rgb = small.rgb[view, :, :height, :width].permute(1, 2, 0).contiguous().cpu().numpy()
        mask = small.mask[view, :height, :width].contiguous().cpu().numpy()
        loose_px = rim_width_px(rgb, mask)
        if loose_px is not None and loose_px > MIN_LOOSE_PX:
            found[small.cameras.names[view]] = loose_px / max(width, height)
    if not found:
        return None
    longest = frame.cameras.select([*found]).size_px.amax(1).tolist()
    in_pixels = tuple(share * side for share, side in zip(found.values(), longest, strict=True))
    return LooseMasks(tuple(found), tuple(found.values()), in_pixels)


def tightened(mask: Mask, rim_px: float) -> Mask:
    """The mask without a rim of this width, whose new edge is soft by the fraction of a pixel."""
    inside = (mask > FOREGROUND).astype(np.uint8)
    box = _box(inside, 1)
    if box is None:
        return mask
    distance = np.asarray(cv2.distanceTransform(inside[box], cv2.DIST_L2, cv2.DIST_MASK_5))
    kept = np.zeros_like(mask)
    kept[box] = np.minimum(mask[box], 255 * (distance - rim_px).clip(0, 1)).round()
    return kept


def rim_width_px(rgb: Rgb, mask: Mask) -> float | None:
    """Width of the background along the edge of a mask, pixels; about 0 or less for a tight mask.

    None if the subject is too small, looks like its background, or does not begin within `REACH_PX`.
    """
    inside = (mask > FOREGROUND).astype(np.uint8)
    reach_px = min(REACH_PX, round(SUBJECT_REACH * float(inside.sum()) ** 0.5))
    if reach_px < MIN_REACH_PX:
        return None
    box = _box(inside, NEARBY[-1] * reach_px // 2)
    assert box is not None, "the mask has an area"
    outline = _judge_outline(rgb[box].astype(np.float32), inside[box], reach_px)
    if outline is None or float(outline.evidence.mean()) < MIN_EVIDENCE:
        return None
    crossing_px = _half_way(outline, reach_px)
    return None if crossing_px is None else crossing_px - TIGHT_PX


class _Outline(NamedTuple):
    """The pixels of a mask between its edge and what is surely subject."""

    distance_px: Float[np.ndarray, "pixel"]
    """Distance from the nearest pixel outside the mask."""
    share: Float[np.ndarray, "pixel"]
    """The subject's share of the pixel, by its colour, in [0, 1]."""
    evidence: Float[np.ndarray, "pixel"]
    """How well the colours of subject and background differ there, in [0, 1]."""


def _judge_outline(
    image: Colours, inside: UInt8[np.ndarray, "height width"], reach_px: int
) -> _Outline | None:
    """The outline's pixels, compared with the colours nearby; None without sure subject or background."""
    core = np.asarray(cv2.erode(inside, _disc(reach_px)))
    near = np.asarray(cv2.dilate(inside, _disc(OUTSIDE_PX)))
    if not core.any() or near.all():
        return None
    subject = _colours_nearby(image, core.astype(np.float32), reach_px)
    background = _colours_nearby(image, (1 - near).astype(np.float32), reach_px)

    # The position of each pixel between both mean colours, and how many variances these are apart
    change = subject.mean - background.mean
    precision = change / (subject.variance + background.variance + NOISE**2)
    contrast = (change * precision).sum(-1)
    share = ((image - background.mean) * precision).sum(-1) / np.maximum(contrast, 1e-6)
    evidence = ((contrast - MIN_CONTRAST) / (FULL_CONTRAST - MIN_CONTRAST)).clip(0, 1)
    evidence *= subject.known & background.known

    distance = np.asarray(cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_5))
    rim = (inside > 0) & (core == 0)
    return _Outline(distance[rim], share.clip(0, 1)[rim], evidence[rim])


class _Nearby(NamedTuple):
    """Colours of some pixels around each pixel of an image."""

    mean: Colours
    variance: Colours
    known: Inside
    """Whether there is any such pixel nearby."""


def _colours_nearby(image: Colours, weight: Plane, reach_px: int) -> _Nearby:
    """Means and variances over the smallest square around each pixel in which enough pixels have a weight."""
    mean = np.zeros_like(image)
    variance = np.zeros_like(image)
    known = np.zeros(weight.shape, bool)
    for side in NEARBY:
        own_mean, own_variance, filled = _box_statistics(image, weight, side * reach_px + 1)
        new = ~known & (filled > MIN_FILLED)
        mean[new] = own_mean[new]
        variance[new] = own_variance[new]
        known |= new
    return _Nearby(mean, variance, known)


def _box_statistics(image: Colours, weight: Plane, side_px: int) -> tuple[Colours, Colours, Plane]:
    """Weighted means and variances over squares, and the share of each square that has a weight."""

    def blur(values: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.blur(values, (side_px, side_px), borderType=cv2.BORDER_CONSTANT))

    weighted = image * weight[..., None]
    filled = blur(weight)
    divisor = np.maximum(filled, 1e-6)[..., None]
    mean = blur(weighted) / divisor
    variance = (blur(weighted * image) / divisor - mean**2).clip(0)
    return mean, variance, filled


def _half_way(outline: _Outline, reach_px: int) -> float | None:
    """The distance from the mask's edge at which the mean share of the subject passes one half, pixels."""
    step = outline.distance_px.astype(int)
    total = np.bincount(step, outline.evidence, reach_px + 2)
    share = np.bincount(step, outline.evidence * outline.share, reach_px + 2) / np.maximum(total, 1e-6)
    past = np.flatnonzero(share[1 : reach_px + 1] >= 0.5)
    if not len(past):
        return None
    first = int(past[0]) + 1
    before = float(share[first - 1])
    return first - 0.5 + (0.5 - before) / (float(share[first]) - before)


def _disc(radius_px: int) -> UInt8[np.ndarray, "side side"]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1)))


def _box(inside: UInt8[np.ndarray, "height width"], margin_px: int) -> tuple[slice, slice] | None:
    """Rows and columns of what is inside, with a margin; None if nothing is."""
    x, y, width, height = cv2.boundingRect(inside)
    if not width:
        return None
    return (
        slice(max(0, y - margin_px), y + height + margin_px),
        slice(max(0, x - margin_px), x + width + margin_px),
    )
