"""The first frames of a stream as small pictures, to be put side by side in a report's video."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8
from torch import Tensor

Picture = UInt8[np.ndarray, "_height _width 3"]
FILM_FRAMES = 24
"""Later frames are not shown."""
FILM_PX = 256
"""Longer side of a picture."""
MARGIN = 0.06
"""Around the subject, in shares of its longer side."""


@dataclass(frozen=True)
class Box:
    """Part of an image, pixels; the lower bounds belong to it, the upper ones do not."""

    top: int
    left: int
    bottom: int
    right: int

    def around(self, other: "Box") -> "Box":
        """The smallest box around both."""
        low, high = min, max
        return Box(
            low(self.top, other.top),
            low(self.left, other.left),
            high(self.bottom, other.bottom),
            high(self.right, other.right),
        )


def subject_box(subject: Bool[Tensor, "height width"]) -> Box | None:
    """Around all of these pixels, with a margin; None without any."""
    places = subject.nonzero()
    if not len(places):
        return None
    (top, left), (bottom, right) = places.amin(0).tolist(), places.amax(0).tolist()
    margin = round(MARGIN * (max(bottom - top, right - left) + 1))
    height, width = subject.shape
    return Box(
        max(0, top - margin), max(0, left - margin), min(height, bottom + 1 + margin), min(width, right + 1 + margin)
    )


def film(frames: Sequence[Picture], box: Box | None) -> Picture | None:
    """The frames' boxes, made small, one below the other; None without frames."""
    import cv2

    if not frames:
        return None
    box = box or Box(0, 0, *frames[0].shape[:2])
    zoom = min(1.0, FILM_PX / max(box.bottom - box.top, box.right - box.left))
    size = max(1, round((box.right - box.left) * zoom)), max(1, round((box.bottom - box.top) * zoom))
    parts = [frame[box.top : box.bottom, box.left : box.right] for frame in frames[:FILM_FRAMES]]
    return np.concatenate([cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in parts])


def frames_of(strip: Picture, count: int) -> list[Picture]:
    """The frames of a `film` of so many."""
    return [np.ascontiguousarray(part) for part in np.split(strip, count)] if len(strip) % count == 0 else []
