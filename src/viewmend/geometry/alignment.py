"""A shift that all images of a rig have against its calibration, found from the masks alone.

Wrong conventions for pixel centres, crops and chroma subsampling shift every image of a rig by the
same fraction of a pixel. Then no point of space agrees with all outlines, and the visual hull comes
out thinner than the masks. The shift that makes hull and masks agree best undoes it.
"""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND, HullConfig
from viewmend.geometry.proxy import reconstruct

STEP_PX = 1.0
"""Shifts of this many pixels are tried along each image axis."""
LARGEST_PX = 1.5
"""A larger shift than this, in pixels, is not accepted."""
MARGIN = 0.05
"""The box in which shifted hulls are carved is larger than the first hull by this fraction, to each side."""
WORTH_MOVING = 0.003
"""A shift counts if the IoU of hull and masks rises by this much, which is above the noise of exact
calibrations."""
LEAST_IOU = 0.8
"""No shift is applied if the IoU stays below this, because a mask or a camera is wrong then."""


@dataclass(frozen=True)
class Alignment:
    """The shift of all principal points, and its effect."""

    offset_px: tuple[float, float]
    """Shift to add to (cx, cy) of every camera; zeros if no shift is worth it."""
    iou_before: float
    """Mean IoU of the hull's silhouettes and the masks, as calibrated."""
    iou_after: float
    """The same IoU after the move."""


def shared_offset(
    mask: UInt8[Tensor, "view height width"],
    cameras: Cameras,
    bounds: Bounds | None = None,
    config: HullConfig | None = None,
) -> Alignment:
    """The common shift of the images against the calibration, from one time's masks.

    A few hulls and their silhouettes are computed, so this is for the start of a capture, not for
    every frame. Shifts that a rig cannot tell from a move of the subject (all cameras level: up and
    down) stay near zero.

    Raises:
        ValueError: there is one camera only, or the cameras look away from each other.
    """
    found = reconstruct(mask, cameras, bounds, config).bounds
    box = Bounds(found.low - MARGIN * found.size_m, found.high + MARGIN * found.size_m)

    def iou(x: float, y: float) -> float:
        moved = cameras.moved(x, y)
        agreed = silhouette_iou(reconstruct(mask, moved, box, config).depth(moved) > 0, mask)
        return float(agreed.nanmean().nan_to_num(0.0))

    before = iou(0.0, 0.0)
    x, after_x = _peak(lambda x: iou(x, 0.0), before)
    y, after = _peak(lambda y: iou(x, y), after_x)
    if after - before < WORTH_MOVING or after < LEAST_IOU:
        return Alignment((0.0, 0.0), before, before)
    return Alignment((x, y), before, after)


def silhouette_iou(
    silhouettes: Bool[Tensor, "view height width"], mask: UInt8[Tensor, "view _height _width"]
) -> Float[Tensor, "view"]:
    """Intersection over union of the hull's silhouettes and the masks; NaN where both are empty.

    Masks may be larger than the silhouettes, padded at the right and bottom.
    """
    inside = mask[:, : silhouettes.shape[1], : silhouettes.shape[2]] > FOREGROUND
    return (silhouettes & inside).sum((1, 2)) / (silhouettes | inside).sum((1, 2))


def _peak(value: Callable[[float], float], middle: float) -> tuple[float, float]:
    """Where a function of one shift is largest, and its value there, if that is higher than in the middle.

    The agreement of outlines falls linearly to both sides of its peak: two lines of equal slope are fitted.
    """
    low = value(-STEP_PX)
    high = value(STEP_PX)
    fall = middle - min(low, high)
    if fall <= 0:
        return 0.0, middle
    peak = max(-LARGEST_PX, min(LARGEST_PX, 0.5 * STEP_PX * (high - low) / fall))
    there = value(peak)
    return (peak, there) if there >= middle + WORTH_MOVING else (0.0, middle)
