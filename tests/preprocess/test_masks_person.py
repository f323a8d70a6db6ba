"""Masks of people by the shipped networks, on the studio's people."""

import math

import numpy as np
import pytest
import torch

from viewmend.data.source import CaptureSubset
from viewmend.preprocess.masks import person
from viewmend.preprocess.masks.masked import MaskedCapture, view_rgb
from viewmend.preprocess.masks.person import PersonMasks, Roi
from viewmend.studio.stage import Studio, StudioConfig

ALONE = StudioConfig(cameras=4, frames=3, size_px=256, background="stage", seed=5)
"""One person and no furniture."""


@pytest.fixture(scope="module")
def studio() -> Studio:
    return Studio(ALONE)


def iou(mask, truth) -> float:
    mask, truth = np.asarray(mask) > 127, np.asarray(truth) > 127
    return float((mask & truth).sum() / (mask | truth).sum())


def test_a_person_is_segmented_and_tracked(studio, monkeypatch):
    detected = []
    monkeypatch.setattr(
        person, "_detect", lambda *given, detect=person._detect: detected.append(1) or detect(*given)
    )
    maker = PersonMasks()
    for time in range(3):
        frame = studio.read(time)
        mask = maker.mask(view_rgb(frame, 0))
        assert iou(mask, frame.mask[0]) > 0.95
        assert int(((mask > 10) & (mask < 245)).sum()) > 0, "the outline is soft"
    assert len(detected) == 1, "the first image alone; then the person is tracked"


def test_a_person_who_lies_or_stands_anywhere_is_found(studio):
    frame = studio.read(0)
    rgb, truth = view_rgb(frame, 1), frame.mask[1].numpy()
    for turns in (1, 3):
        assert (
            iou(PersonMasks().mask(np.ascontiguousarray(np.rot90(rgb, turns))), np.rot90(truth, turns)) > 0.85
        )
    wide = np.zeros((512, 1024, 3), np.uint8)
    wide[200:456, 700:956] = rgb
    expected = np.zeros((512, 1024), np.uint8)
    expected[200:456, 700:956] = truth
    assert iou(PersonMasks().mask(wide), expected) > 0.9


def test_two_people_are_both_segmented(studio):
    frame = studio.read(0)
    rgb = np.concatenate([view_rgb(frame, 0), view_rgb(frame, 2)], 1)
    truth = np.concatenate([frame.mask[0].numpy(), frame.mask[2].numpy()], 1)
    assert iou(PersonMasks().mask(rgb), truth) > 0.9


def test_an_empty_stage_has_an_empty_mask_and_a_person_who_enters_is_found(studio):
    frame, maker = studio.read(0), PersonMasks()
    empty = np.full((256, 256, 3), 90, np.uint8)
    assert not maker.mask(empty).any()
    assert iou(maker.mask(view_rgb(frame, 0)), frame.mask[0]) > 0.95
    assert not maker.mask(empty).any()


def test_a_square_maps_its_corners_around_the_person():
    roi = Roi.around((100.0, 80.0), (100.0, 40.0))
    assert roi.side == pytest.approx(100) and roi.angle == pytest.approx(0)
    corners = np.array([[0, 0, 1], [256, 256, 1]], float) @ roi.image_from_roi().T
    assert np.allclose(corners, [[50, 30], [150, 130]], atol=1e-3)
    lying = Roi.around((100.0, 80.0), (140.0, 80.0))
    assert lying.angle == pytest.approx(math.pi / 2)


class _Painted:
    """A maker that returns given masks."""

    def __init__(self, mask):
        self._mask = mask

    def mask(self, rgb):
        return self._mask


def test_a_bystander_whom_one_camera_sees_is_dropped(studio):
    frame = studio.read(0)
    masks = frame.mask.numpy().copy()
    masks[0, 5:40, 5:25] = 255
    source = CaptureSubset(studio, range(1))
    makers = {name: _Painted(masks[view]) for view, name in enumerate(frame.cameras.names)}
    cleaned = MaskedCapture(source, makers, "parts").read(0).mask
    assert not cleaned[0, 5:40, 5:25].any()
    assert torch.equal(cleaned[1:], torch.from_numpy(masks)[1:])
    assert int((cleaned[0] != frame.mask[0]).sum()) < 20
    assert MaskedCapture(source, makers, "none").read(0).mask[0, 5:40, 5:25].all()
