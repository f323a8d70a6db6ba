"""Finds the corners of a ChArUco board in images."""

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

EDGE_FRACTION = 0.42
"""Length of the part of each edge that is used, as a fraction of a square's side."""
MARKER_MARGIN_PX = 0.8
"""Pixels within this distance of a marker are not used; pixels."""
MIN_GAP_FRACTION = 0.35
"""The smallest fraction of the gap between corner and marker that is used."""
BLUR_PX = 0.5
"""Initial width of an edge: the scale of its hyperbolic tangent, pixels."""
BLURS_PX = (0.3, 2.0)
"""Smallest and largest width of an edge, pixels."""
STEPS = 6
"""Largest number of steps that refine a corner."""
MIN_PIXELS = 12
"""Smallest number of pixels of its edges from which a corner is refined."""
MAX_STEP_PX = 0.5
"""Largest move of a corner in one step, pixels."""
MAX_MOVE_PX = 2.5
"""Largest total move of a corner, pixels. A corner that would move further stays where it was
detected."""
OUTLIER_PX = 1.5
"""Corners farther than this many pixels from the homography of the others are ignored."""


Grey = UInt8[np.ndarray, "height width"]
Points = Float64[np.ndarray, "point 2"]
MIN_CORNERS = 8
"""Images with fewer corners than this are ignored."""


def refine_corners(
    grey: Grey, pixels: Points, on_board_m: Points, square_m: float, marker_m: float
) -> Points:
    """Refine corners of a board to where its edges cross; those with too few edge pixels are unchanged.

    Positions are in pixels; the top-left pixel has its centre at (0.5, 0.5). `pixels` are accurate
    to a pixel or two. `on_board_m` are the corners' positions on the board, along its edges.
    `square_m` is a square's side, `marker_m` that of a marker in its middle.
    """
    found = cv2.findHomography(on_board_m, pixels - 0.5, cv2.RANSAC, OUTLIER_PX)[0]
    if found is None:
        return pixels
    clear_m = (square_m - marker_m) / 2
    moved = [_refine_corner(grey, np.asarray(found), one, square_m, clear_m) for one in pixels - 0.5]
    return np.array(moved).reshape(-1, 2) + 0.5


def _refine_corner(
    grey: Grey,
    image_from_board: Float64[np.ndarray, "3 3"],
    start_px: Float64[np.ndarray, "2"],
    square_m: float,
    clear_m: float,
) -> Float64[np.ndarray, "2"]:
    """Refine the crossing of two edges near `start_px`; the top-left pixel is (0, 0)."""
    board_from_image = np.linalg.inv(image_from_board)
    start_m = _apply_homography(board_from_image, start_px[None])[0]
    x, y, w = image_from_board @ [*start_m, 1.0]
    # The homography's derivative: pixels per metre.
    per_m = (image_from_board[:2, :2] - np.outer([x / w, y / w], image_from_board[2, :2])) / w
    if not np.isfinite(per_m).all() or abs(np.linalg.det(per_m)) < 1e-9:
        return start_px
    per_px = np.linalg.norm(np.linalg.inv(per_m), axis=1)  # metres along x and y of the board, of one pixel
    reach = np.abs(per_m).sum(1) * EDGE_FRACTION * square_m
    low = np.maximum(np.ceil(start_px - reach), 0).astype(int)
    high = np.minimum(np.floor(start_px + reach) + 1, [grey.shape[1], grey.shape[0]]).astype(int)
    if (high - low < 3).any():
        return start_px
    pixels = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True))), -1).reshape(
        -1, 2
    )
    away_m = _apply_homography(board_from_image, pixels.astype(np.float64)) - start_m
    clear = np.maximum(clear_m - MARKER_MARGIN_PX * per_px, MIN_GAP_FRACTION * clear_m)
    used = (np.abs(away_m) < clear).any(1) & (np.abs(away_m) < EDGE_FRACTION * square_m).all(1)
    if used.sum() < MIN_PIXELS:
        return start_px
    moved_px = _fit_crossing(away_m[used] / per_px, grey[pixels[used, 1], pixels[used, 0]].astype(np.float64))
    if not (np.abs(moved_px) < MAX_MOVE_PX).all():
        return start_px
    return _apply_homography(image_from_board, (start_m + moved_px * per_px)[None])[0]


