"""Clean plates of a capture in which the subject is always there, learned from all cameras together.

Each camera's plate is stitched (`stitched.py`). Where the subject hides the background for long, its own colours tell
that the plate still shows it. Such pixels are `unsure`, until the other cameras say of some times that nobody is there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, UInt8

from viewmend.capture.masks.across import supported
from viewmend.capture.masks.maker import Rgb
from viewmend.capture.masks.plate import PlateMasks
from viewmend.capture.masks.stitched import stitched_plate
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras

BINS = 16
"""Colours are counted in so many steps a channel."""
ODDS = 1.0
"""Logarithm of the odds from which a colour is rather the subject's than the background's."""
SWEPT = 0.02
"""The subject goes where the mask is set at this share of the times."""
PASSING = 0.3
"""Where the mask is set at a smaller share of the times it shows the subject, not what a wrong plate hides."""
MARGIN = 1 / 24
"""This share of the longer side is how far such places are widened."""
ROUNDS = 3
LEAST_TIMES = 2
"""At so many times a pixel must be free to be known."""


@dataclass(frozen=True)
class LearnedPlate:
    """A plate, and where it is a guess."""

    rgb: Rgb
    unsure: Bool[np.ndarray, "height width"]
    """The background was seen at no time; the plate is continued from around."""
    free: Bool[np.ndarray, "time height width"]
    """Where nobody is at each of the times that it was learned from."""


def learned_plates(
    images: Mapping[str, Sequence[Rgb]], cameras: Cameras, bounds: Bounds | None
) -> dict[str, LearnedPlate]:
    """The plates of all cameras, from images of the same times, which are of the cameras' sizes and best small ones.

    Raises:
        ValueError: a camera has no image, or not as many as the others.
    """
    if len({len(own) for own in images.values()}) > 1:
        raise ValueError("expected images of the same times for each camera, got others; choose times without gaps")
    plates = {name: _begun(images[name]) for name in cameras.names}
    for _ in range(ROUNDS if len(cameras) > 2 else 0):
        masks = {name: _masks(plate.rgb, images[name]) | plate.unsure for name, plate in plates.items()}
        free = {name: ~own for name, own in masks.items()}
        for time in range(len(images[cameras.names[0]])):
            seen = supported(_stacked([masks[name][time] for name in cameras.names], cameras), cameras, bounds)
            for name, by_others in zip(cameras.names, seen, strict=True):
                free[name][time] |= ~by_others if by_others is not None else False
        plates = {name: _known_better(plate, images[name], free[name]) for name, plate in plates.items()}
    return plates


def full_plate(learned: LearnedPlate, images: Sequence[Rgb]) -> LearnedPlate:
    """The plate at the size of `images`, which are those that it was learned from before they were reduced."""
    height, width = images[0].shape[:2]

    def enlarged(inside: Bool[np.ndarray, "small_height small_width"]) -> Bool[np.ndarray, "height width"]:
        import cv2

        return np.asarray(cv2.resize(inside.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)) > 0

    free = np.stack([enlarged(part) for part in learned.free])
    unsure = enlarged(learned.unsure)
    return LearnedPlate(_continued(_median_of(images, free), unsure), unsure, free)


def _begun(images: Sequence[Rgb]) -> LearnedPlate:
    """The stitched plate; it is unsure where it has the subject's colours and the subject goes."""
    plate = stitched_plate(images)
    masks = _masks(plate, images)
    share = masks.mean(0)
    swept = _widened(share > SWEPT, _margin(plate))
    if not masks.any() or swept.all():
        return LearnedPlate(plate, np.zeros(plate.shape[:2], bool), ~masks)
    passing = share < PASSING
    subject = np.concatenate([image[mask & passing] for image, mask in zip(images, masks, strict=True)])
    around = _widened(swept, _margin(plate)) & ~swept
    odds = np.log(_histogram(subject) / _histogram(np.concatenate([plate[around], plate[~swept][::4]])))
    return LearnedPlate(plate, swept & _of_the_subject(plate, odds), ~masks)


