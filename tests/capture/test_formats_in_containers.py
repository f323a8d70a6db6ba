"""DNA-Rendering's HDF5 files, RIFTCast's run lengths, and images in containers, there and back."""

import json
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.foreign_studios import write_dna, write_riftcast
from reference.random_rigs import COUNTS, SEEDS, TAKES, assert_same, assert_take, named, opencv, random_rig, random_take

from viewmend.capture.containers import names_in, read_bytes
from viewmend.capture.errors import CaptureError
from viewmend.capture.plain import open_capture
from viewmend.capture.run_lengths import read_runs, run_lengths
from viewmend.leave_one_out.capture_scenes import capture_set


@TAKES
@given(SEEDS, COUNTS, st.booleans(), st.booleans())
def test_dna_rendering_there_and_back(seed, count, apart, opened_as_file):
    rig = named(random_rig(seed, count), "{:02d}")
    frames, gaps = random_take(seed, rig, "{}")
    with tempfile.TemporaryDirectory() as name:
        main = write_dna(Path(name), opencv(rig), frames, gaps, apart)
        capture = open_capture(main if opened_as_file else name)
        assert_same(capture, rig)
        assert_take(capture, rig, frames, gaps)


def test_dnas_colours_are_calibrated_by_channel(tmp_path):
    """A value x becomes a x^2 + b x + c of 0 to 255, in the order blue, green, red; then it is cut off."""
    rig = named([camera | {"dist": np.zeros(5)} for camera in random_rig(3, 2)], "{:02d}")
    blue, green, red = [0.001, 0.5, 3.0], [0.0, 1.0, 0.0], [0.0, 9.0, 0.0]
    write_dna(tmp_path, rig, ["0"], colours=[np.array([blue, green, red])] * 2)
    rgb = open_capture(tmp_path).read(0).rgb[0, :, 0, 0].tolist()
    assert rgb == [255, 60, round(0.001 * 3600 + 30 + 3)]


def test_of_several_sequences_one_is_opened_by_its_file(tmp_path):
    rig = named(random_rig(3, 3), "{:02d}")
    for name in ("0012_11", "0013_01"):
        main = write_dna(tmp_path, rig, ["0", "1"], apart=True, name=name)
    with pytest.raises(CaptureError, match=r"expected one sequence, got 2 in .*; open one of the files, 0012_11.smc"):
        open_capture(tmp_path)
    capture = open_capture(main)
    assert capture.name == "0013_01"
    assert len(capture_set(main, frames=1)) == 3
    annotations = tmp_path / "part1_annotations/0013_01_annots.smc"
    assert open_capture(annotations).cameras.names == capture.cameras.names
    annotations.unlink()
    with pytest.raises(CaptureError, match=r"expected 0013_01_annots\.smc beside it or in the folder of annotations"):
        open_capture(main)


def test_a_container_leads_nowhere_else(tmp_path):
    """Neither links nor external data in a HDF5 file make its reader look at other files."""
    rig = named(random_rig(3, 2), "{:02d}")
    main = write_dna(tmp_path, rig, ["0", "1"])
    (tmp_path / "secret").write_bytes(b"secret" * 100)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["image"] = np.zeros(10, np.uint8)
    cam = str(int(rig[0]["name"]))
    group = "Camera_5mp" if int(cam) < 48 else "Camera_12mp"
    for wrong in ("link", "external"):
        with h5py.File(main, "a") as file:
            color = file[f"{group}/{cam}/color"]
            del color["1"]
            if wrong == "link":
                color["1"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "image")
            else:
                color.create_dataset("1", (600,), np.uint8, external=[(str(tmp_path / "secret"), 0, 600)])
        with pytest.raises(CaptureError, match=r"expected a readable file, got: (no|its data lie in another file)"):
            open_capture(tmp_path).read(1)


