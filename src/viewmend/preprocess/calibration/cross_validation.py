"""Refinement of all cameras by silhouettes, and of all but one camera or frame, on which the result is validated."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from viewmend.geometry.alignment import silhouette_iou
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.line_of_sight import Rig
from viewmend.geometry.proxy import reconstruct
from viewmend.preprocess.calibration.silhouettes import (
    HOLDS,
    Refinement,
    lines_of_sight,
    refine_by_silhouettes,
)
from viewmend.types import MultiViewFrame

HELD_OUT_CAMERAS = 3
"""Number of cameras that are held out in turn, spread over the rig."""
HELD_OUT_FRAMES = 2
"""Number of frames that are held out in turn, if there are several."""
MARGIN = 0.1
"""The box around the subject exceeds the hull by this fraction of its size on each side."""


@dataclass(frozen=True)
class HeldOutIou:
    """Agreement of a held-out camera's mask with the hull of the other cameras."""

    camera: str
    before: float
    """IoU of the hull's silhouette and the mask, with the cameras as given."""
    after: float
    """IoU with the other cameras refined by their own masks; this camera is unchanged."""


def validate_without(
    frames: Sequence[MultiViewFrame], name: str, bounds: Bounds | None, hold: float
) -> HeldOutIou:
    """Refine all cameras but one, and compare the hull with that one's mask before and after."""
    others = [frame.without([name]) for frame in frames]
    held = [frame.select([name]) for frame in frames]
    refined = refine_all(others, bounds, hold).cameras
    before, after = (_iou(others, held, cameras, bounds) for cameras in (others[0].cameras, refined))
    return HeldOutIou(name, before, after)


def held_out_residual_px(
    frames: Sequence[MultiViewFrame], left: int, bounds: Bounds | None, hold: float
) -> float:
    """Residual of frame `left`, pixels (root mean square), with cameras refined on all other frames."""
    refined = refine_all([frame for time, frame in enumerate(frames) if time != left], bounds, hold).cameras
    sight = lines_of_sight(frames[left], _around_subject(frames[left], bounds))
    return float(np.sqrt(sight.least_residuals(Rig.from_cameras(refined)).mean()))


def refine_all(frames: Sequence[MultiViewFrame], bounds: Bounds | None, hold: float) -> Refinement:
    """Refine all cameras; `bounds` are those of the capture, if it has any, and `hold` is one of `HOLDS`."""
    return refine_by_silhouettes(frames, [_around_subject(frame, bounds) for frame in frames], hold)


def best_hold(frames: Sequence[MultiViewFrame], bounds: Bounds | None) -> float:
    """Choose the weight in `HOLDS` that is best for held-out frames (cameras, if there is one frame)."""
    if len(frames) > 1:
        times = range(min(HELD_OUT_FRAMES, len(frames)))
        return min(
            HOLDS, key=lambda hold: sum(held_out_residual_px(frames, time, bounds, hold) for time in times)
        )
    names = cameras_to_hold_out(frames[0].cameras.names)
    return max(
        HOLDS, key=lambda hold: sum(validate_without(frames, name, bounds, hold).after for name in names)
    )


def cameras_to_hold_out(names: Sequence[str]) -> list[str]:
    """Select `HELD_OUT_CAMERAS` cameras, evenly spread over the rig."""
    count = min(HELD_OUT_CAMERAS, len(names))
    return [names[len(names) * number // count] for number in range(count)]


def _around_subject(frame: MultiViewFrame, bounds: Bounds | None) -> Bounds:
    assert frame.mask is not None
    found = reconstruct(frame.mask, frame.cameras, bounds).bounds
    return Bounds(found.low - MARGIN * found.size_m, found.high + MARGIN * found.size_m)


def _iou(
    others: Sequence[MultiViewFrame], held: Sequence[MultiViewFrame], cameras: Cameras, bounds: Bounds | None
) -> float:
    scores = []
    for frame, own in zip(others, held, strict=True):
        assert frame.mask is not None and own.mask is not None
        proxy = reconstruct(frame.mask, cameras, bounds)
        scores.append(float(silhouette_iou(proxy.depth(own.cameras) > 0, own.mask).nan_to_num(1.0).mean()))
    return sum(scores) / len(scores)
