"""Masks cleaned over time: what is there at one time only goes."""

import numpy as np

from viewmend.capture.masks.maker import Mask

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
