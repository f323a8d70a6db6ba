"""A ChArUco board, and its corners in images."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int, UInt8

from viewmend.data.camera_reader import CameraReader
from viewmend.data.capture_folder import read_clock
from viewmend.data.errors import CaptureError
from viewmend.data.formats.files import collect_footage, list_images
from viewmend.data.native_format import FILE_KINDS, NativeCalibration, NativeCamera
from viewmend.data.videos import is_video

ALONG = 0.42
"""Part of each edge that is used, as a share of a square's side."""
CLEAR_PX = 0.8
"""Pixels closer to a marker than this, pixels, are not used."""
LEAST_CLEAR = 0.35
"""The smallest fraction of the gap between corner and marker that is used."""
BLUR_PX = 0.5
"""The search begins with edges this soft: the scale of the hyperbolic tangent, pixels."""
BLURS_PX = (0.3, 2.0)
"""Edges are at least and at most this soft, pixels."""
STEPS = 6
"""A corner is refined in at most this many steps."""
LEAST_PIXELS = 12
"""A corner is refined if at least this many pixels show its edges."""
MOST_STEP_PX = 0.5
"""A step moves a corner by at most this many pixels."""
MOST_MOVE_PX = 2.5
"""A corner that would end more than this many pixels from where it was found stays there."""
OUTLIER_PX = 1.5
"""Corners farther from the plane of the others are ignored."""


Grey = UInt8[np.ndarray, "height width"]
Points = Float64[np.ndarray, "point 2"]
LEAST_CORNERS = 8
"""Images with fewer corners are ignored."""


def refined(grey: Grey, pixels: Points, on_board_m: Points, square_m: float, marker_m: float) -> Points:
    """Move a board's corners to where its edges cross, in pixels; corners with too few edge pixels stay where they are.

    They were found at `pixels`, to a pixel or two; the top-left pixel has its centre at (0.5, 0.5).
    On the board, along its edges, they are at `on_board_m`. `square_m` is a square's side,
    `marker_m` that of a marker in its middle.
    """
    found = cv2.findHomography(on_board_m, pixels - 0.5, cv2.RANSAC, OUTLIER_PX)[0]
    if found is None:
        return pixels
    clear_m = (square_m - marker_m) / 2
    moved = [_crossing(grey, np.asarray(found), one, square_m, clear_m) for one in pixels - 0.5]
    return np.array(moved).reshape(-1, 2) + 0.5


def _crossing(
    grey: Grey,
    image_from_board: Float64[np.ndarray, "3 3"],
    start_px: Float64[np.ndarray, "2"],
    square_m: float,
    clear_m: float,
) -> Float64[np.ndarray, "2"]:
    """Where two edges cross, from where that was found; the top-left pixel is (0, 0)."""
    board_from_image = np.linalg.inv(image_from_board)
    start_m = _mapped(board_from_image, start_px[None])[0]
    x, y, w = image_from_board @ [*start_m, 1.0]
    # The homography's derivative: pixels per metre.
    per_m = (image_from_board[:2, :2] - np.outer([x / w, y / w], image_from_board[2, :2])) / w
    if not np.isfinite(per_m).all() or abs(np.linalg.det(per_m)) < 1e-9:
        return start_px
    per_px = np.linalg.norm(np.linalg.inv(per_m), axis=1)  # metres along x and y of the board, of one pixel
    reach = np.abs(per_m).sum(1) * ALONG * square_m
    low = np.maximum(np.ceil(start_px - reach), 0).astype(int)
    high = np.minimum(np.floor(start_px + reach) + 1, [grey.shape[1], grey.shape[0]]).astype(int)
    if (high - low < 3).any():
        return start_px
    pixels = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True))), -1).reshape(
        -1, 2
    )
    away_m = _mapped(board_from_image, pixels.astype(np.float64)) - start_m
    clear = np.maximum(clear_m - CLEAR_PX * per_px, LEAST_CLEAR * clear_m)
    used = (np.abs(away_m) < clear).any(1) & (np.abs(away_m) < ALONG * square_m).all(1)
    if used.sum() < LEAST_PIXELS:
        return start_px
    moved_px = _fitted(away_m[used] / per_px, grey[pixels[used, 1], pixels[used, 0]].astype(np.float64))
    if not (np.abs(moved_px) < MOST_MOVE_PX).all():
        return start_px
    return _mapped(image_from_board, (start_m + moved_px * per_px)[None])[0]


