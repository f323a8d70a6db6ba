"""Where a board's corners are in an image, to a hundredth of a pixel.

Four squares meet in a corner, and along their edges there is nothing but black and white, up to the markers. So the
picture of two edges that cross is fitted to the pixels about them (after Lucchese and Mitra, "Using saddle points for
subpixel feature detection in camera calibration targets", 2002, who fit a saddle to the blurred middle alone). In the
board's own plane edges are square to each other, however aslant it is seen.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

ALONG = 0.42
"""So much of each edge is looked at, as a share of a square's side."""
CLEAR_PX, LEAST_CLEAR = 0.8, 0.35
"""Pixels stay so far away from the markers, but have this share of the gap before them at least."""
BLUR_PX, BLURS_PX = 0.5, (0.3, 2.0)
"""How soft edges are at first, and may be: the hyperbolic tangent's scale."""
STEPS = 6
LEAST_PIXELS = 12
MOST_STEP_PX, MOST_MOVE_PX = 0.5, 2.5
"""A step is cut to the first; a corner that would end farther from where it was found stays there."""
OUTLIER_PX = 1.5
"""Corners that lie farther from where the others have them say nothing of the board's plane."""


@dataclass(frozen=True)
class _Plane:
    """The board's plane as an image shows it, by a homography."""

    image_from_board: Float64[np.ndarray, "3 3"]

    def pixels(self, on_board_m: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "point 2"]:
        return _mapped(self.image_from_board, on_board_m)

    def on_board_m(self, pixels: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "point 2"]:
        return _mapped(np.linalg.inv(self.image_from_board), pixels)

    def pixels_per_m(self, at_m: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "2 2"]:
        """The homography's derivative."""
        x, y, w = self.image_from_board @ [*at_m, 1.0]
        top = self.image_from_board[:2, :2]
        return (top - np.outer([x / w, y / w], self.image_from_board[2, :2])) / w


def refined(
    grey: UInt8[np.ndarray, "height width"],
    pixels: Float64[np.ndarray, "corner 2"],
    on_board_m: Float64[np.ndarray, "corner 2"],
    square_m: float,
    marker_m: float,
) -> Float64[np.ndarray, "corner 2"]:
    """Corners of a board where its edges cross.

    Args:
        grey: the image.
        pixels: where the corners were found, to a pixel or two; the top-left pixel has its centre at (0.5, 0.5).
        on_board_m: where they are on the board, along its edges, metres.
        square_m: a square's side.
        marker_m: a marker's side, in the middle of a white square.

    Returns:
        The pixels of each; those about whom too little is seen stay.
    """
    import cv2

    found = cv2.findHomography(on_board_m, pixels - 0.5, cv2.RANSAC, OUTLIER_PX)[0]
    if found is None:
        return pixels
    plane = _Plane(np.asarray(found))
    clear_m = (square_m - marker_m) / 2
    moved = [_crossing(grey, plane, one, square_m, clear_m) for one in pixels - 0.5]
    return np.array(moved).reshape(-1, 2) + 0.5


def _crossing(
    grey: UInt8[np.ndarray, "height width"],
    plane: _Plane,
    start_px: Float64[np.ndarray, "2"],
    square_m: float,
    clear_m: float,
) -> Float64[np.ndarray, "2"]:
    """Where two edges cross, from where that was found; the top-left pixel is (0, 0)."""
    start_m = plane.on_board_m(start_px[None])[0]
    per_m = plane.pixels_per_m(start_m)
    if not np.isfinite(per_m).all() or abs(np.linalg.det(per_m)) < 1e-9:
        return start_px
    per_px = np.linalg.norm(np.linalg.inv(per_m), axis=1)  # metres along x and y of the board, of one pixel
    reach = np.abs(per_m).sum(1) * ALONG * square_m
    low = np.maximum(np.ceil(start_px - reach), 0).astype(int)
    high = np.minimum(np.floor(start_px + reach) + 1, [grey.shape[1], grey.shape[0]]).astype(int)
    if (high - low < 3).any():
        return start_px
    pixels = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 2)
    away_m = plane.on_board_m(pixels.astype(np.float64)) - start_m
    clear = np.maximum(clear_m - CLEAR_PX * per_px, LEAST_CLEAR * clear_m)
    used = (np.abs(away_m) < clear).any(1) & (np.abs(away_m) < ALONG * square_m).all(1)
    if used.sum() < LEAST_PIXELS:
        return start_px
    moved_px = _fitted(away_m[used] / per_px, grey[pixels[used, 1], pixels[used, 0]].astype(np.float64))
    if not (np.abs(moved_px) < MOST_MOVE_PX).all():
        return start_px
    return plane.pixels((start_m + moved_px * per_px)[None])[0]


def _fitted(at: Float64[np.ndarray, "pixel 2"], values: Float64[np.ndarray, "pixel"]) -> Float64[np.ndarray, "2"]:
    """Where the edges x = x0 and y = y0 cross: Gauss and Newton's steps for place, softness, darkness and contrast.

    The picture is a + b tanh((x - x0) / s) tanh((y - y0) / s), with all lengths in pixels.
    """
    cross, blur = np.zeros(2), BLUR_PX
    for _ in range(STEPS):
        x, y = ((at - cross) / blur).T
        fx, fy = np.tanh(x), np.tanh(y)
        dx, dy = (1 - fx**2) * fy / blur, (1 - fy**2) * fx / blur
        level = np.stack([np.ones_like(x), fx * fy], 1)
        a, b = np.linalg.lstsq(level, values, rcond=None)[0]
        columns = [*level.T, -b * dx, -b * dy, -b * (dx * x + dy * y)]
        step = np.linalg.lstsq(np.stack(columns, 1), values - a - b * fx * fy, rcond=None)[0]
        cross = cross + step[2:4].clip(-MOST_STEP_PX, MOST_STEP_PX)
        blur = float(np.clip(blur + np.clip(step[4], -blur / 3, blur / 3), *BLURS_PX))
    return cross


def _mapped(
    matrix: Float64[np.ndarray, "3 3"], points: Float64[np.ndarray, "point 2"]
) -> Float64[np.ndarray, "point 2"]:
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1) @ matrix.T
    return homogeneous[:, :2] / homogeneous[:, 2:]
