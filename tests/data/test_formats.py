"""Calibration formats of other tools: random rigs round-trip, real files read alike, invalid files are rejected."""

import json
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference.foreign_formats import write_colmap, write_easymocap, write_transforms
from reference.foreign_images import write_agisoft, write_middlebury
from reference.foreign_rigs import write_opencv, write_qualisys, write_toml
from reference.random_rigs import (
    COUNTS,
    RIGS,
    SEEDS,
    TAKES,
    assert_same,
    opencv,
    random_rig,
    write_images,
    write_videos,
)

from viewmend.cli import main
from viewmend.data.capture_folder import open_capture
from viewmend.data.errors import CaptureError
from viewmend.data.formats import read_any_calibration
from viewmend.data.formats.files import Footage, match_names
from viewmend.data.formats.opencv import MAX_BYTES, read_storage
from viewmend.data.videos import video_properties
from viewmend.scenes.capture_scenes import capture_set

# Round trips. A writer takes the folder and the rig, in OpenCV's convention if the format has it.

TOML_FILES = {
    "pose2sim": "calibration/Calib_scene.toml",
    "caliscope": "camera_array.toml",
    "pyxy3d": "config.toml",
}
NUMBERED = {"caliscope": lambda name: str(int(name[3:])), "pyxy3d": lambda name: f"cam_{int(name[3:])}"}


def toml(style):
    def write(folder, rig):
        write_toml(folder / TOML_FILES.get(style, "calibration/calibration.toml"), opencv(rig), style)
        for camera in rig:
            camera["name"] = NUMBERED.get(style, str)(camera["name"])

    return write


def colmap(model, binary):
    def write(folder, rig):
        for camera in rig if model == "RADIAL" else ():
            camera["K"][1, 1] = camera["K"][0, 0]
        write_colmap(folder, rig, model, binary)
        (folder / "images").mkdir(exist_ok=True)

    return write


def agisoft(old, moved):
    def write(folder, rig):
        for camera in rig:
            camera["K"][0, 1] = 0.4
        write_agisoft(folder / "cameras.xml", rig, old, moved)

    return write


FORMATS = {
    "transforms": (write_transforms, 5),
    **{
        f"colmap {m} {b}": (colmap(m, b), n)
        for b in (False, True)
        for m, n in (("PINHOLE", 0), ("OPENCV", 4))
    },
    "colmap FULL_OPENCV": (colmap("FULL_OPENCV", True), 5),
    "colmap RADIAL": (colmap("RADIAL", False), 2),
    "middlebury": (lambda folder, rig: write_middlebury(folder / "ball_par.txt", opencv(rig)), 0),
    **{f"agisoft {o} {m}": (agisoft(o, m), 5) for o in (False, True) for m in (None, 1, 2)},
    **{
        f"easymocap {r}": (lambda folder, rig, r=r: write_easymocap(folder, opencv(rig), r), 5)
        for r in (False, True)
    },
    **{style: (toml(style), 4 if style == "pose2sim" else 5) for style in (*TOML_FILES, "aniposelib")},
    "qualisys": (lambda folder, rig: write_qualisys(folder / "calibration/Calib.qca.txt", opencv(rig)), 5),
    **{
        f"opencv {s}": (lambda folder, rig, s=s: write_opencv(folder, opencv(rig), s), 5)
        for s in ("files", "folders")
    },
}
"""Writers, and the number of distortion coefficients that the format has."""
FRAMES = {"easymocap", *TOML_FILES, "aniposelib", "qualisys", "opencv"}
"""Formats with a folder of images per camera."""


@pytest.mark.parametrize("name", FORMATS)
def test_rigs_round_trip(name):
    write, distorted = FORMATS[name]
    frame = "000003" if name.split()[0] in FRAMES else None

    @TAKES
    @given(SEEDS, COUNTS)
    def check(seed, count):
        with tempfile.TemporaryDirectory() as folder:
            rig = random_rig(seed, count, distorted)
            write_images(Path(folder), rig, frame)
            write(Path(folder), rig)
            read = read_any_calibration(Path(folder))
            assert_same(read, rig)
            assert all(camera.image for camera in read.cameras)
            if frame:
                assert read.frames == (frame,) and all(camera.mask for camera in read.cameras)

    check()


