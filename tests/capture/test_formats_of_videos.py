"""Calibrations that name no files: videos and folders are found by the cameras' names."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference.foreign_rigs import write_opencv, write_qualisys, write_toml
from reference.random_rigs import COUNTS, RIGS, SEEDS, assert_same, opencv, random_rig, write_images, write_videos

from viewmend.capture.errors import CaptureError
from viewmend.capture.formats.footage import Footage, paired
from viewmend.capture.formats.recognition import read_any_calibration
from viewmend.capture.plain import open_capture
from viewmend.capture.videos import video_facts


@RIGS
@given(SEEDS, COUNTS, st.sampled_from(["pose2sim", "aniposelib", "caliscope", "pyxy3d"]))
def test_toml_there_and_back(seed, count, style):
    with tempfile.TemporaryDirectory() as name:
        folder, rig = Path(name), random_rig(seed, count, 4 if style == "pose2sim" else 5)
        file = {"pose2sim": "calibration/Calib_scene.toml", "caliscope": "camera_array.toml", "pyxy3d": "config.toml"}
        write_toml(folder / file.get(style, "calibration/calibration.toml"), opencv(rig), style)
        write_images(folder, rig, "000003")
        numbered = {"caliscope": lambda name: str(int(name[3:])), "pyxy3d": lambda name: f"cam_{int(name[3:])}"}
        for camera in rig:
            camera["name"] = numbered.get(style, str)(camera["name"])
        read = read_any_calibration(folder)
        assert_same(read, rig)
        assert read.frames == ("000003",) and all(c.image and c.mask for c in read.cameras)


@RIGS
@given(SEEDS, COUNTS)
def test_qualisys_there_and_back(seed, count):
    with tempfile.TemporaryDirectory() as name:
        folder, rig = Path(name), random_rig(seed, count)
        write_qualisys(folder / "calibration/Calib.qca.txt", opencv(rig))
        write_images(folder, rig, "000003")
        assert_same(read_any_calibration(folder), rig)


@RIGS
@given(SEEDS, COUNTS, st.sampled_from(["files", "folders"]))
def test_opencvs_own_files_there_and_back(seed, count, style):
    with tempfile.TemporaryDirectory() as name:
        folder, rig = Path(name), random_rig(seed, count)
        write_opencv(folder, opencv(rig), style)
        write_images(folder, rig, "000003")
        assert_same(read_any_calibration(folder), rig)


def big(rig):
    """The rig with images that a video can have."""
    return [camera | {"width": 96 + 16 * n, "height": 64, "dist": np.zeros(5)} for n, camera in enumerate(rig)]


def test_videos_are_read_to_the_end_of_the_shortest(tmp_path):
    rig = big(random_rig(4, 3))
    write_toml(tmp_path / "calibration/Calib.toml", opencv(rig))
    write_videos(tmp_path / "videos", rig[1:], 5)
    write_videos(tmp_path / "videos", rig[:1], 4)
    capture = open_capture(tmp_path)
    assert len(capture.frame_ids) == 4 and capture.fps == 25.0
    assert capture.cameras.size_px.tolist() == [[96, 64], [112, 64], [128, 64]]
    assert abs(float(capture.read(3).rgb[0, 0, 0, 0]) - 120) < 4 and not capture.has_masks


def test_a_video_may_be_cropped_by_an_encoders_block_but_not_scaled(tmp_path):
    rig = big(random_rig(4, 3))
    write_videos(tmp_path / "videos", rig)
    write_toml(tmp_path / "Calib.toml", [camera | {"width": camera["width"] + 8} for camera in opencv(rig)])
    assert open_capture(tmp_path).cameras.size_px[0].tolist() == [96, 64]
    write_toml(tmp_path / "Calib.toml", [camera | {"width": camera["width"] * 2} for camera in opencv(rig)])
    with pytest.raises(CaptureError, match=r"expected images of 192 x 64 pixels, got 96 x 64; export"):
        open_capture(tmp_path)


def test_names_of_cameras_and_footage_are_compared():
    assert paired(["int_cam02_img", "int_cam10_img"], ["cam10.mp4", "cam02.mp4"]) == ["cam02.mp4", "cam10.mp4"]
    assert paired(["1", "10"], ["r/port_10.mp4", "r/port_1.mp4"]) == ["r/port_1.mp4", "r/port_10.mp4"]
    assert paired(["A", "B"], ["v/2019-vid01-camB.avi", "v/2019-vid01-camA.avi"]) == [
        "v/2019-vid01-camA.avi",
        "v/2019-vid01-camB.avi",
    ]
    assert paired(["cam_01", "cam_02"], ["videos/GX01.mp4", "videos/GX02.mp4"]) == [
        "videos/GX01.mp4",
        "videos/GX02.mp4",
    ]
    assert paired(["cam01_x2", "cam02_x2"], ["cam2.mp4", "cam1.mp4"]) == ["cam1.mp4", "cam2.mp4"]
    assert paired(["cam_01", "cam_02"], ["left.mp4", "right.mp4"]) is None
    assert paired(["a1", "b1"], ["x1.mp4", "y1.mp4"]) is None  # nothing tells them apart


def test_what_cannot_be_right_is_refused(tmp_path):
    rig = big(random_rig(4, 3))
    write_toml(tmp_path / "Calib.toml", opencv(rig))
    with pytest.raises(CaptureError, match="expected a video or a folder of images named after each camera"):
        open_capture(tmp_path)
    write_videos(tmp_path, rig)
    text = (tmp_path / "Calib.toml").read_text()
    for wrong, message in (
        (text.replace("fisheye = false", "fisheye = true", 1), "expected no fisheye lens"),
        (text.replace("rotation", "turn", 1), "expected a rotation of 3 or 9 numbers, got 0"),
        (text.replace("size", "extent", 1), r"expected size = \[width, height\]"),
        (text.replace("matrix = [", "matrix = ", 1), "expected TOML, got something else"),
    ):
        (tmp_path / "Calib.toml").write_text(wrong)
        with pytest.raises(CaptureError, match=message):
            open_capture(tmp_path)


def test_xml_that_grows_is_refused(tmp_path):
    (tmp_path / "a.qca.txt").write_text('<!DOCTYPE a [<!ENTITY b "bbbb">]><calibration>&b;</calibration>')
    with pytest.raises(CaptureError, match="expected XML without a document type"):
        open_capture(tmp_path)


def test_pose2sims_own_files(shared):
    """The calibration that came with the videos gives what the capture's `cameras.json` says."""
    plain = open_capture(shared / "captures/pose2sim")
    read = open_capture(shared / "captures/pose2sim/original")
    assert read.cameras.names == plain.cameras.names and len(read.frame_ids) == 100 and read.fps == 60
    assert torch.equal(read.cameras.size_px, plain.cameras.size_px)  # of two videos narrower than calibrated
    torch.testing.assert_close(read.cameras.K, plain.cameras.K, rtol=0, atol=1e-4)
    torch.testing.assert_close(read.cameras.camera_from_world, plain.cameras.camera_from_world, rtol=0, atol=1e-6)
    assert torch.equal(read.read(3).rgb, plain.read(3).rgb)


def test_utrecht_as_it_came(shared):
    """OpenCV's files beside each camera's video give what `cameras.json` says, but for the unit."""
    plain = open_capture(shared / "captures/utrecht")
    read = open_capture(shared / "captures/utrecht/original")
    assert read.cameras.names == plain.cameras.names and read.frame_ids[-1] == "000425" and read.fps == 50
    torch.testing.assert_close(read.cameras.K, plain.cameras.K)
    torch.testing.assert_close(read.cameras.centers / 1000, plain.cameras.centers)
    assert torch.equal(read.read(2).rgb, plain.read(2).rgb)  # undistorted alike, and not the empty room


def test_a_container_may_claim_too_much(shared):
    """Utrecht's claim 428 frames, of which 426 can be decoded."""
    assert video_facts(shared / "captures/utrecht/original/cam1/video.avi").frames == 426


def test_a_side_of_hundreds_of_digits_is_said_in_few():
    footage = Footage(("1",), None, {"left": {"width": 32, "height": 24}})
    with pytest.raises(ValueError, match=r"'left': expected images of 1e\+09 x -1e\+09 pixels, got 32 x 24; export"):
        footage.of("left", (10**400, -(10**400)))
