"""Loose masks are measured by colour and tightened; exact masks stay as they are."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from viewmend.cli import main
from viewmend.data.loose_masks import LooseMasks, find_loose_masks, rim_width_px, tightened
from viewmend.data.native_writer import write_capture
from viewmend.data.prepare import prepare
from viewmend.data.source import CaptureWrapper
from viewmend.studio.stage import Studio, StudioConfig


@pytest.fixture(scope="module")
def studio():
    return Studio(StudioConfig(seed=10003, cameras=4, frames=1, size_px=256, background="stage"))


class Grown(CaptureWrapper):
    """A studio whose masks are too wide by some pixels, except those of its last camera."""

    def __init__(self, source, grown_px):
        self.source = source
        self.grown_px = grown_px

    def read(self, time):
        frame = self.source.read(time)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * self.grown_px + 1,) * 2)
        masks = [torch.from_numpy(cv2.dilate(mask.numpy(), disc)) for mask in frame.mask[:-1]]
        return replace(frame, mask=torch.stack([*masks, frame.mask[-1]]))


def rims(frame):
    return [
        rim_width_px(rgb.permute(1, 2, 0).contiguous().numpy(), mask.numpy())
        for rgb, mask in zip(frame.rgb, frame.mask, strict=True)
    ]


def iou(masks, exact):
    return float(torch.minimum(masks, exact).sum() / torch.maximum(masks, exact).sum())


@pytest.mark.parametrize("grown_px", [0, 2, 4])
def test_the_rim_of_a_mask_is_measured(studio, grown_px):
    *grown, exact = rims(Grown(studio, grown_px).read(0))
    assert grown == pytest.approx([grown_px] * 3, abs=0.5)
    assert exact == pytest.approx(0, abs=0.3)


def test_grown_masks_are_tightened_and_others_left(studio):
    exact = studio.read(0)
    loose = Grown(studio, 3).read(0)
    found = find_loose_masks(loose)
    tight = found.apply(loose)
    assert found.names == studio.cameras.names[:-1]
    assert torch.equal(tight.mask[-1], exact.mask[-1])
    before = iou(loose.mask[:-1].float(), exact.mask[:-1].float())
    after = iou(tight.mask[:-1].float(), exact.mask[:-1].float())
    assert before < 0.83 and after > 0.93
    assert find_loose_masks(exact) is None


def test_without_contrast_or_a_subject_nothing_is_measured():
    mask = np.zeros((200, 200), np.uint8)
    grey = np.full((200, 200, 3), 90, np.uint8)
    assert rim_width_px(grey, mask) is None
    mask[40:160, 40:160] = 255
    assert rim_width_px(grey, mask) is None
    assert rim_width_px(grey, np.full_like(mask, 255)) is None


def test_a_rim_has_a_width_in_fractions_of_pixels():
    mask = np.zeros((20, 20), np.uint8)
    mask[4:16, 4:16] = 255
    row = tightened(mask, 1.25)[10]
    assert row.tolist() == [0] * 5 + [191] + [255] * 8 + [191] + [0] * 5
    assert np.array_equal(tightened(0 * mask, 2.0), 0 * mask)


def test_widths_follow_the_size_of_images():
    frame = Studio(StudioConfig(seed=10003, cameras=4, frames=1, size_px=64)).read(0)
    name = frame.cameras.names[0]
    tight = LooseMasks((name,), (1 / 64,), (4.0,)).apply(frame)
    assert torch.equal(tight.mask[1:], frame.mask[1:])
    assert np.array_equal(tight.mask[0].numpy(), tightened(frame.mask[0].numpy(), 1.0))


def test_preparation_tightens_the_masks_of_inputs_alone(studio):
    capture = Grown(studio, 3)
    inputs = capture.cameras.names[1:]
    raw = capture.read(0)
    prepared = prepare(capture, inputs, align=False)
    frame = prepared.read(0)
    assert prepared.loose_masks.names == inputs[:-1]
    assert torch.equal(frame.mask[0], raw.mask[0]), "the camera that is left out"
    assert int(frame.mask[1].sum()) < int(raw.mask[1].sum())
    assert torch.equal(frame.rgb, raw.rgb)
    kept = prepare(capture, inputs, align=False, tighten_masks=False)
    assert torch.equal(kept.read(0).mask, raw.mask)


def test_mend_says_that_masks_are_tightened(studio, tmp_path, capsys):
    write_capture(Grown(studio, 3), tmp_path / "take", images="png")
    arguments = ["mend", str(tmp_path / "take"), "--model", "telea", "--leave-out", studio.cameras.names[0]]
    assert main([*arguments, "--out", str(tmp_path / "tight")]) == 0
    assert "masks of 2 cameras extend" in capsys.readouterr().err
    assert main([*arguments, "--no-tighten-masks", "--out", str(tmp_path / "loose")]) == 0
    assert "pixels beyond the subject" not in capsys.readouterr().err