def _fitted(at: Points, values: Float64[np.ndarray, "point"]) -> Float64[np.ndarray, "2"]:
    """Where the edges x = x0 and y = y0 cross: Gauss and Newton's steps for place, softness, darkness and contrast.

    The picture is a + b tanh((x - x0) / s) tanh((y - y0) / s), with all lengths in pixels.
    """
    cross = np.zeros(2)
    blur = BLUR_PX
    for _ in range(STEPS):
        x, y = ((at - cross) / blur).T
        fx = np.tanh(x)
        fy = np.tanh(y)
        dx = (1 - fx**2) * fy / blur
        dy = (1 - fy**2) * fx / blur
        level = np.stack([np.ones_like(x), fx * fy], 1)
        a, b = np.linalg.lstsq(level, values, rcond=None)[0]
        columns = [*level.T, -b * dx, -b * dy, -b * (dx * x + dy * y)]
        step = np.linalg.lstsq(np.stack(columns, 1), values - a - b * fx * fy, rcond=None)[0]
        cross = cross + step[2:4].clip(-MOST_STEP_PX, MOST_STEP_PX)
        blur = float(np.clip(blur + np.clip(step[4], -blur / 3, blur / 3), *BLURS_PX))
    return cross


def _mapped(matrix: Float64[np.ndarray, "3 3"], points: Points) -> Points:
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1) @ matrix.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


@dataclass(frozen=True)
class Corners:
    """Corners of a board in one image."""

    ids: Int[np.ndarray, "corner"]
    """Which of `Board.corners_m`."""
    pixels: Float64[np.ndarray, "corner 2"]
    """Where they are; the top-left pixel has its centre at (0.5, 0.5)."""


@dataclass(frozen=True)
class Board:
    """A ChArUco board: a chessboard with markers in its white squares, of which a camera may see a part."""

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str
    """Which of OpenCV's dictionaries the markers are of."""

    @cached_property
    def corners_m(self) -> Float64[np.ndarray, "corner 3"]:
        """Inner corners on the board, x right and y down, z = 0, row by row."""
        return np.asarray(self.opencv.getChessboardCorners(), np.float64)

    @cached_property
    def opencv(self) -> Any:
        """The board as OpenCV has it; its `generateImage` is what is printed."""
        return cv2.aruco.CharucoBoard(*self._layout)

    @cached_property
    def _layout(self) -> tuple[Any, ...]:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return (self.columns, self.rows), self.square_m, self.marker_m, dictionary

    @cached_property
    def _detectors(self) -> tuple[Any, Any]:
        """Detectors of today's pattern, and of that of OpenCV before 4.6 and calib.io, which differs for even rows."""
        old = cv2.aruco.CharucoBoard(*self._layout)
        old.setLegacyPattern(True)
        return cv2.aruco.CharucoDetector(self.opencv), cv2.aruco.CharucoDetector(old)

    def find(self, grey: Grey) -> Corners | None:
        """The corners that an image shows, in either pattern; None where they are too few, or all in a line."""
        new, old = self._detectors
        pixels, ids, markers, marker_ids = new.detectBoard(grey)
        if (ids is None or len(ids) < LEAST_CORNERS) and marker_ids is not None:
            pixels, ids = old.detectBoard(grey, markerCorners=markers, markerIds=marker_ids)[:2]
        if pixels is None or ids is None or len(ids) < LEAST_CORNERS:
            return None
        ids = np.asarray(ids).ravel().astype(int)
        on_board = self.corners_m[ids]
        if np.linalg.matrix_rank(on_board - on_board[0], tol=self.square_m / 2) < 2:
            return None
        found = np.asarray(pixels, np.float64).reshape(-1, 2) + 0.5
        return Corners(ids, refined(grey, found, on_board[:, :2], self.square_m, self.marker_m))