# Details of single formats.


def test_transforms_may_share_a_lens(tmp_path):
    rig = random_rig(3, 3)
    write_transforms(tmp_path, rig, shared=True)
    for camera in rig:
        camera |= {key: rig[0][key] for key in ("K", "dist", "width", "height")}
    assert_same(read_any_calibration(tmp_path), rig)


def test_frames_are_sorted_by_number_and_missing_images_are_gaps(tmp_path):
    rig = random_rig(1, 3)
    write_images(tmp_path, rig, "9")
    write_images(tmp_path, rig[1:], "10")
    write_easymocap(tmp_path, rig)
    capture = open_capture(tmp_path)
    assert capture.frame_ids == ("9", "10") and capture.gaps == ((rig[0]["name"], "10"),)
    assert capture.has_masks and len(capture.read(1).cameras) == 2


def test_scenes_of_other_formats_have_fingerprints(tmp_path):
    rig = random_rig(1, 4)
    write_images(tmp_path, rig, "0")
    write_easymocap(tmp_path, rig)
    scenes = capture_set(tmp_path)
    assert [scene.held for scene in scenes] == [camera["name"] for camera in rig]
    before = scenes[0].fingerprint
    write_easymocap(tmp_path, [camera | {"t": camera["t"] + 1} for camera in rig])
    moved = capture_set(tmp_path)[0].fingerprint
    assert moved != before  # only the second file changed
    extrinsics = tmp_path / "extri.yml"
    numbers = "!!opencv-matrix\n   rows: 2\n   cols: 3\n   dt: d\n   data: [ -1., -1., -1., 1., 1., 1. ]\n"
    extrinsics.write_text(f"{extrinsics.read_text()}bounds_{rig[0]['name']}: {numbers}")
    assert capture_set(tmp_path)[0].fingerprint != moved


def test_formats_are_recognised_or_selected(tmp_path):
    rig = random_rig(5, 2, 4)
    write_images(tmp_path, rig)
    write_colmap(tmp_path, rig)
    write_transforms(tmp_path, random_rig(6, 2))
    assert open_capture(tmp_path, format="colmap").cameras.names == tuple(camera["name"] for camera in rig)
    assert read_any_calibration(tmp_path).file.name == "transforms.json"
    for name, message in (
        ("easymocap", "got none of its files"),
        ("fbx", "expected a format among plain, transforms"),
    ):
        with pytest.raises(CaptureError, match=message):
            open_capture(tmp_path, format=name)


def test_convert_writes_the_selected_part(tmp_path, capsys):
    rig = random_rig(2, 3)
    for camera in rig:
        camera |= {"width": 40, "height": 20, "dist": np.zeros(5)}
        camera["K"] = np.array([[50.0, 0, 20], [0, 50, 10], [0, 0, 1]])
    for frame in ("000000", "000001", "000002"):
        write_images(tmp_path / "take", rig, frame)
    write_easymocap(tmp_path / "take", rig)
    keep = [rig[0]["name"], rig[2]["name"]]
    options = ["--frames", "1:", "--scale", "0.5", "--cameras", *keep, "--format", "easymocap"]
    assert main(["convert", str(tmp_path / "take"), str(tmp_path / "out"), *options]) == 0
    made = open_capture(tmp_path / "out")
    assert made.cameras.names == tuple(keep) and made.frame_ids == ("000001", "000002")
    assert made.cameras.size_px.tolist() == [[20, 10]] * 2
    assert made.cameras.K[0, 0].tolist() == [25.0, 0.0, 10.25] and int(made.read(1).rgb.max()) == 90
    for wrong in (["--frames", "3:"], ["--frames", "x"], ["--scale", "2"]):
        assert main(["convert", str(tmp_path / "take"), str(tmp_path / "more"), *wrong]) == 2
        assert f"expected {wrong[0]}" in capsys.readouterr().err


