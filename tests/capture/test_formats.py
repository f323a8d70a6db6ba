"""Calibrations of others are read as they were written: random rigs, there and back."""

import json
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference.foreign_formats import write_colmap, write_easymocap, write_transforms
from reference.random_rigs import COUNTS, RIGS, SEEDS, assert_same, random_rig, write_images

from viewmend.capture.errors import CaptureError
from viewmend.capture.formats.recognition import read_any_calibration
from viewmend.capture.plain import open_capture
from viewmend.cli import main
from viewmend.leave_one_out.capture_scenes import capture_set


@RIGS
@given(SEEDS, COUNTS)
def test_transforms_there_and_back(seed, count):
    with tempfile.TemporaryDirectory() as folder:
        rig = random_rig(seed, count)
        write_transforms(Path(folder), rig)
        assert_same(read_any_calibration(Path(folder)), rig)


def test_a_lens_at_the_top_level_is_every_frames(tmp_path):
    rig = random_rig(3, 3)
    write_transforms(tmp_path, rig, shared=True)
    for camera in rig:
        camera |= {key: rig[0][key] for key in ("K", "dist", "width", "height")}
    assert_same(read_any_calibration(tmp_path), rig)


@RIGS
@given(
    SEEDS, COUNTS, st.sampled_from([("PINHOLE", 0), ("OPENCV", 4), ("FULL_OPENCV", 5), ("RADIAL", 2)]), st.booleans()
)
def test_colmap_there_and_back(seed, count, model, binary):
    with tempfile.TemporaryDirectory() as folder:
        rig = random_rig(seed, count, model[1])
        for camera in rig if model[0] == "RADIAL" else ():
            camera["K"][1, 1] = camera["K"][0, 0]
        write_colmap(Path(folder), rig, model[0], binary)
        (Path(folder) / "images").mkdir()
        assert_same(read_any_calibration(Path(folder)), rig)


@RIGS
@given(SEEDS, COUNTS, st.booleans())
def test_easymocap_there_and_back(seed, count, rodrigues):
    with tempfile.TemporaryDirectory() as folder:
        rig = random_rig(seed, count)
        write_images(Path(folder), rig, "000003")
        for camera in rig:
            camera["K"][:2, 2] -= 0.5  # OpenCV's first pixel has its centre at 0
        write_easymocap(Path(folder), rig, rodrigues)
        for camera in rig:
            camera["K"][:2, 2] += 0.5
        assert_same(read_any_calibration(Path(folder)), rig)


def test_easymocap_frames_are_counted_and_gaps_are_gaps(tmp_path):
    rig = random_rig(1, 3)
    write_images(tmp_path, rig, "9")
    write_images(tmp_path, rig[1:], "10")
    write_easymocap(tmp_path, rig)
    capture = open_capture(tmp_path)
    assert capture.frame_ids == ("9", "10") and capture.gaps == ((rig[0]["name"], "10"),)
    assert capture.has_masks and len(capture.read(1).cameras) == 2


def test_cameras_of_others_are_left_out_in_turn(tmp_path):
    rig = random_rig(1, 4)
    write_images(tmp_path, rig, "0")
    write_easymocap(tmp_path, rig)
    scenes = capture_set(tmp_path)
    assert [scene.held for scene in scenes] == [camera["name"] for camera in rig]
    before = scenes[0].fingerprint
    write_easymocap(tmp_path, [camera | {"t": camera["t"] + 1} for camera in rig])
    assert capture_set(tmp_path)[0].fingerprint != before  # though only the second file changed


def test_blenders_file_has_angle_alpha_and_no_suffix(tmp_path):
    """The focal length is 0.5 W / tan(angle / 2), centre at W / 2, alpha is the mask."""
    image = np.zeros((20, 30, 4), np.uint8)
    image[5:9, 6:12] = 255
    frames = []
    for name, z in (("a", 4.0), ("b", 5.0)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
        matrix = np.eye(4)
        matrix[2, 3] = z
        frames.append({"file_path": f"./{name}", "transform_matrix": matrix.tolist()})
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    capture = open_capture(tmp_path)
    assert capture.cameras.K[0, 0, 0].item() == pytest.approx(15 / np.tan(0.4))
    assert capture.cameras.K[0, :2, 2].tolist() == [15.0, 10.0]
    assert capture.cameras.centers[1].tolist() == pytest.approx([0, 0, 5])
    mask = capture.read(0).mask
    assert mask is not None and int((mask > 0).sum()) == 48


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "got OPENCV_FISHEYE; undistort"),
        ({"k4": 0.1}, "got k4 or a fisheye"),
        ({"file_path": "../../etc/passwd"}, "a path inside the capture folder"),
        ({"transform_matrix": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}, "R: expected a rotation"),
    ],
)
def test_wrong_transforms_are_refused(tmp_path, change, message):
    write_transforms(tmp_path, random_rig(0, 2))
    file = tmp_path / "transforms.json"
    told = json.loads(file.read_text())
    told["frames"][1] |= change
    file.write_text(json.dumps(told))
    with pytest.raises(CaptureError, match=message) as refused:
        open_capture(tmp_path)
    assert str(file) in str(refused.value)


def test_the_kind_is_recognised_or_told(tmp_path):
    rig = random_rig(5, 2, 4)
    write_images(tmp_path, rig)
    write_colmap(tmp_path, rig)
    write_transforms(tmp_path, random_rig(6, 2))
    assert open_capture(tmp_path, kind="colmap").cameras.names == tuple(camera["name"] for camera in rig)
    assert read_any_calibration(tmp_path).file.name == "transforms.json"
    for kind, message in (("easymocap", "got none of its files"), ("fbx", "expected a kind among plain, transforms")):
        with pytest.raises(CaptureError, match=message):
            open_capture(tmp_path, kind=kind)


def test_convert_writes_a_plain_capture_of_the_part(tmp_path, capsys):
    rig = random_rig(2, 3)
    for camera in rig:
        camera |= {"width": 40, "height": 20, "dist": np.zeros(5)}
        camera["K"] = np.array([[50.0, 0, 20], [0, 50, 10], [0, 0, 1]])
    for frame in ("000000", "000001", "000002"):
        write_images(tmp_path / "take", rig, frame)
    write_easymocap(tmp_path / "take", rig)
    keep = [rig[0]["name"], rig[2]["name"]]
    options = ["--frames", "1:", "--scale", "0.5", "--cameras", *keep]
    assert main(["convert", str(tmp_path / "take"), str(tmp_path / "out"), *options]) == 0
    made = open_capture(tmp_path / "out")
    assert made.cameras.names == tuple(keep) and made.frame_ids == ("000001", "000002")
    assert made.cameras.size_px.tolist() == [[20, 10]] * 2
    assert made.cameras.K[0, 0].tolist() == [25.0, 0.0, 10.25] and int(made.read(1).rgb.max()) == 90
    for wrong in (["--frames", "3:"], ["--frames", "x"], ["--scale", "2"]):
        assert main(["convert", str(tmp_path / "take"), str(tmp_path / "more"), *wrong]) == 2
        assert f"expected {wrong[0]}" in capsys.readouterr().err
