"""Corners of a board where its edges cross, beside the camera that took the picture."""

import cv2
import numpy as np
import pytest
from reference.filmed_board import photograph

from viewmend.preprocess.calibration.board import parse_board, refine_corners

BOARD = parse_board("8x6:0.12:0.09", "DICT_5X5_1000")
K = np.array([[620.0, 0, 256], [0, 615, 306], [0, 0, 1]])
SIZE_PX = (512, 612)
STRAIGHT, BENT = np.zeros(5), np.array([-0.06, 0.02, 0, 0, 0])


def pictured(tilt_deg, lens=STRAIGHT, noise=2.0, blur_px=0.0, board=BOARD):
    """A picture of the board, and where all its corners are in it."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.deg2rad([0.3 * tilt_deg, tilt_deg, 8.0]))[0]
    pose[:3, 3] = np.array([0, 0, 2.6]) - pose[:3, :3] @ [0.48, 0.36, 0]
    image = photograph(board, K, lens, pose, SIZE_PX).astype(np.float64)
    image += np.random.default_rng(0).normal(0, noise, image.shape)
    image = cv2.GaussianBlur(image, (0, 0), blur_px) if blur_px else image
    true = cv2.projectPoints(BOARD.corners_m, pose[:3, :3], pose[:3, 3], K, lens)[0][:, 0]
    return image.clip(0, 255).astype(np.uint8), true


def moved(image, start):
    return refine_corners(image, start, BOARD.corners_m[:, :2], BOARD.square_m, BOARD.marker_m)


@pytest.mark.parametrize("lens", [STRAIGHT, BENT], ids=["straight", "bent"])
@pytest.mark.parametrize(("tilt_deg", "blur_px"), [(0, 0.0), (35, 0.0), (35, 1.0), (-60, 0.0)])
def test_corners_are_found_to_a_few_hundredths_of_a_pixel(tilt_deg, blur_px, lens):
    image, true = pictured(tilt_deg, lens, blur_px=blur_px)
    start = true + np.random.default_rng(1).uniform(-0.5, 0.5, true.shape)
    off = np.linalg.norm(moved(image, start) - true, axis=1)
    assert np.median(off) < 0.02 and off.max() < 0.15


def test_a_board_is_found_better_than_opencv_does():
    image, true = pictured(-55)
    found = BOARD.find(image)
    plain = cv2.aruco.CharucoDetector(BOARD.opencv).detectBoard(image)
    theirs = np.linalg.norm(plain[0].reshape(-1, 2) + 0.5 - true[plain[1].ravel()], axis=1)
    ours = np.linalg.norm(found.pixels - true[found.ids], axis=1)
    assert len(ours) > 20 and np.sqrt((ours**2).mean()) < 0.25 * np.sqrt((theirs**2).mean())


def test_boards_of_both_patterns_are_found():
    """Before OpenCV 4.6, and from calib.io, boards with an even number of rows start with a marker."""
    board = parse_board("8x6:0.12:0.09", "DICT_5X5_1000")
    board.opencv.setLegacyPattern(True)  # only what is printed
    image, true = pictured(30, board=board)
    found = BOARD.find(image)
    assert len(found.ids) > 20 and np.abs(found.pixels - true[found.ids]).max() < 0.2
    assert cv2.aruco.CharucoDetector(BOARD.opencv).detectBoard(pictured(30)[0])[1] is not None


def test_where_nothing_is_seen_corners_stay():
    start = pictured(0)[1]
    for image in (np.full((612, 512), 110, np.uint8), np.zeros((612, 512), np.uint8)):
        assert np.allclose(moved(image, start), start, atol=1e-9)
    beside = start + np.array([600, 0])
    assert np.allclose(moved(pictured(0)[0], beside), beside, atol=1e-9)


def test_corners_that_are_no_boards_stay():
    scattered = np.random.default_rng(0).uniform(0, 500, (len(BOARD.corners_m), 2))
    found = moved(pictured(0)[0], scattered)
    assert np.isfinite(found).all() and np.abs(found - scattered).max() < 60
