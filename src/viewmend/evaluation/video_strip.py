"""The first frames of a stream as small images in one tall image, from which a report makes its videos."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8
from torch import Tensor

Picture = UInt8[np.ndarray, "_height _width 3"]
STRIP_FRAMES = 24
"""Later frames are left out."""
STRIP_PX = 256
"""Longer side of a frame."""
MARGIN = 0.06
"""Margin around the subject, relative to its longer side."""


@dataclass(frozen=True)
class Box:
    """Part of an image in pixels; the upper bounds are exclusive."""

    top: int
    left: int
    bottom: int
    right: int

    def union(self, other: "Box") -> "Box":
        """The smallest box around both."""
        top, left = min(self.top, other.top), min(self.left, other.left)
        return Box(top, left, max(self.bottom, other.bottom), max(self.right, other.right))


def subject_box(subject: Bool[Tensor, "height width"]) -> Box | None:
    """The box around these pixels, with a margin; None without any."""
    pixels = subject.nonzero()
    if not len(pixels):
        return None
    (top, left), (bottom, right) = pixels.amin(0).tolist(), pixels.amax(0).tolist()
    margin = round(MARGIN * (max(bottom - top, right - left) + 1))
    height, width = subject.shape
    return Box(
        max(0, top - margin), max(0, left - margin), min(height, bottom + 1 + margin), min(width, right + 1 + margin)
    )


def make_strip(frames: Sequence[Picture], box: Box | None) -> Picture | None:
    """The box of each frame, scaled down, stacked vertically; None without frames."""
    import cv2

    if not frames:
        return None
    box = box or Box(0, 0, *frames[0].shape[:2])
    zoom = min(1.0, STRIP_PX / max(box.bottom - box.top, box.right - box.left))
    size = max(1, round((box.right - box.left) * zoom)), max(1, round((box.bottom - box.top) * zoom))
    parts = [frame[box.top : box.bottom, box.left : box.right] for frame in frames[:STRIP_FRAMES]]
    return np.concatenate([cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in parts])


def split_strip(strip: Picture, count: int) -> list[Picture]:
    """The frames of a strip of `count` frames; none if its height does not fit."""
    return [np.ascontiguousarray(part) for part in np.split(strip, count)] if len(strip) % count == 0 else []