# Footage that is found by the cameras' names.


def large(rig):
    """The rig with image sizes that a video can have."""
    return [
        camera | {"width": 96 + 16 * n, "height": 64, "dist": np.zeros(5)} for n, camera in enumerate(rig)
    ]


def test_videos_end_with_the_shortest(tmp_path):
    rig = large(random_rig(4, 3))
    write_toml(tmp_path / "calibration/Calib.toml", opencv(rig))
    write_videos(tmp_path / "videos", rig[1:], 5)
    write_videos(tmp_path / "videos", rig[:1], 4)
    capture = open_capture(tmp_path)
    assert len(capture.frame_ids) == 4 and capture.fps == 25.0
    assert capture.cameras.size_px.tolist() == [[96, 64], [112, 64], [128, 64]]
    assert abs(float(capture.read(3).rgb[0, 0, 0, 0]) - 120) < 4 and not capture.has_masks


def test_videos_may_be_cropped_but_not_scaled(tmp_path):
    rig = large(random_rig(4, 3))
    write_videos(tmp_path / "videos", rig)
    write_toml(tmp_path / "Calib.toml", [camera | {"width": camera["width"] + 8} for camera in opencv(rig)])
    assert open_capture(tmp_path).cameras.size_px[0].tolist() == [96, 64]
    write_toml(tmp_path / "Calib.toml", [camera | {"width": camera["width"] * 2} for camera in opencv(rig)])
    with pytest.raises(CaptureError, match=r"expected images of 192 x 64 pixels, got 96 x 64; export"):
        open_capture(tmp_path)
    footage = Footage(("1",), None, {"left": {"width": 32, "height": 24}})
    with pytest.raises(ValueError, match=r"expected images of 1e\+09 x -1e\+09 pixels"):
        footage.entry("left", (10**400, -(10**400)))


@pytest.mark.parametrize(
    ("names", "paths"),
    [
        (["int_cam02_img", "int_cam10_img"], ["cam02.mp4", "cam10.mp4"]),
        (["1", "10"], ["r/port_1.mp4", "r/port_10.mp4"]),
        (["A", "B"], ["v/2019-vid01-camA.avi", "v/2019-vid01-camB.avi"]),
        (["cam_01", "cam_02"], ["videos/GX01.mp4", "videos/GX02.mp4"]),
        (["cam01_x2", "cam02_x2"], ["cam1.mp4", "cam2.mp4"]),
        (["K\u00fcche", "Flur"], ["videos/Ku\u0308che.mp4", "videos/Flur.mp4"]),
    ],
)
def test_names_are_matched(names, paths):
    assert match_names(names, reversed(paths)) == paths


@pytest.mark.parametrize(
    ("names", "paths"),
    [(["cam_01", "cam_02"], ["left.mp4", "right.mp4"]), (["a1", "b1"], ["x1.mp4", "y1.mp4"])],
)
def test_ambiguous_names_are_not_matched(names, paths):
    assert match_names(names, paths) is None


# Invalid files.


def change_transforms(**changes):
    def change(text):
        content = json.loads(text)
        content["frames"][1] |= changes
        return json.dumps(content)

    return change


def replacing(old, new, count=1):
    def change(text):
        assert old in text
        return text.replace(old, new, count)

    return change


