"""Calibrations of others whose every image is a camera, there and back; Middlebury's dino as it came."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference.foreign_images import write_agisoft, write_middlebury
from reference.random_rigs import COUNTS, RIGS, SEEDS, assert_same, opencv, random_rig, write_images

from viewmend.capture.errors import CaptureError
from viewmend.capture.formats.recognition import read_any_calibration
from viewmend.capture.plain import open_capture


@RIGS
@given(SEEDS, COUNTS)
def test_middlebury_there_and_back(seed, count):
    with tempfile.TemporaryDirectory() as name:
        folder, rig = Path(name), random_rig(seed, count, 0)
        write_images(folder, rig)
        write_middlebury(folder / "ball_par.txt", opencv(rig))
        assert_same(read_any_calibration(folder), rig)


@RIGS
@given(SEEDS, COUNTS, st.booleans(), st.sampled_from([None, 1, 2]))
def test_agisoft_there_and_back(seed, count, old, moved):
    with tempfile.TemporaryDirectory() as name:
        folder, rig = Path(name), random_rig(seed, count)
        for camera in rig:
            camera["K"][0, 1] = 0.4
        write_images(folder, rig)
        write_agisoft(folder / "cameras.xml", rig, old, moved)
        assert_same(read_any_calibration(folder), rig)


def test_images_and_masks_of_agisoft_and_middlebury_are_found(tmp_path):
    for writer in (
        lambda rig: write_agisoft(tmp_path / "doc.xml", rig),
        lambda rig: write_middlebury(tmp_path / "a_par.txt", rig),
    ):
        rig = [camera | {"dist": np.zeros(5)} for camera in random_rig(3, 3)]
        write_images(tmp_path, rig)
        writer(rig)
        capture = open_capture(tmp_path)
        frame = capture.read(0)
        assert frame.mask is not None and int(frame.rgb[0, 0, 0, 0]) == 90 and len(frame.cameras) == 3
        (tmp_path / "doc.xml").unlink(missing_ok=True)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="frame"', 'type="fisheye"', "expected a calibrated frame lens"),
        ("<k1>", "<k4>0.1</k4><k1>", "expected a calibrated frame lens"),
        ("<transform>1", "<transform>x", "expected 16 numbers|expected a number"),
        ("<cameras>", "<cameras/><others>", "expected XML"),
        ("sensor_id", "lens", "expected a calibrated frame lens"),
    ],
)
def test_wrong_agisoft_is_refused(tmp_path, old, new, message):
    rig = [camera | {"R": np.eye(3)} for camera in random_rig(3, 2)]
    write_images(tmp_path, rig)
    write_agisoft(tmp_path / "doc.xml", rig)
    text = (tmp_path / "doc.xml").read_text()
    assert old in text
    (tmp_path / "doc.xml").write_text(text.replace(old, new))
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


def test_a_short_line_of_middlebury_is_refused(tmp_path):
    rig = random_rig(3, 2)
    write_images(tmp_path, rig)
    write_middlebury(tmp_path / "a_par.txt", rig)
    text = (tmp_path / "a_par.txt").read_text()
    for wrong, got in ((text.rpartition(" ")[0], "got 20 after 'cam"), (text.replace("2\n", "3\n", 1), "got 2 lines")):
        (tmp_path / "a_par.txt").write_text(wrong)
        with pytest.raises(CaptureError, match=got):
            open_capture(tmp_path)


def test_dino_as_it_came(shared, tmp_path):
    """Middlebury's own file gives what the capture's `cameras.json` says."""
    source = shared / "captures/dino"
    (tmp_path / "dinoSR_par.txt").symlink_to(source / "original/dinoSR_par.txt")
    (tmp_path / "images").symlink_to(source / "images")
    (tmp_path / "masks").symlink_to(source / "masks_derived")
    plain, read = open_capture(source), open_capture(tmp_path)
    torch.testing.assert_close(read.cameras.K, plain.cameras.K)
    torch.testing.assert_close(read.cameras.camera_from_world, plain.cameras.camera_from_world, rtol=0, atol=1e-6)
    assert read.cameras.names == plain.cameras.names
    for stream in ("rgb", "mask"):
        assert torch.equal(getattr(read.read(0), stream), getattr(plain.read(0), stream))
