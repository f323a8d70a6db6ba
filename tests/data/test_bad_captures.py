"""Each thing that can be wrong with a capture is one clear line and exit code 2."""

import numpy as np
import pytest
from reference.foreign_formats import write_easymocap
from reference.foreign_studios import write_take

from viewmend.cli import main
from viewmend.data.capture_folder import open_capture
from viewmend.data.errors import CaptureError


def camera(**values):
    return lambda plain: plain.edit(lambda d: d["cameras"][1].update(values))


def whole(**values):
    return lambda plain: plain.edit(lambda d: d.update(values))


def without(key):
    return lambda plain: plain.edit(lambda d: d.pop(key))


def entry(key, row, column, value):
    return lambda plain: plain.edit(lambda d: d["cameras"][1][key][row].__setitem__(column, value))


def write(file, data):
    return lambda plain: (plain.path / file).write_bytes(data)


def cut(file):
    return lambda plain: (plain.path / file).write_bytes((plain.path / file).read_bytes()[:-30])


def picture(file, image):
    return lambda plain: plain.put(file, image)


def remove(*files):
    return lambda plain: [(plain.path / file).unlink() for file in files]


def every_mask(image):
    def spoil(plain):
        for name in "abcd":
            for frame in ("000", "001"):
                plain.put(f"masks/{name}_{frame}.png", image)

    return spoil


def video(frames):
    def spoil(plain):
        plain.put_video("b.avi", [np.zeros((32, 40, 3), np.uint8)] * frames)
        plain.edit(lambda d: d["cameras"][1].update(video="b.avi"))
        plain.edit(lambda d: d["cameras"][1].pop("image"))

    return spoil


def scaled_rotation(factor):
    def spoil(plain):
        R = plain.description["cameras"][1]["R"]
        camera(R=(np.array(R) * factor).tolist())(plain)

    return spoil


def of_pixels(height, width):
    return np.full((height, width), 255, np.uint8)


def depth_of_8_bit(plain):
    plain.put("depth.png", of_pixels(32, 40))
    plain.edit(lambda d: [c.update(depth="depth.png") for c in d["cameras"]])