def parse_board(text: str, dictionary: str) -> Board:
    """A board from COLUMNSxROWS:SQUARE_M:MARKER_M and the name of OpenCV's dictionary; ValueError from other text."""
    parts = re.fullmatch(r"(\d{1,2})x(\d{1,2}):(\d*\.?\d+):(\d*\.?\d+)", text)
    if parts is None:
        example = "8x6:0.06:0.045 for 8 x 6 squares of 6 cm with markers of 4.5 cm"
        raise ValueError(f"expected --board COLUMNSxROWS:SQUARE_M:MARKER_M, got '{text}'; write {example}")
    columns = int(parts[1])
    rows = int(parts[2])
    square_m = float(parts[3])
    marker_m = float(parts[4])
    if not (min(columns, rows) >= 4 and 0 < marker_m < square_m):
        expected = "at least 4 x 4 squares, and markers smaller than squares"
        raise ValueError(f"expected {expected}, got '{text}'; measure again")
    if not re.fullmatch(r"DICT_\w+", dictionary) or not hasattr(cv2.aruco, dictionary):
        raise ValueError(
            f"expected a dictionary of OpenCV, got '{dictionary}'; choose one such as DICT_5X5_1000"
        )
    return Board(columns, rows, square_m, marker_m, dictionary)


def open_footage(folder: Path) -> NativeCalibration:
    """The cameras of two or more videos or folders of images in a folder, by name, with placeholder K and poses."""
    entries = sorted(entry for entry in folder.iterdir() if entry.name[0] != ".") if folder.is_dir() else []
    videos = {entry.stem: entry.name for entry in entries if entry.is_file() and is_video(entry.name)}
    chosen = videos or {
        entry.name: entry.name for entry in entries if entry.is_dir() and list_images(folder, entry.name)
    }
    if len(chosen) < 2:
        expected = "two or more videos, or folders of images"
        got = len(chosen)
        raise CaptureError(
            f"{folder}: expected {expected}, got {got}; put one for each camera there, named after it"
        )
    try:
        footage = collect_footage(folder, chosen)
    except ValueError as error:
        raise CaptureError(f"{folder}: {error}") from None
    nothing: dict[str, Any] = {"K": np.eye(3), "R": np.eye(3), "t_m": np.zeros(3), "dist": np.zeros(5)}
    nothing |= dict.fromkeys(FILE_KINDS)
    cameras = tuple(NativeCamera(name=name, **(nothing | footage.entries[name])) for name in chosen)
    return NativeCalibration(footage.frames, cameras, None, footage.fps, None, 1.0, folder, folder)


def look_for(
    board: Board,
    footage: NativeCalibration,
    times: Sequence[int],
    track: Callable[[Sequence[NativeCamera]], Iterable[NativeCamera]],
) -> dict[tuple[int, int], Corners]:
    """The board's corners, by camera and time, at these indices of the footage's frames.

    `track` wraps the cameras that are iterated over, as a progress bar. CaptureError if an image
    cannot be read, or has another size than the camera's first.
    """
    seen = {}
    clock = read_clock(footage)
    for view, camera in enumerate(track(footage.cameras)):
        reader = CameraReader(footage.folder, camera, footage.frames, clock)
        for time in times:
            images = (
                reader.read(time)
                if reader.has(time, lambda path: (footage.folder / path).is_file())
                else None
            )
            corners = None if images is None else board.find(cv2.cvtColor(images.rgb, cv2.COLOR_RGB2GRAY))
            if corners is not None:
                seen[view, time] = corners
    return seen