def test_members_whose_names_are_no_text_are_left_out(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file[b"\x82"], file["7"] = np.zeros(3, np.uint8), np.zeros(3, np.uint8)
    assert names_in(tmp_path / "a.h5") == {"7"}


def test_a_named_type_is_no_image(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a.png"] = np.dtype("uint8")
    with pytest.raises(ValueError, match="expected the bytes of an image"):
        read_bytes(tmp_path / "a.h5" / "a.png")


def test_images_of_plain_captures_may_lie_in_hdf5_files(tmp_path):
    rig = named([camera | {"dist": np.zeros(5)} for camera in random_rig(3, 2)], "{:02d}")
    main = write_dna(tmp_path, rig, ["0"])
    cameras = []
    for camera in rig:
        cam = int(camera["name"])
        path = f"{main.name}/{'Camera_5mp' if cam < 48 else 'Camera_12mp'}/{cam}/color/{{frame}}"
        entry = {key: np.asarray(camera[key]).tolist() for key in ("K", "R", "t")}
        cameras.append(entry | {"name": camera["name"], "width": camera["width"], "height": camera["height"]})
        cameras[-1]["image"] = path
    told = {"format": "plain-capture/1", "frames": ["0"], "cameras": cameras}
    (tmp_path / "cameras.json").write_text(json.dumps(told))
    assert int(open_capture(tmp_path).read(0).rgb[1, 0, 0, 0]) == 80


@TAKES
@given(SEEDS, COUNTS)
def test_riftcast_there_and_back(seed, count):
    rig = named(random_rig(seed, count, 0), "{}")
    frames, gaps = random_take(seed, rig, "{:05d}")
    with tempfile.TemporaryDirectory() as name:
        write_riftcast(Path(name), rig, frames, gaps)
        capture = open_capture(name)
        assert_same(capture, rig)
        assert_take(capture, rig, frames, gaps)


META = """{ // what RIFTCast is started with
 "type": "VCI", "version": "2.1.0",
 "dataset": {"frame_count": 2, "start_frame": 1, "path": "data", "to_world": [%s], "note": "a // b"},
 "volume": {"position": [0.0, 1.5, 0.0], "scale": 1.5} // metres
}"""


def test_riftcasts_meta_file_says_bounds_up_and_frames(tmp_path):
    rig = named(random_rig(3, 3, 0), "{}")
    frames = [f"{n:05d}" for n in range(4)]
    to_world = np.eye(4)
    to_world[:3, 3] = 1, 2, 3
    text = META % ", ".join(map(str, to_world.ravel().tolist()))
    write_riftcast(tmp_path / "data", rig, frames, (), text)
    (tmp_path / "start.json").write_text(text)
    for path in (tmp_path / "data", tmp_path / "data/meta.json", tmp_path / "start.json"):
        capture = open_capture(path)
        assert capture.frame_ids == ("00001", "00002")
        assert capture.up is not None and capture.up.tolist() == [0, -1, 0]
        # The cube's corners, (-1.5, 0, -1.5) to (1.5, 3, 1.5), moved by to_world, then with y and z turned about.
        assert capture.bounds is not None
        assert capture.bounds.low.tolist() == [-0.5, -5, -4.5] and capture.bounds.high.tolist() == [2.5, -2, -1.5]


def test_what_riftcast_cannot_mean_is_refused(tmp_path):
    rig = named(random_rig(3, 2, 0), "{}")
    good = META % ", ".join("1" if n % 5 == 0 else "0" for n in range(16))
    for old, new, message in (
        ('"path": "data"', '"flip_masks": false', "expected flip_images and flip_masks"),
        ("2.1.0", "3.0.0", "expected version 2 of RIFTCast's meta file, got '3.0.0'"),
    ):
        write_riftcast(tmp_path, rig, ["00001"], (), good.replace(old, new))
        with pytest.raises(CaptureError, match=message):
            open_capture(tmp_path)


@settings(max_examples=60, deadline=None, database=None, derandomize=True)
@given(st.integers(1, 9), st.integers(1, 9), st.lists(st.booleans(), min_size=81, max_size=81))
def test_run_lengths_there_and_back(tmp_path_factory, height, width, values):
    mask = 255 * np.array(values[: height * width], np.uint8).reshape(height, width)
    file = tmp_path_factory.getbasetemp() / "mask_1.bin"
    file.write_bytes(run_lengths(mask))
    assert (read_runs(file, "mask", (height, width)) == mask).all()


def test_run_lengths_are_those_of_the_format(tmp_path):
    assert np.frombuffer(run_lengths(np.zeros((3, 4), np.uint8)), "<i4").tolist() == [0, 12]
    mask = np.array([[255, 0, 0], [0, 130, 0]], np.uint8)
    assert np.frombuffer(run_lengths(mask), "<i4").tolist() == [1, 1, 4, 5, 6]
    file = tmp_path / "a.bin"
    for wrong in ([0], [2, 12], [0, 5, 4, 12], [0, 13], [], [0, -2, 12]):
        file.write_bytes(np.array(wrong, "<i4").tobytes())
        with pytest.raises(CaptureError, match=r"expected runs of 0 and 1 that end at 4 x 3 = 12 pixels"):
            read_runs(file, "a.bin: camera '1'", (3, 4))
    file.write_bytes(run_lengths(mask)[:-1])
    with pytest.raises(CaptureError, match="got 19 bytes"):
        read_runs(file, "a.bin", (2, 3))
