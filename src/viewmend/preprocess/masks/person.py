"""Masks of people by MediaPipe's pose networks, run by onnxruntime: no clean plate and no screen needed.

A detector finds people in the whole image; a second network segments each in a rotated square
around the person and returns landmarks, from which the square of the next image follows. So the
detector runs only on the first image and where a person is lost or has not been found. The weights
come with the package (weights/person/README.md).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from viewmend.preprocess.masks.maker import Inside, Mask, Rgb

WEIGHTS = Path(__file__).parents[2] / "weights" / "person"
DETECTOR_PX = 224
"""The input of the detector has this side, pixels."""
SEGMENTER_PX = 256
"""The input of the segmenter has this side, pixels."""
MAX_PEOPLE = 6
"""At most this many people per image are segmented: those with the highest detection scores."""
MIN_SCORE = 0.5
"""Least detection score of a person, and presence score at which a person is tracked."""
MAX_OVERLAP = 0.3
"""Detections with a larger IoU are the same person."""
ROI_SCALE = 1.25
"""The square around a person is this many times as wide as the circle that the landmarks span."""
OUTWARD = 0.6
"""Added to the logits of the segmenter, whose outlines are too narrow. IoU is 0.01 higher on two
captures."""
DETECT_EVERY = 15
"""Images after which the detector looks for further people while some are tracked."""
GUIDED_SCORE = 0.05
"""Least presence score of a person where the other cameras expect one."""
GUIDED_PASSES = 2
"""Where a person is expected, the second of these passes segments the square that the first one's
landmarks span."""
MIN_BETTER = 0.1
"""Another direction fits clearly better than the first ones if its IoU with the expected silhouette
is higher by this. Silhouettes are looser than people, so that small differences mean nothing."""
GOOD_FIT = 0.8
"""No further direction is tried once the mask has this IoU with the expected silhouette."""


@dataclass(frozen=True)
class Roi:
    """A rotated square around a person, pixels of the image."""

    x: float
    y: float
    side: float
    angle: float
    """Radians, clockwise; 0 for a person who stands upright in the image."""

    @classmethod
    def around(cls, center: Sequence[float], top: Sequence[float]) -> "Roi":
        """The square of the circle about `center` through `top`, a point in the direction of the head."""
        dx = top[0] - center[0]
        dy = top[1] - center[1]
        return cls(center[0], center[1], 2 * ROI_SCALE * math.hypot(dx, dy), math.atan2(dx, -dy))

    def image_from_roi(self) -> Float32[np.ndarray, "2 3"]:
        """Affine map from pixels of the segmenter's input (corner origin) to pixels of the image."""
        scale = self.side / SEGMENTER_PX
        c = scale * math.cos(self.angle)
        s = scale * math.sin(self.angle)
        half = SEGMENTER_PX / 2
        return np.array([[c, -s, self.x - half * (c - s)], [s, c, self.y - half * (s + c)]], np.float32)


class PersonMasks:
    """Masks of the people in one camera, tracked from image to image."""

    def __init__(self) -> None:
        self._tracked: list[Roi] = []
        self._images = 0

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of the camera's next image, 0 to 255, soft at the outline; empty where no person is found."""
        thorough = self._images % DETECT_EVERY == 0
        self._images += 1
        candidates = list(self._tracked)
        if thorough or not self._tracked:
            found = _detect(rgb, thorough and not self._tracked)
            candidates += [roi for roi in found if not any(_same(roi, other) for other in self._tracked)]
        alpha = np.zeros(rgb.shape[:2], np.float32)
        self._tracked = []
        for roi in candidates[:MAX_PEOPLE]:
            found = _segment(rgb, roi)
            if found is None:
                continue
            own, following = found
            alpha = np.maximum(alpha, own)
            if not any(_same(following, other) for other in self._tracked):
                self._tracked.append(following)
        return (255 * alpha).round().astype(np.uint8)


