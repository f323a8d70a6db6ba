"""Removes lens distortion from the images of a camera."""

import functools
import math
import threading
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int16, UInt16

from viewmend.data.camera_images import CameraImages
from viewmend.data.native_format import NativeCamera

STEPS = 32
"""Positions in the distorted image are rounded to this part of a pixel, as OpenCV does."""
ROWS_AT_ONCE = 32
"""Positions are computed for this many rows together, which bounds the memory."""


class Undistortion:
    """Removes the lens distortion of one camera. Computes its map at first use. Thread-safe."""

    def __init__(self, camera: NativeCamera):
        self._camera = camera
        self._lock = threading.Lock()
        self._map: PixelMap | None = None

    def apply(self, images: CameraImages) -> CameraImages:
        """Undistort images to the pinhole camera with the same K and size; returns them if there is no distortion.

        Pixels that lie outside the distorted image (corners, with pincushion distortion) repeat its
        border, so that the mask of a subject cut off by the border continues and does not carve the
        hull. Pixels beyond the lens model's `largest_radius` repeat the last ones that it describes.
        Depth there is 0, unknown.
        """
        if not self._camera.dist.any():
            return images
        with self._lock:
            if self._map is None:
                self._map = pixel_map(self._camera)
        own = self._map
        at = (own.positions, own.fractions)
        smooth = functools.partial(cv2.remap, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        rgb = smooth(images.rgb, *at)
        mask = images.mask
        depth = images.depth
        if mask is not None:
            mask = smooth(mask, *at)
        if depth is not None:  # nearest: interpolated depths would be wrong at edges
            depth = cv2.remap(depth, *at, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
            if own.beyond is not None:
                depth[own.beyond] = 0
        return CameraImages(rgb, mask, depth)


class PixelMap(NamedTuple):
    """Where the pixels of an undistorted image are in the distorted one, in OpenCV's fixed-point format.

    Images are mapped three times as fast as with floats.
    """

    positions: Int16[np.ndarray, "height width 2"]
    """Column and row of the pixel at the top left of each position."""
    fractions: UInt16[np.ndarray, "height width"]
    """Steps below this pixel times `STEPS`, and steps to its right."""
    beyond: Bool[np.ndarray, "height width"] | None
    """Pixels that the lens model does not describe; None if it describes all."""


def pixel_map(camera: NativeCamera) -> PixelMap:
    """The map of a camera: OpenCV's, which is faster, unless the lens model does not describe the whole image.

    Beyond `largest_radius`, OpenCV mirrors the image.
    """
    K = camera.K.copy()
    K[:2, 2] -= 0.5  # in OpenCV the centre of the first pixel is at 0
    size = (camera.width, camera.height)
    largest = largest_radius(camera.dist)
    corners = np.array([[column, row, 1] for row in (0, size[1]) for column in (0, size[0])])
    farthest = np.linalg.norm(np.linalg.solve(camera.K, corners.T)[:2], axis=0).max()
    if farthest <= largest:
        positions, fractions = cv2.initUndistortRectifyMap(K, camera.dist, None, K, size, cv2.CV_16SC2)
        return PixelMap(positions, fractions, None)
    bands = [
        _rows_of_map(K, camera.dist, largest, size, first) for first in range(0, camera.height, ROWS_AT_ONCE)
    ]
    positions, fractions, beyond = (np.concatenate(parts) for parts in zip(*bands, strict=True))
    return PixelMap(positions, fractions, beyond)


def _rows_of_map(
    K: Float64[np.ndarray, "3 3"],
    dist: Float64[np.ndarray, "5"],
    largest: float,
    size: tuple[int, int],
    first: int,
) -> tuple[
    Int16[np.ndarray, "rows width 2"], UInt16[np.ndarray, "rows width"], Bool[np.ndarray, "rows width"]
]:
    """The map of some rows, from the row `first` on; the first pixel's centre is at 0."""
    width, height = size
    row, column = np.mgrid[first : min(first + ROWS_AT_ONCE, height), :width].astype(np.float64)
    y = (row - K[1, 2]) / K[1, 1]
    x = (column - K[0, 2] - K[0, 1] * y) / K[0, 0]
    radius = np.hypot(x, y)
    beyond = radius > largest
    nearer = np.minimum(largest / np.maximum(radius, 1e-9), 1)
    x *= nearer
    y *= nearer

    seen_x, seen_y = _distorted(x, y, dist)
    u = K[0, 0] * seen_x + K[0, 1] * seen_y + K[0, 2]
    v = K[1, 1] * seen_y + K[1, 2]
    # Farther outside, all pixels are the same, and numbers would be too large
    steps_x = np.rint(STEPS * u.clip(-1, width)).astype(np.int32)
    steps_y = np.rint(STEPS * v.clip(-1, height)).astype(np.int32)
    positions = np.stack([steps_x // STEPS, steps_y // STEPS], -1).astype(np.int16)
    return positions, (steps_y % STEPS * STEPS + steps_x % STEPS).astype(np.uint16), beyond


def _distorted(
    x: Float64[np.ndarray, "rows width"], y: Float64[np.ndarray, "rows width"], dist: Float64[np.ndarray, "5"]
) -> tuple[Float64[np.ndarray, "rows width"], Float64[np.ndarray, "rows width"]]:
    """Rays at depth 1 after the lens."""
    k1, k2, p1, p2, k3 = dist
    square = x * x + y * y
    radial = 1 + ((k3 * square + k2) * square + k1) * square
    distorted_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    distorted_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return distorted_x, distorted_y


def largest_radius(dist: Float64[np.ndarray, "5"]) -> float:
    """The distance from the axis, at depth 1, up to which a lens model describes a lens; infinite for most.

    Beyond it the polynomial of k1, k2 and k3 falls, and images would continue with a mirrored copy.
    """
    k1, k2, _, _, k3 = dist.tolist()
    squares = np.roots([7 * k3, 5 * k2, 3 * k1, 1])
    real = squares.real[np.abs(squares.imag) <= 1e-9 * np.abs(squares)]
    return math.sqrt(min(real[real > 0], default=math.inf))
