"""The camera without which the outlines of all others fit together; a few pixels in its pose are seen so."""

import numpy as np

from viewmend.capture.calibration.sight import Rig, Sight
from viewmend.capture.errors import CaptureError
from viewmend.capture.reduction import reduced
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import reconstruct
from viewmend.views import MultiViewFrame

LONGEST_PX = 384
"""Larger images are reduced first."""
HULL = HullConfig(resolution=64)
"""For the box around the subject alone."""
POINTS, MOST_POINTS = 40, 400
"""Points of each outline at most, and of all outlines together."""
AROUND = 1.5
"""The box in which places are looked for, beside that of the hull, which a wrong camera makes smaller."""
LEAST_CAMERAS = 5
"""The outlines of three cameras fit together too easily to blame the fourth."""
LEAST_PX = 0.2
"""Outlines that miss each other by less fit together: those of clean rigs of 128 to 256 pixels miss up to 0.16."""
LEAST_LEFT_PX = 0.01
"""Less than this is not told apart."""
STANDS_OUT = 1.25
"""A camera is suspected if its own outline is missed by so many times the median's."""
SUSPECTS = 3
"""So many are left out in turn."""
LEFT = 0.5
"""A suspect is the one if so little, or less, of what was missed is left without it."""
LEFT_ALONE, OTHERS_LEAVE, UNFIT_PX = 0.67, 1.25, 0.4
"""Or with more left, if without any other suspect there is so many times more: of rigs that never fit quite together,
whose outlines miss each other by so much or more."""
ALONE = 0.7
"""It may be the next suspect as well, unless that leaves more than the best one divided by this."""


def odd_outline(frame: MultiViewFrame, bounds: Bounds | None) -> tuple[tuple[str, ...], float] | None:
    """The camera that keeps all outlines from fitting together, and how many times better they do without it.

    The line of sight through a point of an outline touches the subject, so somewhere along it is a place that lies
    inside of all other masks. How far outside the best place is, is what is missed. Two cameras are
    named where it may be either. None where no camera is odd.
    """
    names = frame.cameras.names
    small = reduced(frame, LONGEST_PX)
    if small.mask is None or len(names) < LEAST_CAMERAS:
        return None
    try:
        box = reconstruct(small.mask, small.cameras, bounds, HULL).bounds
        box = Bounds(box.center - AROUND * box.size_m / 2, box.center + AROUND * box.size_m / 2)
        missed, own = _missed_px(small, box)
        suspects = [view for view in np.argsort(-own)[:SUSPECTS].tolist() if own[view] > STANDS_OUT * np.median(own)]
        if missed < LEAST_PX or not suspects:
            return None
        left = [_missed_px(small.without([names[view]]), box)[0] for view in suspects]
    except (ValueError, CaptureError):  # no hull, or no outlines
        return None
    order = np.argsort(left)
    best = left[order[0]]
    second = left[order[1]] if len(order) > 1 else missed
    apart = missed >= UNFIT_PX and best <= LEFT_ALONE * missed and second >= OTHERS_LEAVE * best
    if best > LEFT * missed and not apart:
        return None
    either = [view for view in order[:2] if best > ALONE * left[view] or view == order[0]]
    return tuple(names[suspects[view]] for view in either), missed / max(best, LEAST_LEFT_PX)


def _missed_px(frame: MultiViewFrame, box: Bounds) -> tuple[float, np.ndarray]:
    """What all outlines miss, pixels, root mean square, and what each camera's own outline misses, `(view,)`."""
    points = min(POINTS, MOST_POINTS // len(frame.cameras))
    sight, rig = Sight.of(frame, box, max(1, points)), Rig.of(frame.cameras)
    squared = sight.least_missed(rig)
    count = np.bincount(sight.view, minlength=len(frame.cameras))
    own = np.bincount(sight.view, squared, minlength=len(frame.cameras)) / np.maximum(count, 1)
    return float(np.sqrt(squared.mean())), np.sqrt(own)