NAN, FILE, B = float("nan"), "cameras.json", "camera 'b'"
BAD = {
    "no calibration": (remove("cameras.json"), [FILE, "the folder has neither"]),
    "no JSON": (write("cameras.json", b'{"format": '), [FILE, "expected JSON", "line 1"]),
    "binary": (write("cameras.json", b"\xff\xfe\x00\x80"), [FILE, "expected JSON"]),
    "a list": (write("cameras.json", b"[1, 2]"), [FILE, "expected an object", "[1, 2]"]),
    "no version": (without("format"), [FILE, "format", "got nothing"]),
    "other version": (whole(format="plain-capture/2"), [FILE, '"plain-capture/1"', 'got "plain-capture/2"']),
    "typo of case": (
        lambda plain: plain.edit(lambda d: d["cameras"][1].update(k=d["cameras"][1].pop("K"))),
        [FILE, "the key 'K'", "rename"],
    ),
    "typo": (whole(metre_per_unit=0.001), [FILE, "metre_per_unit", "'metres_per_unit'", "rename"]),
    "empty frames": (whole(frames=[]), [FILE, "frames", "not empty"]),
    "frame number": (whole(frames=[0, 1]), [FILE, "frames[0]", "a text", "got 0"]),
    "frame twice": (whole(frames=["000", "000"]), [FILE, "frames", "different", "['000'] more than once"]),
    "frame outside": (whole(frames=["000", "/../../x"]), ["inside the folder", "../x"]),
    "fps": (whole(fps="25"), [FILE, "fps", "a number", 'got "25"']),
    "zero unit": (whole(metres_per_unit=0), [FILE, "metres_per_unit", "a number > 0", "got 0"]),
    "infinite unit": (whole(metres_per_unit=float("inf")), [FILE, "metres_per_unit", "got Infinity"]),
    "bounds order": (whole(bounds=[[1, 1, 1], [-1, -1, -1]]), [FILE, "bounds", "low corner"]),
    "bounds shape": (whole(bounds=[[1, 1], [2, 2]]), [FILE, "bounds[0]", "a list of length 3", "got [1, 1]"]),
    "no up": (whole(up=[0, 0, 0]), [FILE, "up", "a direction"]),
    "one camera": (
        lambda p: p.edit(lambda d: d["cameras"].__delitem__(slice(1, 4))),
        [FILE, "two cameras", "got 1"],
    ),
    "camera is text": (lambda p: p.edit(lambda d: d["cameras"].append("e")), [FILE, "cameras[4]", 'got "e"']),
    "same names": (camera(name="a"), [FILE, "cameras", "different names", "['a'] more than once"]),
    "no name": (camera(name=""), [FILE, "cameras[1]", "name"]),
    "no K": (camera(K=None), [FILE, B, "K", "a value", "got nothing"]),
    "singular K": (entry("K", 0, 0, 0), [FILE, B, "K", "fx and fy above 0"]),
    "mirrored K": (entry("K", 1, 1, -40), [FILE, B, "K", "fx and fy above 0"]),
    "transposed K": (entry("K", 2, 0, 20), [FILE, B, "K", "[0, 0, 1]"]),
    "NaN in K": (entry("K", 0, 2, NAN), [FILE, B, "K", "finite", "NaN"]),
    "text in K": (entry("K", 0, 2, "20"), [FILE, B, "K[0][2]", "a number", 'got "20"']),
    "NaN in R": (entry("R", 0, 0, NAN), [FILE, B, "R", "finite", "NaN"]),
    "infinite t": (camera(t=[0, float("inf"), 0]), [FILE, B, "t[1]", "a finite number", "Infinity"]),
    "t of two": (camera(t=[0, 1]), [FILE, B, "t", "a list of length 3", "[0, 1]"]),
    "R too long": (scaled_rotation(1.01), [FILE, B, "R", "a rotation", "off by 0.02"]),
    "R left-handed": (scaled_rotation(-1), [FILE, B, "R", "a rotation", "determinant -1"]),
    "four distortions": (camera(dist=[0, 0, 0, 0]), [FILE, B, "dist", "a list of length 5"]),
    "width is text": (camera(width="40"), [FILE, B, "width", "a whole number", 'got "40"']),
    "width is true": (camera(width=True), [FILE, B, "width", "a whole number", "got true"]),
    "height is zero": (camera(height=0), [FILE, B, "height", "a whole number >= 1", "got 0"]),
    "image and video": (camera(video="b.avi"), [FILE, B, "either 'image' or 'video'", "both"]),
    "neither": (camera(image=None), [FILE, B, "either 'image' or 'video'", "neither"]),
    "absolute path": (camera(image="/tmp/b.png"), [FILE, B, "image", "inside the capture", "/tmp/b.png"]),
    "path upwards": (
        camera(mask="masks/../../b.png"),
        [FILE, B, "mask", "inside the capture", "../../b.png"],
    ),
    "drive": (camera(image="C:\\b.png"), [FILE, B, "image", "inside the capture"]),
    "camera without images": (
        camera(image="nowhere/{frame}.png"),
        ["nowhere/000.png", B, "none in 2 frames", FILE],
    ),
    "camera without masks": (camera(mask="nowhere.png"), ["nowhere.png", B, "the camera's mask", FILE]),
    "never both": (
        remove("images/b_000.png", "masks/b_001.png"),
        ["b_000.png", B, "image and mask of the camera in the same frame"],
    ),
    "frame of nobody": (
        remove(*(f"images/{name}_001.png" for name in "abcd")),
        ["images/a_001.png", "frame '001'", "of any camera"],
    ),
    "masks without a subject": (
        remove(*(f"masks/{name}_001.png" for name in "abcd")),
        ["masks/a_001.png", "frame '001'", "no mask of any camera", "black ones", FILE],
    ),
    "image or mask": (
        remove("images/a_001.png", "images/b_001.png", "masks/c_001.png", "masks/d_001.png"),
        ["a_001.png", "frame '001'", "image and mask of the same camera"],
    ),
    "mask of one": (
        lambda p: p.edit(lambda d: [d["cameras"][n].pop("mask") for n in (1, 2, 3)]),
        [FILE, B, "'mask' for every camera or for none"],
    ),
    "depth of some": (camera(depth="masks/b_000.png"), [FILE, "camera 'a'", "'depth' for every camera"]),
    "image cut short": (cut("images/b_000.png"), ["images/b_000.png", B, "frame '000'", "truncated"]),
    "image is text": (write("images/b_000.png", b"hello"), ["images/b_000.png", B, "frame '000'", "5 bytes"]),
    "image is empty": (write("images/b_000.png", b""), ["images/b_000.png", B, "frame '000'", "0 bytes"]),
    "image size": (
        picture("images/b_000.png", of_pixels(16, 20)),
        ["b_000.png", B, "'000'", "40 x 32", "got 20 x 16"],
    ),
    "mask size": (
        picture("masks/b_000.png", of_pixels(16, 20)),
        ["masks/b_000.png", B, "'000'", "40 x 32 pixels as its image", "got 20 x 16; make it"],
    ),
    "mask of 16 bit": (
        picture("masks/b_000.png", np.arange(32 * 40, dtype=np.uint16).reshape(32, 40)),
        ["masks/b_000.png", B, "frame '000'", "8-bit mask", "uint16"],
    ),
    "empty masks": (every_mask(of_pixels(32, 40) * 0), ["expected foreground", "none in 2 frames"]),
    "faint masks": (
        every_mask(np.tile(np.arange(40, dtype=np.uint8), (32, 1))),
        ["above 127", "none in 2 frames"],
    ),
    "no video": (lambda p: (video(2)(p), (p.path / "b.avi").unlink()), ["b.avi", B, "the camera's video"]),
    "video is text": (lambda p: (video(2)(p), write("b.avi", b"hello" * 99)(p)), ["b.avi", B, "a video"]),
    "depth of 8 bit": (depth_of_8_bit, ["depth.png", "camera 'a'", "frame '000'", "16-bit", "uint8"]),
}