LENS = "expected a calibrated frame lens"
INVALID = [
    ("transforms", change_transforms(camera_model="OPENCV_FISHEYE"), "got OPENCV_FISHEYE; undistort"),
    ("transforms", change_transforms(k4=0.1), "got k4 or a fisheye"),
    ("transforms", change_transforms(file_path="../../etc/passwd"), "a path inside the capture folder"),
    ("transforms", change_transforms(transform_matrix=(2 * np.eye(3, 4)).tolist()), "R: expected a rotation"),
    ("agisoft False None", replacing('type="frame"', 'type="fisheye"', -1), LENS),
    ("agisoft False None", replacing("<k1>", "<k4>0.1</k4><k1>", -1), LENS),
    (
        "agisoft False None",
        replacing("sensor_id", "lens", -1),
        "expected a sensor with a calibration, got none",
    ),
    ("agisoft False None", lambda text: text.replace("<transform>", "<transform>x"), "expected a number"),
    ("agisoft False None", replacing("<cameras>", "<cameras/><others>", -1), "expected XML"),
    ("middlebury", lambda text: text.rpartition(" ")[0], "got 20 after 'cam"),
    ("middlebury", replacing("2\n", "3\n"), "got 2 lines"),
    ("pose2sim", replacing("fisheye = false", "fisheye = true"), "expected a lens without fisheye"),
    ("pose2sim", replacing("rotation", "turn"), "expected a rotation of 3 or 9 numbers, got 0"),
    ("pose2sim", replacing("size", "extent"), r"expected size = \[width, height\]"),
    ("pose2sim", replacing("matrix = [", "matrix = "), "expected TOML, got something else"),
    ("qualisys", lambda text: f"<!DOCTYPE a>{text}", "expected XML without a document type"),
]


@pytest.mark.parametrize(("name", "change", "message"), INVALID)
def test_invalid_files_are_rejected(tmp_path, name, change, message):
    write, distorted = FORMATS[name]
    rig = [camera | {"R": np.eye(3)} for camera in random_rig(3, 2, distorted)]
    write_images(tmp_path, rig, "000003" if name in FRAMES else None)
    write(tmp_path, rig)
    file = read_any_calibration(tmp_path).file
    file.write_text(change(file.read_text()))
    with pytest.raises(CaptureError, match=message) as refused:
        open_capture(tmp_path)
    assert str(file) in str(refused.value)


def test_missing_footage_is_reported(tmp_path):
    write_toml(tmp_path / "Calib.toml", opencv(random_rig(4, 3)))
    with pytest.raises(CaptureError, match="expected a video or a folder of images named after each camera"):
        open_capture(tmp_path)


# Real files.


def test_middlebury_dino(shared, tmp_path):
    source = shared / "captures/dino"
    (tmp_path / "dinoSR_par.txt").symlink_to(source / "original/dinoSR_par.txt")
    (tmp_path / "images").symlink_to(source / "images")
    (tmp_path / "masks").symlink_to(source / "masks_derived")
    plain, read = open_capture(source), open_capture(tmp_path)
    torch.testing.assert_close(read.cameras.K, plain.cameras.K)
    torch.testing.assert_close(
        read.cameras.camera_from_world, plain.cameras.camera_from_world, rtol=0, atol=1e-6
    )
    assert read.cameras.names == plain.cameras.names
    for kind in ("rgb", "mask"):
        assert torch.equal(getattr(read.read(0), kind), getattr(plain.read(0), kind))


def test_pose2sim_demo(shared):
    plain, read = (open_capture(shared / f"captures/pose2sim{place}") for place in ("", "/original"))
    assert read.cameras.names == plain.cameras.names and len(read.frame_ids) == 100 and read.fps == 60
    assert torch.equal(read.cameras.size_px, plain.cameras.size_px)  # two videos are narrower than calibrated
    torch.testing.assert_close(read.cameras.K, plain.cameras.K, rtol=0, atol=1e-4)
    torch.testing.assert_close(
        read.cameras.camera_from_world, plain.cameras.camera_from_world, rtol=0, atol=1e-6
    )
    assert torch.equal(read.read(3).rgb, plain.read(3).rgb)


def test_utrecht_opencv_files(shared):
    plain, read = (open_capture(shared / f"captures/utrecht{place}") for place in ("", "/original"))
    assert read.cameras.names == plain.cameras.names and read.frame_ids[-1] == "000425" and read.fps == 50
    torch.testing.assert_close(read.cameras.K, plain.cameras.K)
    torch.testing.assert_close(read.cameras.centers / 1000, plain.cameras.centers)
    assert torch.equal(read.read(2).rgb, plain.read(2).rgb)  # undistorted alike, and not the empty room
    video = shared / "captures/utrecht/original/cam1/video.avi"
    assert video_properties(video).frames == 426  # the container claims 428


