"""Outlines of masks to parts of a pixel: points along them, and how far from them every pixel is."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from viewmend.geometry.hull import FOREGROUND

FINER = 3
"""Masks are enlarged by this much, so that soft ones tell parts of a pixel."""
BORDER_PX = 3
"""An outline so near to its image's border is where the image ends, not the subject."""


@dataclass(frozen=True)
class Outline:
    """The outline of one mask."""

    points: Float64[np.ndarray, "point 2"]
    """Points along it, pixels."""
    outside_px: Float32[np.ndarray, "height width"]
    """How far outside of it each pixel's centre is; negative inside."""


def find_outline(mask: UInt8[np.ndarray, "height width"], count: int) -> Outline | None:
    """The outline of the foreground with about `count` points, evenly along it; None without any foreground."""
    import cv2

    height, width = mask.shape
    large = cv2.resize(mask, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR)
    inside = (large > FOREGROUND).astype(np.uint8)
    if not inside.any() or inside.all():
        return None
    away, within = (cv2.distanceTransform(side, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for side in (1 - inside, inside))
    outside_px = cv2.resize((away - within) / FINER, (width, height), interpolation=cv2.INTER_AREA)
    contours = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    along = np.concatenate([contour[:, 0] for contour in contours]).astype(np.float64)
    points = (along + 0.5) / FINER  # half a small pixel inside of the outline
    clear = ((points > BORDER_PX) & (points < np.array([width, height]) - BORDER_PX)).all(1)
    points = points[clear]
    points = points[:: max(1, len(points) // count)]
    value, slope = look_up(outside_px.ravel(), np.zeros(len(points), int), (width, height), points)
    points = points - value[:, None] * slope / np.maximum((slope**2).sum(1, keepdims=True), 0.25)
    return Outline(points, outside_px)


def look_up(
    flat: Float32[np.ndarray, "_pixel"],
    first: np.ndarray,
    size: tuple[int, int],
    uv_px: Float64[np.ndarray, "*point 2"],
) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear values at pixel positions of images that lie one after the other, and their slopes in x and y.

    Args:
        flat: all images' pixels.
        first: where each position's image begins.
        size: width and height of each image.
        uv_px: positions; beyond the border the nearest of it.
    """
    width, height = size
    x, y = np.clip(uv_px[..., 0] - 0.5, 0, width - 1.001), np.clip(uv_px[..., 1] - 0.5, 0, height - 1.001)
    left, top = x.astype(int), y.astype(int)
    right, below = x - left, y - top
    at = first + top * width + left
    a, b, c, d = flat[at], flat[at + 1], flat[at + width], flat[at + width + 1]
    upper, lower = a + right * (b - a), c + right * (d - c)
    slope_x = (b - a) + below * ((d - c) - (b - a))
    return upper + below * (lower - upper), np.stack([slope_x, lower - upper], -1)
