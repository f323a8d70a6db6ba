"""Lens distortion, against OpenCV and against itself."""

import cv2
import numpy as np
import pytest
import torch

from viewmend.geometry.cameras import pixel_centers
from viewmend.geometry.distortion import distort, undistort_points, undistortion_grid

K = torch.tensor([[490.0, 0.0, 330.0], [0.0, 492.0, 230.0], [0.0, 0.0, 1.0]])
LENSES = {
    "strong barrel": [-0.37, 0.2, 3e-4, -2e-3, -0.07],
    "pincushion": [0.2, 0.05, -1e-3, 1e-3, 0.01],
    "none": [0.0, 0.0, 0.0, 0.0, 0.0],
}


def points(reach: float = 0.6) -> torch.Tensor:
    side = torch.linspace(-reach, reach, 9)
    return torch.stack(torch.meshgrid(side, side, indexing="ij"), -1)


@pytest.mark.parametrize("lens", LENSES)
def test_undistortion_inverts_distortion(lens):
    dist = torch.tensor(LENSES[lens])
    torch.testing.assert_close(undistort_points(distort(points(), dist), dist), points(), atol=2e-6, rtol=0)


@pytest.mark.parametrize("lens", LENSES)
def test_four_steps_come_close(lens):
    """Newton's method squares the error at each step; with a wrong slope it would not."""
    dist = torch.tensor(LENSES[lens])
    near = undistort_points(distort(points(), dist), dist, steps=4)
    torch.testing.assert_close(near, points(), atol=1e-5, rtol=0)


@pytest.mark.parametrize("lens", LENSES)
def test_equals_opencv(lens):
    dist = torch.tensor(LENSES[lens])
    at = torch.cat([points(), torch.ones(9, 9, 1)], -1).reshape(-1, 3).double().numpy()
    theirs, _ = cv2.projectPoints(at, np.zeros(3), np.zeros(3), np.eye(3), dist.double().numpy())
    torch.testing.assert_close(
        distort(points(), dist).view(-1, 2).double(), torch.from_numpy(theirs[:, 0]), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize("lens", LENSES)
def test_the_grid_samples_where_opencv_does(lens):
    """OpenCV's K counts pixel centres from 0, ours from one half."""
    theirs = K.double().numpy()
    theirs[:2, 2] -= 0.5
    dist = np.array(LENSES[lens])
    columns, rows = cv2.initUndistortRectifyMap(theirs, dist, None, theirs, (640, 480), cv2.CV_32FC1)
    grid = undistortion_grid(K, torch.tensor(dist).float(), 640, 480)
    torch.testing.assert_close(grid - 0.5, torch.from_numpy(np.stack([columns, rows], -1)), atol=1e-3, rtol=0)


def test_without_distortion_pixels_stay():
    torch.testing.assert_close(undistortion_grid(K, torch.zeros(5), 64, 48), pixel_centers(64, 48), atol=1e-4, rtol=0)


def test_the_image_is_not_shown_twice():
    """Beyond the radius at which the polynomial turns back, nothing is sampled."""
    dist = torch.tensor([-0.4, 0.0, 0.0, 0.0, 0.0])
    wide = torch.tensor([[100.0, 0.0, 100.0], [0.0, 100.0, 100.0], [0.0, 0.0, 1.0]])
    grid = undistortion_grid(wide, dist, 200, 200)
    radius = (pixel_centers(200, 200) - 100).norm(dim=-1) / 100
    turn = (1 / 1.2) ** 0.5
    assert (grid[radius > turn + 0.01] < -100).all()
    assert (grid[radius < turn - 0.01] > 0).all()
    row = grid[100, :, 0]
    assert (row[row > 0].diff() > 0).all()
