"""Whether refined cameras are better: judged by cameras, or times, that the refinement has not seen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from viewmend.capture.calibration.sight import Rig, Sight
from viewmend.capture.calibration.silhouettes import HOLDS, Refinement, refine_by_silhouettes
from viewmend.geometry.alignment import silhouette_iou
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.proxy import reconstruct
from viewmend.views import MultiViewFrame

LEFT_OUT = 3
"""So many cameras are left out in turn, as far apart in the rig's order as can be."""
LEFT_OUT_TIMES = 2
"""So many times are left out in turn, where there are several."""
MARGIN = 0.1
"""How much larger than the hull the box is that may hold the subject, to each side."""


@dataclass(frozen=True)
class HeldOutIou:
    """How a hull of the others' masks agrees with the mask of a camera that was left out."""

    camera: str
    before: float
    """Intersection over union of its silhouette and the mask, with the cameras as given."""
    after: float
    """With the others refined by their masks alone; the camera itself is as it was."""


def refined_without(frames: Sequence[MultiViewFrame], name: str, bounds: Bounds | None, hold: float) -> HeldOutIou:
    """Refine all cameras but one, and look at the hull through that one.

    Raises:
        CaptureError: the frames have no masks.
        ValueError: the masks agree on no subject.
    """
    others = [frame.without([name]) for frame in frames]
    refined = refined_all(others, bounds, hold).cameras
    held = [frame.select([name]) for frame in frames]
    before, after = (_iou(others, held, cameras, bounds) for cameras in (others[0].cameras, refined))
    return HeldOutIou(name, before, after)


def missed_px(frames: Sequence[MultiViewFrame], left: int, bounds: Bounds | None, hold: float) -> float:
    """What outlines miss at the time `frames[left]`, pixels, root mean square, with all cameras refined by the others.

    Raises:
        CaptureError: the frames have no masks.
        ValueError: the masks agree on no subject.
    """
    refined = refined_all([frame for time, frame in enumerate(frames) if time != left], bounds, hold).cameras
    sight = Sight.of(frames[left], _around_subject(frames[left], bounds))
    return float(np.sqrt(sight.least_missed(Rig.of(refined)).mean()))


def refined_all(frames: Sequence[MultiViewFrame], bounds: Bounds | None, hold: float) -> Refinement:
    """Refine all cameras of the frames; `bounds` are the capture's, where it has any, `hold` one of `HOLDS`.

    Raises:
        CaptureError: the frames have no masks.
        ValueError: the masks agree on no subject.
    """
    return refine_by_silhouettes(frames, [_around_subject(frame, bounds) for frame in frames], hold)


def best_hold(frames: Sequence[MultiViewFrame], bounds: Bounds | None) -> float:
    """Which of `HOLDS` serves times best that the refinement has not seen, or of a single time, cameras.

    Raises:
        CaptureError: the frames have no masks.
        ValueError: the masks agree on no subject.
    """
    if len(frames) > 1:
        times = range(min(LEFT_OUT_TIMES, len(frames)))
        return min(HOLDS, key=lambda hold: sum(missed_px(frames, time, bounds, hold) for time in times))
    names = left_out(frames[0].cameras.names)
    return max(HOLDS, key=lambda hold: sum(refined_without(frames, name, bounds, hold).after for name in names))


def left_out(names: Sequence[str]) -> list[str]:
    """Whom to leave out in turn."""
    count = min(LEFT_OUT, len(names))
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
