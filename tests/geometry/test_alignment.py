"""A shift that all images share is found from the masks, and nothing is found where there is none."""

from dataclasses import replace

import pytest
import torch

from viewmend.geometry.alignment import WORTH_MOVING, shared_offset
from viewmend.geometry.hull import HullConfig
from viewmend.studio.stage import Studio, StudioConfig

HULL = HullConfig(resolution=96)


@pytest.fixture(scope="module")
def frame():
    return Studio(StudioConfig(seed=4, cameras=8, frames=1, size_px=256)).read(0)


def test_an_exact_calibration_stays_as_it_is(frame):
    found = shared_offset(frame.mask, frame.cameras, None, HULL)
    assert found.offset_px == (0.0, 0.0) and found.iou_after == found.iou_before > 0.95


@pytest.mark.parametrize("shift", [0.7, -0.5])
def test_a_wrong_convention_is_undone(frame, shift):
    found = shared_offset(frame.mask, frame.cameras.moved(shift, 0.0), None, HULL)
    assert found.offset_px[0] == pytest.approx(-shift, abs=0.15)
    assert found.iou_after > found.iou_before + WORTH_MOVING


@pytest.mark.parametrize("shift", [(0.7, -0.6), (0.0, 0.7)])
def test_where_cameras_are_mounted_on_their_side_both_axes_are_found(frame, shift):
    """Every other camera is turned by a quarter, as for a standing person; across, an upright one tells the shift."""
    mask, pose = frame.mask.clone(), frame.cameras.camera_from_world.clone()
    quarter = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    for view in range(0, len(mask), 2):
        mask[view] = frame.mask[view].rot90()
        pose[view, :3] = quarter @ pose[view, :3]
    cameras = replace(frame.cameras, camera_from_world=pose)
    assert shared_offset(mask, cameras, None, HULL).iou_before > 0.95, "the same subject"
    found = shared_offset(mask, cameras.moved(*shift), None, HULL)
    assert found.offset_px == pytest.approx((-shift[0], -shift[1]), abs=0.2)
    assert found.iou_after > 0.95 and found.iou_after > found.iou_before + WORTH_MOVING


def test_one_empty_mask_asks_for_no_shift(frame):
    spoiled = frame.mask.clone()
    spoiled[3] = 0
    found = shared_offset(spoiled, frame.cameras, None, HULL)
    assert found.offset_px == (0.0, 0.0) and found.iou_after < 0.8


def test_masks_that_agree_on_nothing_ask_for_no_shift(frame):
    scattered = torch.zeros_like(frame.mask)
    for view in range(len(scattered)):
        scattered[view, 10 * view : 10 * view + 4, 5:9] = 255
    assert shared_offset(scattered, frame.cameras, None, HULL).offset_px == (0.0, 0.0)
