"""The mask maker protocol and its clean-up (specks, pinholes, soft edges), and masks by a green or blue screen."""

from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

Rgb = UInt8[np.ndarray, "height width 3"]
Mask = UInt8[np.ndarray, "height width"]
Inside = Bool[np.ndarray, "height width"]
Values = Float32[np.ndarray, "height width"]
Colours = Float32[np.ndarray, "height width 3"]

SPECK = 1e-3
"""Parts of the foreground smaller than this share of the image are dropped."""
PINHOLE = 2e-4
"""Holes in the foreground smaller than this share of the image are filled; larger ones may
be seen through."""

OUTLINE_PX = 2
"""How far from the outline pixels may be soft."""
LEAST_SHARE = 0.2
"""A share of subject below this is noise, one so near to 1 is whole."""
MOVES = 1 / 60
"""This share of the longer side is how far a part may move from one time to the next."""
KEYS = {"green": 1, "blue": 2}
"""The channel that a screen of this colour is brightest in."""
SURE = 0.5
"""Pixels this far from the key's colour are foreground, as a share of the key's own excess."""
POSSIBLE = 0.3
"""Pixels this far from the key's colour are foreground where they touch sure ones, as a share of
its excess."""
DARK = 24
"""A key that is darker than this, in levels, is black: what is brighter is foreground."""
EDGE = 1 / 100
"""Spill is taken away up to this share of the image's longer side from the outline."""


@runtime_checkable
class MaskMaker(Protocol):
    """Makes the masks of one camera, whose images it gets in order, from one thread at a time, offline or live."""

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of the camera's next image, 0 to 255; ValueError for another size than the maker was made for."""
        ...


def demand_size(rgb: Rgb, expected: np.ndarray, what: str) -> None:
    """ValueError unless an image has the height and width of `expected`, which messages call `what`."""
    if rgb.shape[:2] != expected.shape[:2]:
        h, w = rgb.shape[:2]
        height, width = expected.shape[:2]
        raise ValueError(
            f"expected an image of {width} x {height} pixels as {what} has, got {w} x {h}; resize it"
        )


def soft_mask(distance: Values, sure: float, possible: float) -> Mask:
    """Mask from the colour distance to the background, with hysteresis.

    Pixels above `possible` count if connected to one above `sure`; specks are dropped and pinholes
    filled. Along the outline, opacity is the distance relative to the largest one nearby.
    """
    inside = _connected(distance >= possible, distance >= sure)
    inside = _large(~_large(~inside, PINHOLE * inside.size), SPECK * inside.size)
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * OUTLINE_PX + 1, 2 * OUTLINE_PX + 1))
    largest = np.asarray(cv2.dilate(np.where(inside, distance, 0), near))
    share = distance / np.maximum(largest, possible)
    opacity = ((share - LEAST_SHARE) / (1 - 2 * LEAST_SHARE)).clip(0, 1)
    core = np.asarray(cv2.erode(inside.view(np.uint8), near)) > 0
    return np.where(core, 255, np.where(inside, 255 * opacity, 0)).round().astype(np.uint8)


def _connected(possible: Inside, sure: Inside) -> Inside:
    """The parts of `possible` that have anything `sure` in them."""
    count, found = cv2.connectedComponents(possible.view(np.uint8), connectivity=8)
    labels = np.asarray(found, np.int32)
    kept = np.zeros(count, bool)
    kept[labels[sure & possible]] = True
    kept[0] = False
    return kept[labels]


def _large(inside: Inside, least_px: float) -> Inside:
    """Connected parts of `inside` with at least this many pixels (4-connected)."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(inside.view(np.uint8), connectivity=4)
    kept = np.asarray(stats)[:, cv2.CC_STAT_AREA] >= least_px
    kept[0] = False
    return kept[np.asarray(labels, np.int32)]


def lasting(mask: Mask, before: Mask | None, after: Mask | None) -> Mask:
    """The mask without parts that are absent from both neighbouring frames; None: there is no such frame."""
    others = [other for other in (before, after) if other is not None]
    if not others:
        return mask
    reach = 2 * max(1, round(MOVES * max(mask.shape))) + 1
    near = np.maximum.reduce(others) > 127
    near = np.asarray(cv2.dilate(near.astype(np.uint8), np.ones((reach, reach), np.uint8))) > 0
    return np.where(_connected(mask > 0, near), mask, 0).astype(np.uint8)


class ChromaMasks:
    """Makes masks of what is neither of the key's colour nor, where `dark` is set, dark.

    A pixel's excess is by how much its key channel is above the larger other one, relative to that
    channel: light and shadow on a screen do not change it.
    """

    def __init__(self, key: str = "green", dark: bool = False):
        self._channel = KEYS[key]
        self._dark = dark

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of an image, 0 to 255."""
        image = np.asarray(cv2.GaussianBlur(rgb, (0, 0), 0.7), np.float32)
        brightest = image.max(-1)
        excess = _excess(image, self._channel) / np.maximum(brightest, 1)
        usual = np.median(excess[excess > 0.15]) if (excess > 0.15).any() else 0.5
        distance = 1 - excess / usual
        if self._dark:
            distance = np.minimum(distance, brightest / DARK - 1)
        return soft_mask(distance.astype(np.float32), SURE, POSSIBLE)


def without_spill(rgb: Rgb, mask: Mask, screen: Rgb) -> Rgb:
    """Remove green or blue light of the `screen` from the outline of the subject.

    Near the outline, where the screen's image has more green (or blue) than any other
    colour, the subject keeps no more of it than of its larger other colour. What lies
    farther inside keeps its colours.
    """
    reach = max(1, round(EDGE * max(rgb.shape[:2])))
    inside = (mask > 127).astype(np.uint8)
    deep = np.asarray(cv2.distanceTransform(inside, cv2.DIST_L2, 5), np.float32)
    near = np.clip(1 - (deep - reach) / reach, 0, 1)  # whole up to the reach, then fading
    around = np.asarray(cv2.blur(screen, (4 * reach + 1, 4 * reach + 1)), np.float32)
    image = rgb.astype(np.float32)
    for channel in KEYS.values():
        share = np.clip(_excess(around, channel) / 24, 0, 1)
        image[..., channel] -= near * share * np.maximum(_excess(image, channel), 0)
    return image.round().clip(0, 255).astype(np.uint8)


def _excess(image: Colours, channel: int) -> Values:
    others = [c for c in range(3) if c != channel]
    return image[..., channel] - np.maximum(image[..., others[0]], image[..., others[1]])
