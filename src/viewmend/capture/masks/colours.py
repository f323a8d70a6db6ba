"""Masks where the background is not known: by colours, within what the other cameras support (OpenCV's GrabCut)."""

import numpy as np
from jaxtyping import Bool

from viewmend.capture.masks.maker import Mask, Rgb, softened, tidied

WORKED_PX = 720
"""Colours are looked at in images of this longer side at most."""
ITERATIONS = 3
NEAR_PX = 10
"""So near to what may be subject the known background may be wrong."""
SURE_PX = 3
"""So deep within the mask it is surely right."""
AROUND_PX = 24
"""So much of the background around is shown to the colours."""


def by_colours(
    rgb: Rgb,
    mask: Mask,
    unsure: Bool[np.ndarray, "height width"],
    supported: Bool[np.ndarray, "height width"],
) -> Mask:
    """The mask made anew: what is deep in it stays, what is not `supported` goes, and colours decide in between.

    The mask comes back as it is where there is nothing to decide.
    """
    import cv2

    height, width = mask.shape
    scale = min(1.0, WORKED_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    image = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
    own, doubt, seen = (
        np.asarray(cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_AREA)) > 0.5
        for part in (mask > 127, unsure, supported)
    )
    labels = np.full(own.shape, cv2.GC_BGD, np.uint8)
    labels[seen & _widened(own | doubt, NEAR_PX)] = cv2.GC_PR_BGD
    labels[seen & (own | doubt)] = cv2.GC_PR_FGD
    sure = ~_widened(~(own & ~doubt), SURE_PX)
    labels[seen & sure] = cv2.GC_FGD
    if not (labels == cv2.GC_FGD).any() or not (labels == cv2.GC_PR_FGD).any():
        return np.where(supported, mask, 0).astype(np.uint8)
    rows, columns = (np.flatnonzero(seen.any(axis)) for axis in (1, 0))
    window = tuple(slice(max(0, line[0] - AROUND_PX), line[-1] + AROUND_PX) for line in (rows, columns))
    cut = np.ascontiguousarray(labels[window])
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)  # the same image has the same mask
    cv2.grabCut(np.ascontiguousarray(image[window]), cut, None, *models, ITERATIONS, cv2.GC_INIT_WITH_MASK)  # pyright: ignore
    found = np.zeros(own.shape, bool)
    found[window] = (cut == cv2.GC_FGD) | (cut == cv2.GC_PR_FGD)
    large = cv2.resize(tidied(found).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return softened(np.asarray(large) > 0.5, edge_px=1.0 / scale)


def _widened(inside: Bool[np.ndarray, "height width"], by_px: int) -> Bool[np.ndarray, "height width"]:
    import cv2

    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by_px + 1, 2 * by_px + 1))
    return np.asarray(cv2.dilate(inside.astype(np.uint8), disc)) > 0