def _fit_crossing(at: Points, values: Float64[np.ndarray, "point"]) -> Float64[np.ndarray, "2"]:
    """Fit the crossing of the edges x = x0 and y = y0, their width, brightness and contrast (Gauss-Newton).

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
        cross = cross + step[2:4].clip(-MAX_STEP_PX, MAX_STEP_PX)
        blur = float(np.clip(blur + np.clip(step[4], -blur / 3, blur / 3), *BLURS_PX))
    return cross


def _apply_homography(matrix: Float64[np.ndarray, "3 3"], points: Points) -> Points:
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1) @ matrix.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


@dataclass(frozen=True)
class Corners:
    """Corners of a board in one image."""

    ids: Int[np.ndarray, "corner"]
    """Indices into `Board.corners_m`."""
    pixels: Float64[np.ndarray, "corner 2"]
    """Positions in the image, pixels; the top-left pixel has its centre at (0.5, 0.5)."""


@dataclass(frozen=True)
class Board:
    """A ChArUco board: a chessboard with markers in its white squares, of which a camera may see a part."""

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str
    """Name of the OpenCV dictionary of the markers."""

    @cached_property
    def corners_m(self) -> Float64[np.ndarray, "corner 3"]:
        """Inner corners on the board, x right and y down, z = 0, row by row."""
        return np.asarray(self.opencv.getChessboardCorners(), np.float64)

    @cached_property
    def opencv(self) -> Any:
        """The board as an OpenCV object; its `generateImage` draws the board for printing."""
        return cv2.aruco.CharucoBoard(*self._layout)

    @cached_property
    def _layout(self) -> tuple[Any, ...]:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return (self.columns, self.rows), self.square_m, self.marker_m, dictionary

    @cached_property
    def _detectors(self) -> tuple[Any, Any]:
        """Detectors of OpenCV's pattern, and of the one before 4.6, which differs for even rows."""
        old = cv2.aruco.CharucoBoard(*self._layout)
        old.setLegacyPattern(True)
        return cv2.aruco.CharucoDetector(self.opencv), cv2.aruco.CharucoDetector(old)

    def find(self, grey: Grey) -> Corners | None:
        """Find the corners in an image, in either pattern; None if they are too few or on one line."""
        new, old = self._detectors
        pixels, ids, markers, marker_ids = new.detectBoard(grey)
        if (ids is None or len(ids) < MIN_CORNERS) and marker_ids is not None:
            pixels, ids = old.detectBoard(grey, markerCorners=markers, markerIds=marker_ids)[:2]
        if pixels is None or ids is None or len(ids) < MIN_CORNERS:
            return None
        ids = np.asarray(ids).ravel().astype(int)
        on_board = self.corners_m[ids]
        if np.linalg.matrix_rank(on_board - on_board[0], tol=self.square_m / 2) < 2:
            return None
        found = np.asarray(pixels, np.float64).reshape(-1, 2) + 0.5
        return Corners(ids, refine_corners(grey, found, on_board[:, :2], self.square_m, self.marker_m))


def parse_board(text: str, dictionary: str) -> Board:
    """Parse COLUMNSxROWS:SQUARE_M:MARKER_M and an OpenCV dictionary's name; ValueError for other text."""
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
    """Open the videos or image folders of a folder as cameras, with placeholders for K and poses.

    CaptureError if there are fewer than two, both kinds, or two videos of one name.
    """
    entries = sorted(entry for entry in folder.iterdir() if entry.name[0] != ".") if folder.is_dir() else []
    videos = [entry for entry in entries if entry.is_file() and is_video(entry.name)]
    images = [entry for entry in entries if entry.is_dir() and list_images(folder, entry.name)]
    if videos and images:
        raise CaptureError(
            f"{folder}: expected videos or folders of images, got both ('{videos[0].name}' and '{images[0].name}'); "
            "put only the footage of the board there"
        )
    chosen: dict[str, str] = {}
    for entry in videos or images:
        name = entry.stem if videos else entry.name
        if name in chosen:
            raise CaptureError(
                f"{folder}: expected one video for each camera, got '{chosen[name]}' and '{entry.name}'; "
                "move one of them away"
            )
        chosen[name] = entry.name
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
    # pyrefly: ignore[bad-argument-type]
    cameras = tuple(NativeCamera(name=name, **(nothing | footage.entries[name])) for name in chosen)
    return NativeCalibration(footage.frames, cameras, None, footage.fps, None, 1.0, folder, folder)


def find_board(
    board: Board,
    footage: NativeCalibration,
    times: Sequence[int],
    track: Callable[[Sequence[NativeCamera]], Iterable[NativeCamera]],
) -> dict[tuple[int, int], Corners]:
    """Find the board in these frames of all cameras; returns corners by index of camera and frame.

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
