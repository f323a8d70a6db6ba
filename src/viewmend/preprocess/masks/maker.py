"""The mask maker protocol and shared clean-up: specks, pinholes, soft edges."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, UInt8

Rgb = UInt8[np.ndarray, "height width 3"]
Mask = UInt8[np.ndarray, "height width"]

SPECK = 1e-3
"""Parts of the foreground smaller than this share of the image are dropped."""
PINHOLE = 2e-4
"""Holes in the foreground smaller than this share of the image are filled; larger ones may be seen through."""

OUTLINE_PX = 2
"""How far from the outline pixels may be soft."""
LEAST_SHARE = 0.2
"""A share of subject below this is noise, one so near to 1 is whole."""


@runtime_checkable
class MaskMaker(Protocol):
    """Makes the masks of one camera, image by image, offline or live.

    A maker belongs to one camera and gets its images in order, from one thread at a time.
    """

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of the camera's next image, 0 to 255.

        Raises:
            ValueError: the image is not of the size that the maker was made for.
        """
        ...


def demand_size(rgb: Rgb, expected: np.ndarray, what: str) -> None:
    """ValueError unless an image has the height and width of `expected`, which messages call `what`."""
    if rgb.shape[:2] != expected.shape[:2]:
        (h, w), (height, width) = rgb.shape[:2], expected.shape[:2]
        raise ValueError(f"expected an image of {width} x {height} pixels as {what} has, got {w} x {h}; resize it")


def soft_mask(distance: Float32[np.ndarray, "height width"], sure: float, possible: float) -> Mask:
    """Mask from the colour distance to the background, with hysteresis.

    Pixels above `possible` count if connected to one above `sure`; specks are dropped and pinholes filled. Along the
    outline, opacity is the distance relative to the largest one nearby.
    """
    import cv2

    inside = tidied(_connected(distance >= possible, distance >= sure))
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * OUTLINE_PX + 1, 2 * OUTLINE_PX + 1))
    largest = np.asarray(cv2.dilate(np.where(inside, distance, 0), near))
    share = distance / np.maximum(largest, possible)
    opacity = ((share - LEAST_SHARE) / (1 - 2 * LEAST_SHARE)).clip(0, 1)
    core = np.asarray(cv2.erode(inside.view(np.uint8), near)) > 0
    return np.where(core, 255, np.where(inside, 255 * opacity, 0)).round().astype(np.uint8)


def tidied(inside: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """The same without specks of foreground and pinholes in it."""
    filled = ~_large(~inside, PINHOLE * inside.size)
    return _large(filled, SPECK * inside.size)


def _connected(
    possible: Bool[np.ndarray, "height width"], sure: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """The parts of `possible` that have anything `sure` in them."""
    import cv2

    count, found = cv2.connectedComponents(possible.view(np.uint8), connectivity=8)
    labels, kept = np.asarray(found, np.int32), np.zeros(count, bool)
    kept[labels[sure & possible]] = True
    kept[0] = False
    return kept[labels]


def _large(inside: Bool[np.ndarray, "height width"], least_px: float) -> Bool[np.ndarray, "height width"]:
    """Connected parts of `inside` with at least this many pixels (4-connected)."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(inside.view(np.uint8), connectivity=4)
    kept = np.asarray(stats)[:, cv2.CC_STAT_AREA] >= least_px
    kept[0] = False
    return kept[np.asarray(labels, np.int32)]


MOVES = 1 / 60
"""This share of the longer side is how far a part may move from one time to the next."""


def lasting(mask: Mask, before: Mask | None, after: Mask | None) -> Mask:
    """The mask without parts that neither the time before nor the time after has anything of; None is no such time."""
    import cv2

    others = [other for other in (before, after) if other is not None]
    if not others:
        return mask
    reach = 2 * max(1, round(MOVES * max(mask.shape))) + 1
    near = np.maximum.reduce(others) > 127
    near = np.asarray(cv2.dilate(near.astype(np.uint8), np.ones((reach, reach), np.uint8))) > 0
    count, found = cv2.connectedComponents((mask > 0).astype(np.uint8), connectivity=8)
    labels, kept = np.asarray(found, np.int32), np.zeros(count, bool)
    kept[labels[near]] = True
    return np.where(kept[labels], mask, 0).astype(np.uint8)
