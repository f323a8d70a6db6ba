"""Masks by a running model of the background, where there is no clean plate."""

from collections import deque
from typing import Any, Literal

import numpy as np

from viewmend.capture.masks.maker import Mask, Rgb, demand_size, softened, tidied
from viewmend.capture.masks.plate import PlateMasks, median_plate

ModelKind = Literal["mog2", "knn", "median"]
HISTORY = 500
"""Images after which OpenCV's models have forgotten."""
BACKGROUND_RATIO = 0.7
"""The most frequent colours that make up so much of the time are background to `mog2`."""
KEPT = 25
"""Images that the median is taken of."""
KEEP_EVERY = 8
"""One running image in so many is kept for it."""


class ModelMasks:
    """Makes masks of what a model of the background does not explain; it learns from each image.

    `mog2` and `knn` are OpenCV's; `median` is the plate that the median of kept images makes. What stays in one place
    for long becomes background in each of them: `learn` images without the subject first, and give `learning` False,
    where the subject hardly moves.
    """

    def __init__(self, kind: ModelKind = "mog2", learning: bool = True):
        self._learning = learning
        self._seen = 0
        self._model = _MedianModel() if kind == "median" else _OpenCvModel(kind)

    def learn(self, rgb: Rgb) -> None:
        """Take an image into the background."""
        self._model.learn(rgb)

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of the next image, 0 to 255; nothing of the very first one.

        Raises:
            ValueError: the image is not of the size of those before.
        """
        mask = self._model.mask(rgb)
        if self._learning and self._seen % self._model.every == 0:
            self._model.learn(rgb)
        self._seen += 1
        return mask


class _OpenCvModel:
    every = 1

    def __init__(self, kind: Literal["mog2", "knn"]):
        import cv2

        make: Any = cv2.createBackgroundSubtractorMOG2 if kind == "mog2" else cv2.createBackgroundSubtractorKNN
        self._model = make(history=HISTORY, detectShadows=True)
        if kind == "mog2":
            self._model.setBackgroundRatio(BACKGROUND_RATIO)
        self._first: Rgb | None = None

    def learn(self, rgb: Rgb) -> None:
        self._model.apply(rgb)
        self._first = rgb if self._first is None else self._first

    def mask(self, rgb: Rgb) -> Mask:
        if self._first is None:
            return np.zeros(rgb.shape[:2], np.uint8)
        demand_size(rgb, self._first, "the first image")
        # Shadows are 127 there, and no subject.
        return softened(tidied(np.asarray(self._model.apply(rgb, learningRate=0)) == 255), edge_px=1.0)


class _MedianModel:
    every = KEEP_EVERY

    def __init__(self):
        self._kept: deque[Rgb] = deque(maxlen=KEPT)
        self._plate: PlateMasks | None = None

    def learn(self, rgb: Rgb) -> None:
        self._kept.append(rgb)
        self._plate = None

    def mask(self, rgb: Rgb) -> Mask:
        if not self._kept:
            return np.zeros(rgb.shape[:2], np.uint8)
        if self._plate is None:
            self._plate = PlateMasks(median_plate(self._kept))
        return self._plate.mask(rgb)
