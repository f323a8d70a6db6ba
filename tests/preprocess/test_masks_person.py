"""Masks of people by the shipped networks, on the studio's people."""

import contextlib
import io
import json
import math
import shutil
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from viewmend.cli import main
from viewmend.data.capture_folder import open_capture
from viewmend.data.images import write_image
from viewmend.data.native_writer import write_capture
from viewmend.data.source import CaptureSubset, CaptureWrapper
from viewmend.preprocess.masks import person
from viewmend.preprocess.masks.consensus import settle_masks
from viewmend.preprocess.masks.masked import MaskedCapture, view_rgb
from viewmend.preprocess.masks.person import PersonMasks, Roi, mask_near
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


@pytest.fixture
def blind(studio, monkeypatch):
    """The detector finds no one in the second camera."""
    image = view_rgb(studio.read(0), 1)
    detect = person._detect
    monkeypatch.setattr(
        person, "_detect", lambda rgb, *rest: [] if np.array_equal(rgb, image) else detect(rgb, *rest)
    )


def test_a_person_whom_one_cameras_detector_misses_is_segmented_where_the_others_see_one(studio, blind):
    frame = studio.read(0)
    source = CaptureSubset(studio, range(1))
    makers = {name: PersonMasks() for name in frame.cameras.names}
    assert not MaskedCapture(source, makers, "none").read(0).mask[1].any(), "the detector misses the person"
    masked = MaskedCapture(source, {name: PersonMasks() for name in makers}, "parts", mask_near=mask_near)
    made = masked.read(0)
    assert made.cameras.names == frame.cameras.names
    assert min(iou(own, truth) for own, truth in zip(made.mask, frame.mask, strict=True)) > 0.93
    assert list(masked.notes.remade) == [frame.cameras.names[1]] and not masked.notes.without


def test_a_mask_of_another_thing_than_the_others_see_is_made_again(studio):
    """A whole mask elsewhere, and one of the upper half only."""
    frame = studio.read(0)
    elsewhere = torch.zeros_like(frame.mask[2])
    elsewhere[60:200, 5:40] = 255
    rows = frame.mask[2].any(1).nonzero()[:, 0]
    half = frame.mask[2].clone()
    half[int(rows.float().mean()) :] = 0
    for wrong in (elsewhere, half):
        masks = frame.mask.clone()
        masks[2] = wrong
        makers = {name: _Painted(masks[view].numpy()) for view, name in enumerate(frame.cameras.names)}
        masked = MaskedCapture(CaptureSubset(studio, range(1)), makers, "parts", mask_near=mask_near)
        made = masked.read(0)
        assert list(masked.notes.remade) == [frame.cameras.names[2]]
        assert iou(made.mask[2], frame.mask[2]) > 0.93
        assert torch.equal(made.mask[[0, 1, 3]], frame.mask[[0, 1, 3]])


def test_an_empty_mask_is_right_where_the_subject_is_out_of_view(studio):
    frame = studio.read(0)
    turned = frame.cameras.camera_from_world.clone()
    turned[3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ turned[3]  # looks the other way
    cameras = replace(frame.cameras, camera_from_world=turned)
    masks = frame.mask.clone()
    masks[3] = 0
    images = [view_rgb(frame, view) for view in range(4)]
    settled = settle_masks(masks, images, cameras, None, mask_near)
    assert not settled.without and not settled.remade and not settled.mask[3].any()


def test_a_person_whom_one_camera_finds_is_not_denied_by_the_others(studio):
    frame = studio.read(0)
    masks = frame.mask.clone()
    masks[1:] = 0
    images = [view_rgb(frame, view) for view in range(4)]
    settled = settle_masks(masks, images, frame.cameras, None, mask_near)
    assert set(settled.without) == set(frame.cameras.names[1:]) and torch.equal(settled.mask, masks)
    empty_stage = settle_masks(torch.zeros_like(masks), images, frame.cameras, None, mask_near)
    assert not empty_stage.without, "no camera is left out where none sees a person"


def test_no_person_is_found_in_an_image_of_one_pixel_in_width():
    assert not PersonMasks().mask(np.zeros((64, 1, 3), np.uint8)).any()


@dataclass(frozen=True)
class _Unmasked(CaptureWrapper):
    """The studio without masks, one of whose cameras shows an empty stage."""

    source: Studio

    def read(self, time):
        frame = self.source.read(time)
        rgb = frame.rgb.clone()
        rgb[1] = 90
        return replace(frame, rgb=rgb, mask=None)


@pytest.fixture(scope="module")
def half_blind(tmp_path_factory):
    """A capture without masks, in which one of six cameras does not show the person."""
    studio = Studio(replace(ALONE, cameras=6, frames=1))
    folder = tmp_path_factory.mktemp("half_blind") / "take"
    write_capture(_Unmasked(studio), folder, images="png")
    return folder


@pytest.fixture(scope="module")
def half_masked(half_blind, tmp_path_factory):
    """The folder that `masks` made of it, and the lines that it said."""
    out = tmp_path_factory.mktemp("half_masked") / "masked"
    with contextlib.redirect_stderr(io.StringIO()) as said:
        assert main(["masks", str(half_blind), str(out)]) == 0
    return out, said.getvalue().splitlines()


def test_a_camera_without_a_person_is_named_has_no_mask_and_is_not_used(half_masked, capsys):
    out, said = half_masked
    assert [line for line in said if "cam01" in line] == [
        "'cam01': nothing found where the other cameras see the subject; written without a mask, and not used"
    ]
    assert any("masks of 5 cameras, 1 frame;" in line for line in said)
    assert (out / "image/cam01").is_dir() and not (out / "mask/cam01").exists()
    assert main(["check", str(out)]) == 0
    printed = capsys.readouterr().out
    assert (
        printed.count("cam01") == 1
        and "camera 'cam01' is not used: expected masks, which the other cameras have" in printed
    )
    assert "hull IoU  mean 0.9" in printed
    assert "a capture with 5 cameras" in printed
    assert main(["check", str(out), "--json"]) == 0
    described = json.loads(capsys.readouterr().out)
    assert described["unused"] == ["cam01"] and described["hull_iou_min"] > 0.85
    assert open_capture(out, masks="none").cameras.names == tuple(f"cam{n:02d}" for n in range(6))


def test_check_judges_by_the_good_cameras_if_one_mask_is_empty(half_masked, tmp_path, capsys):
    """As captures are whose masks another program made."""
    out = shutil.copytree(half_masked[0], tmp_path / "masked")
    description = json.loads((out / "cameras.json").read_text())
    description["cameras"][1]["mask"] = description["cameras"][0]["mask"].replace("cam00", "cam01")
    (out / "cameras.json").write_text(json.dumps(description))
    (out / "mask/cam01").mkdir()
    write_image(
        out / "mask/cam01" / next((out / "mask/cam00").iterdir()).name, np.zeros((256, 256), np.uint8)
    )
    assert main(["check", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "hull IoU  mean 0.9" in printed
    (row,) = [line for line in printed.splitlines() if line.strip().startswith("cam01")]
    assert row.endswith("left out")
    assert printed.count("camera 'cam01': its mask is empty") == 1