def _known_better(
    plate: LearnedPlate, images: Sequence[Rgb], free: Bool[np.ndarray, "time height width"]
) -> LearnedPlate:
    near = max(1, _margin(plate.rgb) // 6)
    free = np.stack([~_widened(~part, near) for part in free])
    known = free.sum(0) >= LEAST_TIMES
    unsure = plate.unsure & ~known
    rgb = np.where(known[..., None], _median_of(images, free), plate.rgb)
    return LearnedPlate(_continued(rgb, unsure), unsure, free | ~known)


def _continued(plate: Rgb, unsure: Bool[np.ndarray, "height width"]) -> Rgb:
    import cv2

    return np.asarray(cv2.inpaint(plate, unsure.astype(np.uint8), _margin(plate) / 6, cv2.INPAINT_TELEA), np.uint8)


def _margin(plate: Rgb) -> int:
    return max(1, round(MARGIN * max(plate.shape[:2])))


def _masks(plate: Rgb, images: Sequence[Rgb]) -> Bool[np.ndarray, "time height width"]:
    maker = PlateMasks(plate)
    return np.stack([maker.mask(image) > 127 for image in images])


def _stacked(masks: Sequence[Bool[np.ndarray, "height width"]], cameras: Cameras) -> UInt8[torch.Tensor, "view h w"]:
    width, height = cameras.max_size_px
    stack = torch.zeros(len(masks), height, width, dtype=torch.uint8)
    for view, mask in enumerate(masks):
        stack[view, : mask.shape[0], : mask.shape[1]] = torch.from_numpy(mask.astype(np.uint8)) * 255
    return stack


def _of_the_subject(plate: Rgb, odds: Float32[np.ndarray, "red green blue"]) -> Bool[np.ndarray, "height width"]:
    """Where the plate has the subject's colours, specks left out and a little widened."""
    import cv2

    at = plate // (256 // BINS)
    likely = cv2.GaussianBlur(odds[at[..., 0], at[..., 1], at[..., 2]], (0, 0), max(plate.shape[:2]) / 360)
    side = max(3, max(plate.shape[:2]) // 144 | 1)
    found = (np.asarray(likely) > ODDS).astype(np.uint8)
    return _widened(np.asarray(cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))) > 0, side)


def _histogram(colours: UInt8[np.ndarray, "pixel 3"]) -> Float32[np.ndarray, "red green blue"]:
    """How probable each colour is, neighbouring bins mixed."""
    index = np.ravel_multi_index(tuple((colours // (256 // BINS)).T), (BINS,) * 3)
    counts = np.bincount(index, minlength=BINS**3).reshape((BINS,) * 3).astype(np.float32)
    for axis in range(3):
        padded = np.pad(counts, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
        lower, middle, upper = (padded.take(range(k, k + BINS), axis) for k in range(3))
        counts = (lower + 2 * middle + upper) / 4
    return (counts + 1e-2) / (counts.sum() + 1e-2 * BINS**3)


def _median_of(images: Sequence[Rgb], free: Bool[np.ndarray, "time height width"]) -> Rgb:
    """The median of the free pixels; of all where none is."""
    free = free | ~free.any(0)
    plate = np.empty_like(images[0])
    for row in range(0, len(plate), 32):  # a band at once: it takes floats
        stack = np.stack([image[row : row + 32] for image in images]).astype(np.float32)
        stack[~free[:, row : row + 32]] = np.nan
        plate[row : row + 32] = np.nanmedian(stack, axis=0).round()
    return plate


def _widened(inside: Bool[np.ndarray, "height width"], by_px: int) -> Bool[np.ndarray, "height width"]:
    import cv2

    return np.asarray(cv2.dilate(inside.astype(np.uint8), np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8))) > 0