def mask_near(rgb: Rgb, expected: Inside) -> Mask | None:
    """Foreground of the person whose silhouette is about `expected`, found without the detector.

    The silhouette may be larger than the person. The square around it is segmented, upright first;
    another direction is taken where it fits clearly better. None where no person is found.
    """
    rows, columns = np.nonzero(expected)
    if not len(rows):
        return None
    center = ((columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2)
    radius = max(np.ptp(columns), np.ptp(rows)) / 2
    best = None
    best_fit = 0.0
    for dx, dy in ((0, -1), (1, 0), (-1, 0), (0, 1)):
        alpha = _follow(rgb, Roi.around(center, (center[0] + radius * dx, center[1] + radius * dy)))
        fit = 0.0 if alpha is None else _fit(alpha, expected)
        if fit > best_fit + MIN_BETTER:
            best = alpha
            best_fit = fit
        if best_fit > GOOD_FIT:
            break
    return None if best is None else (255 * best).round().astype(np.uint8)


def _follow(rgb: Rgb, roi: Roi) -> Float32[np.ndarray, "height width"] | None:
    """Opacity of the person to whom the landmarks lead from a square around an expected person."""
    alpha = None
    for _ in range(GUIDED_PASSES):
        found = _segment(rgb, roi, GUIDED_SCORE)
        if found is None:
            break
        alpha, roi = found
    return alpha


def _fit(alpha: Float32[np.ndarray, "height width"], expected: Inside) -> float:
    """IoU of a mask and the expected silhouette."""
    inside = alpha > 0.5
    return float((inside & expected).sum()) / max(float((inside | expected).sum()), 1.0)


def _same(a: Roi, b: Roi) -> bool:
    """Whether two squares are around the same person."""
    return math.hypot(a.x - b.x, a.y - b.y) < 0.25 * min(a.side, b.side)


@cache
def _session(name: str):
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(WEIGHTS / f"{name}.onnx", options, providers=["CPUExecutionProvider"])


def _run(name: str, image: Float32[np.ndarray, "side side 3"]) -> list[np.ndarray]:
    session = _session(name)
    return [np.asarray(value) for value in session.run(None, {session.get_inputs()[0].name: image[None]})]


def _detect(rgb: Rgb, small_people: bool = False) -> list[Roi]:
    """The squares around the people in an image, the surest first.

    With `small_people`, an image in which the detector finds none is searched in overlapping tiles,
    too: people of less than a quarter of the longer side are too small for it.
    """
    height, width = rgb.shape[:2]
    found = _detect_in(rgb, 0, 0, max(height, width))
    if found or not small_people:
        return found
    for side in (min(height, width), max(1, min(height, width) // 2)):
        corners = itertools.product(_steps(height, side), _steps(width, side))
        tiles = [roi for top, left in corners for roi in _detect_in(rgb, left, top, side)]
        kept: list[Roi] = []
        for roi in tiles:
            if not any(_same(roi, other) for other in kept):
                kept.append(roi)
        if kept:
            return kept
    return []


def _steps(length: int, side: int) -> list[int]:
    """Starts of tiles of this side that cover a length and overlap by half."""
    return [*range(0, length - side, max(1, side // 2)), length - side]


def _detect_in(rgb: Rgb, left: int, top: int, side: int) -> list[Roi]:
    """The squares around the people in a square part of an image; what lies beyond the image is black."""
    part = rgb[top : top + side, left : left + side]
    scale = DETECTOR_PX / side
    x, y = ((DETECTOR_PX - scale * length) / 2 for length in (part.shape[1], part.shape[0]))
    matrix = np.array([[scale, 0, x], [0, scale, y]], np.float32)
    small = cv2.warpAffine(part, matrix, (DETECTOR_PX, DETECTOR_PX), flags=cv2.INTER_AREA)
    boxes, logits = _run("detector", np.asarray(small, np.float32) / 127.5 - 1)
    scores = 1 / (1 + np.exp(-np.clip(logits[0, :, 0], -80, 80)))
    # A box is its centre, its size and four points; all but the size are relative to the anchor.
    points = boxes[0].reshape(-1, 6, 2) + np.where(
        np.arange(6)[:, None] == 1, 0, _anchors()[:, None] * DETECTOR_PX
    )
    kept: list[int] = []
    for n in np.argsort(-scores):
        if scores[n] < MIN_SCORE:
            break
        if not any(_iou(points[n, :2], points[other, :2]) > MAX_OVERLAP for other in kept):
            kept.append(int(n))
    image = (points[kept] - [x, y]) / scale + [left, top]
    return [Roi.around(person[2], person[3]) for person in image.tolist()]


@cache
def _anchors() -> Float32[np.ndarray, "2254 2"]:
    """Centres of the detector's cells, 0 to 1: grids of stride 8, 16 and 32 with two, two and six boxes per cell."""
    grids = []
    for stride, boxes in ((8, 2), (16, 2), (32, 6)):
        cells = (np.arange(DETECTOR_PX // stride, dtype=np.float32) + 0.5) * stride / DETECTOR_PX
        y, x = np.meshgrid(cells, cells, indexing="ij")
        grids.append(np.repeat(np.stack([x, y], -1).reshape(-1, 2), boxes, 0))
    return np.concatenate(grids)


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    """Overlap of two boxes, each a centre and a size."""
    low = np.maximum(a[0] - a[1] / 2, b[0] - b[1] / 2)
    high = np.minimum(a[0] + a[1] / 2, b[0] + b[1] / 2)
    both = float(np.prod(np.clip(high - low, 0, None)))
    return both / max(float(np.prod(a[1]) + np.prod(b[1])) - both, 1e-6)


def _segment(
    rgb: Rgb, roi: Roi, min_score: float = MIN_SCORE
) -> tuple[Float32[np.ndarray, "height width"], Roi] | None:
    """Opacity of the person in a square, at the image's size, and the square for the next image; None if none there."""
    height, width = rgb.shape[:2]
    image_from_roi = roi.image_from_roi()
    shrink = cv2.INTER_AREA if roi.side > SEGMENTER_PX else cv2.INTER_LINEAR
    crop = cv2.warpAffine(
        rgb, image_from_roi, (SEGMENTER_PX, SEGMENTER_PX), flags=shrink | cv2.WARP_INVERSE_MAP
    )
    landmarks, presence, logits, *_ = _run("segmenter", np.asarray(crop, np.float32) / 255)
    if float(presence[0, 0]) < min_score:
        return None
    opacity = 1 / (1 + np.exp(-np.clip(logits[0, :, :, 0] + OUTWARD, -30, 30)))
    # Landmarks 33 and 34 are the centre of the body and a point on the circle around it.
    points = landmarks[0].reshape(39, 5)[33:35, :2] @ image_from_roi[:, :2].T + image_from_roi[:, 2]
    mask = cv2.warpAffine(opacity, image_from_roi, (width, height), flags=cv2.INTER_LINEAR)
    return mask, Roi.around(*points.tolist())
