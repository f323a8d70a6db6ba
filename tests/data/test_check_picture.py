"""The picture of the calibration check."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from viewmend.data.checks.calibration import HULL_ONLY, MASK_ONLY, check_calibration, draw_check
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.types import MultiViewFrame
from viewmend.utils.contact_sheet import GAP_PX, LABEL_PX

WHITE = (255, 255, 255)


@pytest.fixture
def cube():
    """Two cameras three metres from a cube of 0.8 m, which fills a square of 30 pixels in both."""
    K = torch.tensor([[110.0, 0, 50], [0, 110.0, 40], [0, 0, 1]])
    front = torch.eye(4)
    front[2, 3] = 3
    side = torch.tensor([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 3], [0, 0, 0, 1]])
    cameras = Cameras(
        ("front", "side"), K.expand(2, 3, 3), torch.stack([front, side]), torch.tensor([[100, 80]] * 2)
    )
    mask = torch.zeros(2, 80, 100, dtype=torch.uint8)
    mask[:, 25:55, 35:65] = 255
    return MultiViewFrame(cameras, torch.full((2, 3, 80, 100), 100, dtype=torch.uint8), mask, 0)


def tiles_of(check, up=None):
    sheet, top = draw_check(check, up, tile_width=100), GAP_PX + LABEL_PX
    return [sheet[top : top + 80, left : left + 100].astype(int) for left in (GAP_PX, 100 + 2 * GAP_PX)]


def near(tile, colour):
    return (np.abs(tile - colour) < 60).all(-1)


def test_disagreement_is_scored_and_drawn(cube):
    assert min(check_calibration(cube, None).iou.values()) > 0.9
    cube.mask[1] = cube.mask[1].roll(12, 0)  # as if the second camera were rotated
    check = check_calibration(cube, Bounds(-torch.ones(3), torch.ones(3)))
    assert max(check.iou.values()) < 0.75
    front, side = tiles_of(check)
    assert near(front, MASK_ONLY)[27:33, 38:62].mean() > 0.5  # the top of the front mask is carved away
    assert near(side, MASK_ONLY)[59:65, 38:62].mean() > 0.5  # and the bottom of the side mask
    assert near(front, HULL_ONLY).mean() < 0.02


def test_bounds_and_up_are_drawn_where_they_project(cube):
    front, _ = tiles_of(check_calibration(cube, Bounds(-torch.ones(3) * 0.6, torch.ones(3) * 0.6)))
    left, top = round(50 - 110 * 0.6 / 3.6), round(40 - 110 * 0.6 / 3.6)
    row, column = near(front, WHITE)[top - 1 : top + 2, 40:60], near(front, WHITE)[30:50, left - 1 : left + 2]
    assert row.any(0).all() and column.any(1).all() and not near(front, WHITE)[45:50, 36:48].any()
    check = check_calibration(cube, None)
    with_up, without = (tiles_of(check, up)[0] for up in (torch.tensor([0.0, -1.0, 0.0]), None))
    rows = np.argwhere((with_up != without).any(-1))[:, 0]
    assert len(rows) and rows.max() <= 43  # from the centre of the cube towards smaller y


def test_a_capture_without_masks_is_drawn(cube):
    check = check_calibration(replace(cube, mask=None), None)
    assert (check.iou, check.proxy, check.silhouettes) == ({}, None, None)
    torch.testing.assert_close(check.bounds.center, torch.zeros(3), atol=0.05, rtol=0)
    assert near(tiles_of(check)[0], WHITE).any()
