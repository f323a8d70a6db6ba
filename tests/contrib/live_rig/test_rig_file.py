"""`rig.toml`: what it says, and each mistake in one line."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from reference.ball_rig import rig_text
from reference.foreign_studios import write_riftcast
from reference.random_rigs import named, random_rig

from viewmend.contrib.live_rig.rig_file import MAX_BYTES, read_rig
from viewmend.contrib.live_rig.worker import mask_maker
from viewmend.data.errors import CaptureError

NAMES = ("left", "right")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A calibration of two cameras, without any image."""
    camera = {
        "width": 640,
        "height": 480,
        "K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]],
        "dist": [0.1, 0, 0, 0, 0],
    }
    camera |= {"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 2], "image": "{frame}.png"}
    cameras = [camera | {"name": name} for name in NAMES]
    rig = {"format": "plain-capture/1", "first_pixel_center": [0.5, 0.5], "up": [0, -2, 0], "frames": ["0"]}
    (tmp_path / "take").mkdir()
    (tmp_path / "take/cameras.json").write_text(json.dumps(rig | {"cameras": cameras}))
    return tmp_path


def read(folder: Path, text: str, max_image_size: int | None = None):
    (folder / "rig.toml").write_text(text)
    return read_rig(folder / "rig.toml", max_image_size)


def test_a_rig_is_read(folder):
    text = """
        calibration = "take"
        fps = 30
        wait_ms = 100
        [mask]
        method = "person"
        [[cameras]]
        name = "right"
        url = "/dev/video2"
        options = {video_size = "640x480"}
        offset_ms = -20
        [[cameras]]
        name = "left"
        url = "rtsp://10.0.0.7/stream"
        clock = "arrival"
    """
    rig = read(folder, text)
    right, left = rig.cameras
    assert (rig.name, rig.fps, rig.up.tolist()) == (folder.name, 30, [0, -1, 0])
    assert rig.tolerance_s == pytest.approx(1 / 60)
    assert (right.name, right.url, right.format) == ("right", "/dev/video2", "v4l2")
    assert (left.url, left.format, left.clock, left.is_file) == (
        "rtsp://10.0.0.7/stream",
        None,
        "arrival",
        False,
    )
    assert not left.calibration.dist[1:].any() and left.calibration.dist[0] == 0.1


@pytest.mark.parametrize("offsets_ms", [(-400, 0), (0, 400), (100, 500)])
def test_only_differences_of_offsets_count(folder, offsets_ms):
    """Neither camera's images are in the future, and a frame waits for the later one's."""
    text = 'calibration = "take"\n'
    for name, offset_ms in zip(NAMES, offsets_ms, strict=True):
        text += f'[[cameras]]\nname = "{name}"\nurl = "{name}.mp4"\noffset_ms = {offset_ms}\n'
    rig = read(folder, text)
    assert [camera.offset_s for camera in rig.cameras] == pytest.approx([0, 0.4])
    assert rig.wait_s == pytest.approx(0.2 + 0.4)


def test_files_lie_beside_the_rig_and_pictures_are_made_smaller(folder):
    rig = read(folder, rig_text(NAMES), max_image_size=320)
    camera = rig.cameras[0]
    assert camera.url == str(folder / "take/video/left.mp4") and camera.is_file
    assert camera.plate == folder / "plates/left.png"
    assert camera.sent_px == (640, 480) and (camera.calibration.width, camera.calibration.height) == (
        320,
        240,
    )
    assert np.allclose(camera.calibration.K, [[250, 0, 160], [0, 250, 120], [0, 0, 1]])


def test_the_calibration_may_be_named_by_its_file(folder):
    rig = read(folder, rig_text(NAMES, calibration='"take/cameras.json"'))
    assert len(rig.cameras) == 2


def test_another_file_than_the_calibration_is_refused_or_reported(folder, caplog):
    (folder / "take" / "other.json").write_text("{}")
    with pytest.raises(CaptureError, match=r"which is cameras\.json; name the format"):
        read(folder, rig_text(NAMES, calibration='"take/other.json"'))
    rig = read(folder, rig_text(NAMES, calibration='"take/other.json"', format='"plain"'))
    assert [camera.name for camera in rig.cameras] == list(NAMES)
    assert "the calibration is read from cameras.json, as of format 'plain'" in caplog.text


def test_the_calibration_may_be_a_file_that_stands_for_a_capture(folder):
    """RIFTCast's meta file may lie outside of the data set's folder."""
    cameras = named(random_rig(3, 2, 0), "{}")
    meta = {"type": "VCI", "version": "2.1.0", "dataset": {"path": "data"}, "volume": {"position": [0, 0, 0]}}
    write_riftcast(folder / "data", cameras, ["00001"])
    (folder / "start.json").write_text(json.dumps(meta))
    for format in (None, '"riftcast"'):
        names = [camera["name"] for camera in cameras]
        rig = read(folder, rig_text(names, calibration='"start.json"', format=format))
        assert rig.bounds_m.tolist() == [[-1, -1, -1], [1, 1, 1]]


def test_masks_are_made_by_the_person_network_unless_the_file_says_otherwise(folder):
    cameras = "".join(f'[[cameras]]\nname = "{name}"\nurl = "{name}.mp4"\n' for name in NAMES)
    assert {camera.mask.method for camera in read(folder, f'calibration = "take"\n{cameras}').cameras} == {
        "person"
    }


ONE = '[[cameras]]\nname = "left"\nurl = "a.mp4"\n'
HEAD = 'calibration = "take"\n[mask]\nmethod = "plate"\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("calibration = take", "Invalid value"),
        ("\xff", "rig.toml: "),
        ("a = " + 9999 * "[", "brackets that are nested too deeply"),
        (rig_text(NAMES) + "#" * MAX_BYTES, "expected rig.toml to have at most 1000000 bytes, got more"),
        (rig_text(NAMES, calibration=None), "calibration: expected a value, got nothing; add the key"),
        (rig_text(NAMES, fps="0"), "fps: "),
        (rig_text(NAMES, fps='"15"'), 'fps: expected a number, got "15"'),
        (rig_text(NAMES, calibratoin='"x"'), "got 'calibratoin'"),
        (HEAD + ONE, "cameras: expected a list of length >= 2"),
        (HEAD + ONE + ONE, "expected different names, got ['left'] more than once"),
        (HEAD + ONE + ONE.replace("left", "middle"), "cameras that"),
        (HEAD + ONE + ONE.replace("left", "right").replace("a.mp4", "ftp://x/y"), "expected a url of rtsp"),
        (HEAD + ONE + ONE.replace("left", "right").replace("a.mp4", "RTSP://x/y"), "expected a url of rtsp"),
        (
            HEAD + ONE + ONE.replace("left", "right").replace("a.mp4", "crypto+http://x"),
            "expected a url of rtsp",
        ),
        (HEAD + ONE + ONE.replace("left", "right") + "options = {a = 1}", "options: expected a text, got "),
        (
            HEAD.replace("plate", "magic") + ONE + ONE.replace("left", "right"),
            "mask: method: expected person or plate",
        ),
        (HEAD + 'plates = "all.png"\n' + ONE + ONE.replace("left", "right"), "a path with {camera} in it"),
        (rig_text(NAMES, calibration='"nowhere"'), "there is no such folder; check the path"),
    ],
)
def test_each_mistake_is_one_line(folder, text, said):
    with pytest.raises(CaptureError) as error:
        read(folder, text)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_a_clean_plate_must_be_the_cameras(folder, ball_rig):
    camera = read(folder, rig_text(NAMES)).cameras[0]
    with pytest.raises(
        CaptureError, match=r"left\.png: the clean plate of camera 'left': expected a readable file"
    ):
        mask_maker(camera)
    shutil.copytree(ball_rig / "plates", folder / "plates")
    (folder / "plates/c0.png").rename(folder / "plates/left.png")
    with pytest.raises(CaptureError, match="expected 640 x 480 pixels as the calibration says, got 48 x 48"):
        mask_maker(camera)
