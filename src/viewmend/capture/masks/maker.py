"""What makes masks, and what all makers share: no specks, no pinholes, soft edges."""

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
    """Makes the masks of one camera, image after image, offline or live.

    A maker belongs to one camera and is asked in order of time, by one thread at a time.
    """

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of the camera's next image: 0 to 255, in between soft.

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
    """The mask that a distance from the background means.

    What is `possible` counts as far as it hangs together with something `sure`; specks are dropped and pinholes filled.
    Along the outline a pixel is as opaque as its distance is a part of the largest one near it: where the image is a
    mean of subject and background, this is their share.
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


def softened(inside: Bool[np.ndarray, "height width"], edge_px: float) -> Mask:
    """0 and 255 with an outline that is soft over about `edge_px` pixels to either side."""
    import cv2

    hard = inside.astype(np.uint8) * np.uint8(255)
    return hard if edge_px <= 0 else np.asarray(cv2.GaussianBlur(hard, (0, 0), edge_px / 2), np.uint8)


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
    """The parts of `inside` that have so many pixels; parts that touch at corners only are two."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(inside.view(np.uint8), connectivity=4)
    kept = np.asarray(stats)[:, cv2.CC_STAT_AREA] >= least_px
    kept[0] = False
    return kept[np.asarray(labels, np.int32)]
