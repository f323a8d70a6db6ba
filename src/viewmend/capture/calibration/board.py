"""A ChArUco board, and its corners in images."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64, Int, UInt8

from viewmend.capture.calibration.corners import refined

LEAST_CORNERS = 8
"""Fewer corners in an image say too little of where the board is."""


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
    """Squares across."""
    rows: int
    """Squares downwards."""
    square_m: float
    """A square's side."""
    marker_m: float
    """A marker's side."""
    dictionary: str
    """Which of OpenCV's dictionaries the markers are of."""

    @cached_property
    def corners_m(self) -> Float64[np.ndarray, "corner 3"]:
        """Inner corners on the board, x right and y down, z = 0, row by row."""
        return np.asarray(self.opencv.getChessboardCorners(), np.float64)

    @cached_property
    def opencv(self) -> Any:
        """The board as OpenCV has it; its `generateImage` is what is printed."""
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)

    @cached_property
    def _detector(self) -> Any:
        import cv2

        return cv2.aruco.CharucoDetector(self.opencv)

    def find(self, grey: UInt8[np.ndarray, "height width"]) -> Corners | None:
        """The corners that an image shows; None where they are too few, or all in a line."""
        pixels, ids = self._detector.detectBoard(grey)[:2]
        if pixels is None or ids is None or len(ids) < LEAST_CORNERS:
            return None
        ids = np.asarray(ids).ravel().astype(int)
        on_board = self.corners_m[ids]
        if np.linalg.matrix_rank(on_board - on_board[0], tol=self.square_m / 2) < 2:
            return None
        found = np.asarray(pixels, np.float64).reshape(-1, 2) + 0.5
        return Corners(ids, refined(grey, found, on_board[:, :2], self.square_m, self.marker_m))


def parse_board(text: str, dictionary: str) -> Board:
    """A board of its words, COLUMNSxROWS:SQUARE_M:MARKER_M, and the name of OpenCV's dictionary.

    Raises:
        ValueError: they name none.
    """
    import cv2

    parts = re.fullmatch(r"(\d{1,2})x(\d{1,2}):(\d*\.?\d+):(\d*\.?\d+)", text)
    if parts is None:
        raise ValueError(
            f"expected --board COLUMNSxROWS:SQUARE_M:MARKER_M, got '{text}'; "
            "write 8x6:0.06:0.045 for 8 x 6 squares of 6 cm with markers of 4.5 cm"
        )
    columns, rows, square_m, marker_m = int(parts[1]), int(parts[2]), float(parts[3]), float(parts[4])
    if not (min(columns, rows) >= 4 and 0 < marker_m < square_m):
        raise ValueError(
            f"expected at least 4 x 4 squares, and markers smaller than squares, got '{text}'; measure again"
        )
    if not re.fullmatch(r"DICT_\w+", dictionary) or not hasattr(cv2.aruco, dictionary):
        raise ValueError(f"expected a dictionary of OpenCV, got '{dictionary}'; choose one such as DICT_5X5_1000")
    return Board(columns, rows, square_m, marker_m, dictionary)