# OpenCV's FileStorage.

VALUES = st.lists(st.floats(width=64, allow_nan=True, allow_infinity=True), min_size=9, max_size=9)


def write_storage(file, matrices, names):
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for key, matrix in matrices.items():
        storage.write(key, matrix)
    storage.startWriteStruct("names", cv2.FileNode_SEQ)
    for name in names:
        storage.write("", name)
    storage.endWriteStruct()
    storage.release()
    return file


@pytest.mark.parametrize("name", ["a.yml", "a.xml", "a.json"])
def test_storage_is_read_as_by_opencv(name, tmp_path):
    @RIGS
    @given(VALUES, st.integers(-(2**31), 2**31 - 1))
    def check(values, number):
        K = np.array(values).reshape(3, 3)
        colours = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
        matrices = {"K_00": K, "row": np.float32([[0.1, -3e38, 1e-40]]), "colours": colours}
        names = ("00", "cam 1", "7")
        file = write_storage(tmp_path / name, matrices | {"n": number, "f": K[0, 0], "t": "a: b"}, names)
        found, storage = read_storage(file), cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        for key in matrices:
            expected = storage.getNode(key).mat().ravel()
            np.testing.assert_array_equal(found[key].astype(expected.dtype), expected, err_msg=key)
        assert found["n"] == number and found["names"] == list(names) and "t" not in found
        np.testing.assert_equal(found["f"], storage.getNode("f").real())

    check()


def test_storage_keeps_leading_zeros_and_does_not_expand_references(tmp_path):
    (tmp_path / "a.yml").write_text("%YAML:1.0\n---\nnames:\n   - 00\n   - 010\n   - 1e3\n")
    assert read_storage(tmp_path / "a.yml")["names"] == ["00", "010", "1e3"]
    lines = ["a0: &a0 [1, 1]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 60))]
    (tmp_path / "a.yml").write_text("\n".join(lines))
    assert read_storage(tmp_path / "a.yml") == {}


MATRIX = "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: {}\n   data: [ {} ]\n"
INVALID_STORAGE = {
    "unclosed brackets": (b"a: " + b"[" * 100_000, "expected OpenCV's YAML or XML in a.yml, got"),
    "unclosed list": (b"a: [1, 2", "expected OpenCV's YAML or XML in a.yml, got: did not find expected"),
    "no keys": (b"- 1\n- 2\n", "got no keys"),
    "list as key": (b"? [1]\n: 2\n", "expected OpenCV's YAML or XML in a.yml, got"),
    "control characters": (b"a: \1\n", "expected OpenCV's YAML or XML in a.yml, got"),
    "binary": (b"\xff\xfe\xfd", "expected a.yml in UTF-8"),
    "entities": (b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "without a document type"),
    "too large": (b" " * (MAX_BYTES + 1), "expected a.yml to have at most"),
    "too few numbers": (MATRIX.format(3, 3, "d", "1, 2").encode(), "K: expected rows x cols numbers, got 2"),
    "too many numbers": (MATRIX.format(1, 1, "d", "1, 2").encode(), "K: expected rows x cols numbers, got 2"),
    "missing channels": (
        MATRIX.format(1, 2, "3u", "1, 2").encode(),
        "K: expected rows x cols numbers, got 2",
    ),
    "words": (MATRIX.format(1, 2, "d", "1, two").encode(), "or invalid ones"),
    "no type": (MATRIX.format(1, 2, "[d]", "1, 2").encode(), "K: expected rows x cols"),
}


@pytest.mark.parametrize("fault", INVALID_STORAGE)
def test_invalid_storage_is_rejected_in_one_line(fault, tmp_path):
    data, message = INVALID_STORAGE[fault]
    (tmp_path / "a.yml").write_bytes(data)
    with pytest.raises(ValueError, match=message) as refused:
        read_storage(tmp_path / "a.yml")
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 200
