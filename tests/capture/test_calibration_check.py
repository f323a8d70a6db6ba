"""Hull and masks that agree score high, and the picture shows where they do not."""

import numpy as np
import pytest
import torch

from viewmend.capture.calibration_check import HULL_ONLY, MASK_ONLY, check_calibration, check_picture
from viewmend.contact_sheet import GAP_PX, LABEL_PX
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame

WHITE = (255, 255, 255)


@pytest.fixture
def cube() -> MultiViewFrame:
    """Two cameras three metres from a cube of 0.8 m, which fills a square of 30 pixels in both."""
    K = torch.tensor([[110.0, 0, 50], [0, 110.0, 40], [0, 0, 1]])
    front = torch.eye(4)
    front[2, 3] = 3
    side = torch.tensor([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 3], [0, 0, 0, 1]])
    cameras = Cameras(("front", "side"), K.expand(2, 3, 3), torch.stack([front, side]), torch.tensor([[100, 80]] * 2))
    mask = torch.zeros(2, 80, 100, dtype=torch.uint8)
    mask[:, 25:55, 35:65] = 255
    return MultiViewFrame(cameras, torch.full((2, 3, 80, 100), 100, dtype=torch.uint8), mask, 0)


def tiles_of(sheet: np.ndarray, width: int, height: int) -> list[np.ndarray]:
    top = GAP_PX + LABEL_PX
    lefts = [GAP_PX, GAP_PX + width + GAP_PX]
    return [sheet[top : top + height, left : left + width].astype(int) for left in lefts]


def near(tile: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return (np.abs(tile - colour) < 60).all(-1)


def test_masks_that_agree_score_high(cube):
    check = check_calibration(cube, None)
    assert set(check.iou) == {"front", "side"}
    assert min(check.iou.values()) > 0.9
    assert check.frame is cube and check.proxy is not None


def test_a_mask_that_disagrees_scores_low_and_shows(cube):
    cube.mask[1] = cube.mask[1].roll(12, 0)  # as if the second camera were turned
    check = check_calibration(cube, Bounds(-torch.ones(3), torch.ones(3)))
    assert max(check.iou.values()) < 0.75
    front, side = tiles_of(check_picture(check, None, tile_width=100), 100, 80)
    assert near(front, MASK_ONLY)[27:33, 38:62].mean() > 0.5  # the top of the front mask is carved away
    assert near(side, MASK_ONLY)[59:65, 38:62].mean() > 0.5  # and the bottom of the side mask
    assert near(front, HULL_ONLY).mean() < 0.02


def test_bounds_are_drawn_where_they_project(cube):
    check = check_calibration(cube, Bounds(-torch.ones(3) * 0.6, torch.ones(3) * 0.6))
    front, _ = tiles_of(check_picture(check, None, tile_width=100), 100, 80)
    far_left, far_top = 50 - 110 * 0.6 / 3.6, 40 - 110 * 0.6 / 3.6
    row = near(front, WHITE)[round(far_top) - 1 : round(far_top) + 2, 40:60]
    column = near(front, WHITE)[30:50, round(far_left) - 1 : round(far_left) + 2]
    assert row.any(0).all() and column.any(1).all()
    assert not near(front, WHITE)[45:50, 36:48].any()


def test_up_is_drawn_up(cube):
    check = check_calibration(cube, None)
    with_up, without = (
        tiles_of(check_picture(check, up, tile_width=100), 100, 80)[0] for up in (torch.tensor([0.0, -1.0, 0.0]), None)
    )
    rows = np.argwhere((with_up != without).any(-1))[:, 0]
    assert len(rows) and rows.max() <= 43  # from the middle of the cube towards smaller y


def test_a_capture_without_masks_is_checked_by_eye(cube):
    blind = MultiViewFrame(cube.cameras, cube.rgb, None, 0)
    check = check_calibration(blind, None)
    assert (check.iou, check.proxy, check.silhouettes) == ({}, None, None)
    torch.testing.assert_close(check.bounds.center, torch.zeros(3), atol=0.05, rtol=0)
    assert near(tiles_of(check_picture(check, None, tile_width=100), 100, 80)[0], WHITE).any()