@pytest.mark.parametrize("spoil, words", BAD.values(), ids=BAD.keys())
def test_one_line_says_what_is_wrong(plain, capfd, spoil, words):
    spoil(plain)
    out = plain.path.parent / "check.png"
    assert main(["check", str(plain.path), "--out", str(out)]) == 2
    printed, message = capfd.readouterr()
    assert printed == ""
    assert message.startswith("viewmend: error: ") and message.count("\n") == 1, message
    assert str(plain.path) in message
    assert [word for word in words if word not in message] == [], message
    assert message.split(";")[-1].strip(), "the next step is missing"
    assert not out.exists()


def test_a_time_that_is_not_there(plain, capfd):
    assert main(["check", str(plain.path), "--frame", "2"]) == 2
    assert "0 to 1, got 2" in capfd.readouterr().err


def test_a_frame_without_masks_of_a_format_that_lists_no_frames(tmp_path):
    lens = {
        "K": np.array([[50.0, 0, 20], [0, 50, 16], [0, 0, 1]]),
        "dist": np.zeros(5),
        "width": 40,
        "height": 32,
    }
    rig = [lens | {"name": name, "R": np.eye(3), "t": np.zeros(3)} for name in "12"]
    write_easymocap(tmp_path, rig)
    write_take(tmp_path, rig, ("000000", "000001"), (), "images/{c}/{f}.png", "masks/{c}/{f}.png")
    for name in "12":
        (tmp_path / f"masks/{name}/000001.png").unlink()
    with pytest.raises(CaptureError, match=r"masks/1/000001.*no mask of any.*or remove the frame's images$"):
        open_capture(tmp_path)


def test_a_camera_without_masks_is_not_used_and_named_once(plain, capsys, caplog):
    plain.edit(lambda d: d["cameras"][1].pop("mask"))
    capture = open_capture(plain.path)
    assert capture.unmasked == ("b",) and capture.cameras.names == ("a", "c", "d")
    assert capture.read(0).cameras.names == ("a", "c", "d") and not capture.gaps
    assert "camera 'b' is not used: expected masks, which the other cameras have, got none" in caplog.text
    assert main(["check", str(plain.path)]) == 0
    assert capsys.readouterr().out.count("'b'") == 1
    assert open_capture(plain.path, masks="none").cameras.names == ("a", "b", "c", "d")
