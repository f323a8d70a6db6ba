"""Each mistake that a capture can have: what is said of it, and what a command does."""

import json
import logging

import cv2
import numpy as np
import pytest
import torch

from viewmend.capture.diagnosis import diagnose, faulty_masks
from viewmend.capture.plain import open_capture
from viewmend.capture.plain_writer import write_capture
from viewmend.capture.prepare import prepare
from viewmend.cli import main
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.plan import DataPlan
from viewmend.training.sources import scene_source


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("diagnosis") / "studio"
    write_capture(Studio(StudioConfig(seed=2, cameras=8, frames=2, size_px=96)), path, images="png")
    return path


@pytest.fixture
def folder(good, tmp_path):
    import shutil

    return shutil.copytree(good, tmp_path / "studio")


def change_cameras(folder, change, names=None):
    description = json.loads((folder / "cameras.json").read_text())
    for camera in description["cameras"]:
        if names is None or camera["name"] in names:
            R, t = change(np.array(camera["R"]), np.array(camera["t"]))
            camera["R"], camera["t"] = R.tolist(), t.tolist()
    (folder / "cameras.json").write_text(json.dumps(description))


def change_masks(folder, change, camera="*"):
    for file in folder.glob(f"mask/{camera}/*.png"):
        cv2.imwrite(str(file), change(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)))


def names_of(folder):
    return [camera["name"] for camera in json.loads((folder / "cameras.json").read_text())["cameras"]]


def flipped(R, t):
    return np.diag([1, -1, -1]) @ R, np.diag([1, -1, -1]) @ t


POSES = {
    "camera-to-world;": lambda R, t: (R.T, -R.T @ t),
    "OpenGL axes": flipped,
    "camera-to-world of OpenGL axes": lambda R, t: (R.T @ np.diag([1, -1, -1]), -R.T @ t),
    "R is camera-to-world (transposed)": lambda R, t: (R.T, t),
    "t is the camera's centre": lambda R, t: (R, -R.T @ t),
    "check metres_per_unit": lambda R, t: (R, 100 * t),
}


def test_a_good_capture_has_no_findings(good):
    capture = open_capture(good)
    assert diagnose(capture.read(0), capture.bounds) == ()


@pytest.mark.parametrize("said", POSES)
def test_wrong_poses_are_named_and_refused(folder, capsys, tmp_path, said):
    change_cameras(folder, POSES[said])
    arguments = ["mend", str(folder), "--out", str(tmp_path / "out"), "--path", "orbit", "--model", "telea"]
    assert main(arguments) == 2
    assert said in capsys.readouterr().err
    main(["info", str(folder)])
    assert said in capsys.readouterr().out


def test_what_mend_refuses_is_served_to_nobody(folder, capsys):
    change_cameras(folder, flipped)
    assert main(["mend", str(folder), "--out", str(folder / "out"), "--path", "orbit", "--model", "telea"]) == 2
    said = capsys.readouterr().err
    assert main(["serve", str(folder), "--port", "0", "--model", "telea"]) == 2
    assert capsys.readouterr().err == said and "OpenGL axes" in said and "http" not in said


def test_training_on_what_mend_refuses_does_not_begin(folder):
    change_masks(folder, lambda mask: 255 - mask)
    with pytest.raises(ValueError, match="inverted"):
        scene_source(DataPlan(captures=(folder,)), "seed")


def test_swapped_cameras_are_named_and_refused(folder):
    first, _, second, *_ = names_of(folder)
    file = folder / "cameras.json"
    description = json.loads(file.read_text())
    a, b = (next(c for c in description["cameras"] if c["name"] == name) for name in (first, second))
    for key in ("K", "R", "t"):
        a[key], b[key] = b[key], a[key]
    file.write_text(json.dumps(description))
    with pytest.raises(ValueError, match=f"'{first}' and '{second}' are swapped"):
        prepare(open_capture(folder))


def test_inverted_masks_are_refused(folder):
    change_masks(folder, lambda mask: 255 - mask)
    with pytest.raises(ValueError, match="inverted"):
        prepare(open_capture(folder))


@pytest.mark.parametrize(("said", "change"), [("empty", lambda mask: 0 * mask), ("inverted", lambda mask: 255 - mask)])
def test_one_bad_mask_is_named_once_and_its_camera_left_out(folder, caplog, said, change):
    name = names_of(folder)[3]
    change_masks(folder, change, name)
    with caplog.at_level(logging.WARNING):
        capture = prepare(open_capture(folder), align=False)
        frames = [capture.read(0), capture.read(1)]
    assert all(name not in frame.cameras.names and len(frame.cameras) == 7 for frame in frames)
    assert len(caplog.messages) == 1 and f"camera '{name}': its mask is {said}" in caplog.messages[0]


@pytest.mark.parametrize("spoilt", [0, 1])
def test_an_empty_mask_at_one_time_costs_that_time_alone(folder, spoilt):
    name = names_of(folder)[3]
    cv2.imwrite(str(sorted(folder.glob(f"mask/{name}/*.png"))[spoilt]), np.zeros((96, 96), np.uint8))
    capture = prepare(open_capture(folder), align=False)
    assert [name in capture.read(time).cameras.names for time in (0, 1)] == [spoilt != 0, spoilt != 1]


def test_an_empty_mask_is_right_where_the_subject_is_out_of_view(folder):
    name = names_of(folder)[3]
    change_masks(folder, lambda mask: 0 * mask, name)
    change_cameras(folder, lambda R, t: (np.diag([-1, 1, -1]) @ R, np.diag([-1, 1, -1]) @ t), [name])
    assert name in prepare(open_capture(folder), align=False).read(0).cameras.names


def test_one_camera_that_disagrees_is_named_and_left_out(folder, caplog):
    name = names_of(folder)[5]
    change_cameras(folder, flipped, [name])
    capture = prepare(open_capture(folder), align=False)
    assert name not in capture.read(1).cameras.names
    assert f"camera '{name}' disagrees" in caplog.text


def test_a_held_out_camera_judges_nobody_and_is_named(folder, caplog):
    held, *inputs = names_of(folder)
    source = open_capture(folder)
    before = prepare(source, inputs, align=False).read(0)
    change_masks(folder, lambda mask: 255 - mask, held)
    after = prepare(open_capture(folder), inputs, align=False).read(0)
    assert before.cameras.names == after.cameras.names and "scores against it mean nothing" in caplog.text
    masks = [frame.without([held]).mask for frame in (before, after)]
    assert masks[0] is not None and masks[1] is not None and torch.equal(masks[0], masks[1])


def test_masks_are_judged_by_inputs_alone(folder, caplog):
    held, *others = names_of(folder)
    change_masks(folder, lambda mask: 0 * mask, held)
    assert held in prepare(open_capture(folder), others, align=False).read(0).cameras.names and not caplog.messages
    change_masks(folder, lambda mask: 255 - mask, others[0])
    change_masks(folder, lambda mask: 255 - mask, others[1])
    frame, bounds = open_capture(folder).read(0), open_capture(folder).bounds
    assert [finding.fatal for finding in faulty_masks(frame, others[:3], bounds)] == [True], "two of three"


def test_a_subject_of_another_unit_is_named(folder, caplog):
    file = folder / "cameras.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"metres_per_unit": 0.01}))
    prepare(open_capture(folder), align=False)
    assert "check metres_per_unit" in caplog.text


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    path = tmp_path_factory.mktemp("moving") / "studio"
    write_capture(Studio(StudioConfig(seed=2, cameras=8, frames=7, fps=10, size_px=128)), path, images="png")
    return path


def said_of(path, change=lambda folder: None, folder=None):
    import shutil

    folder = shutil.copytree(path, folder)
    change(folder)
    records = []
    handler = logging.Handler()
    handler.emit = lambda record: records.append(record.getMessage())
    logging.getLogger("viewmend").addHandler(handler)
    try:
        prepare(open_capture(folder), first=3)
    finally:
        logging.getLogger("viewmend").removeHandler(handler)
    return records


def shifted_in_time(*streams):
    def change(folder):
        for stream in streams:
            files = sorted((folder / stream / names_of(folder)[3]).glob("*.png"))
            data = [file.read_bytes() for file in files]
            for time, file in enumerate(files):
                file.write_bytes(data[max(0, time - 2)])

    return change


def spoilt_images(spoil):
    def change(folder):
        for file in folder.glob(f"image/{names_of(folder)[3]}/*.png"):
            cv2.imwrite(str(file), spoil(cv2.imread(str(file))))

    return change


def half_a_mask(folder):
    def upper(mask):
        rows = np.flatnonzero(mask.any(1))
        mask[: (rows[0] + rows[-1]) // 2] = 0
        return mask

    change_masks(folder, upper, names_of(folder)[3])


def exchanged_images(folder):
    first, second = (folder / "image" / names_of(folder)[view] for view in (3, 5))
    first.rename(folder / "aside")
    second.rename(first)
    (folder / "aside").rename(second)


ODD = {
    "late": (shifted_in_time("image", "mask"), "late by about 2 frames"),
    "images late": (shifted_in_time("image"), "the images of camera '{}': late by about 2 frames"),
    "masks late": (shifted_in_time("mask"), "camera '{}': late by about 2 frames"),
    "half a mask": (half_a_mask, "'{}'"),
    "a wide mask": (lambda f: change_masks(f, lambda m: cv2.dilate(m, np.ones((13, 13))), names_of(f)[3]), "'{}'"),
    "negative": (spoilt_images(lambda image: 255 - image), "do not show what the others see"),
    "upside down": (spoilt_images(lambda image: image[::-1]), "fit much better upside down"),
    "blurred": (spoilt_images(lambda image: cv2.GaussianBlur(image, (0, 0), 4)), "'{}'"),
    "grey": (spoilt_images(lambda image: image.mean(-1, keepdims=True).repeat(3, -1).astype(np.uint8)), "are grey"),
    "exchanged images": (exchanged_images, "do not show what the others see"),
    "mirrored": (spoilt_images(lambda image: image[:, ::-1]), "fit much better mirrored"),
}


def test_nothing_is_said_of_a_good_capture_in_motion(moving, tmp_path):
    assert said_of(moving, folder=tmp_path / "good") == []


@pytest.mark.parametrize("what", ODD)
def test_one_camera_unlike_its_peers_is_named(moving, tmp_path, what):
    change, words = ODD[what]
    said = said_of(moving, change, tmp_path / "odd")
    name = names_of(moving)[3]
    assert any(words.format(name) in text and f"'{name}'" in text for text in said), said


def test_intrinsics_of_images_of_another_size_are_named_and_refused(folder):
    file = folder / "cameras.json"
    description = json.loads(file.read_text())
    for camera in description["cameras"]:
        camera["K"] = [[2 * x for x in row] for row in camera["K"][:2]] + [[0, 0, 1]]
    file.write_text(json.dumps(description))
    with pytest.raises(ValueError, match=r"K is of images 2 times as large; scale fx, fy, cx, cy and the skew by 0\.5"):
        prepare(open_capture(folder))


@pytest.mark.parametrize("code, words", [(3, "turned by 180 degrees"), (2, "mirrored")])
def test_a_turn_in_exif_is_said_once(folder, caplog, code, words):
    as_jpeg(folder, code)
    capture = open_capture(folder)
    capture.read(0)
    capture.read(1)
    said = [text for text in caplog.messages if "EXIF" in text]
    assert len(said) == 1 and words in said[0] and f"'{names_of(folder)[3]}'" in said[0] and "exiftran" in said[0]


def test_a_turn_by_90_degrees_is_named_where_the_size_is_wrong(folder):
    as_jpeg(folder, 6, crop=64)
    with pytest.raises(
        ValueError, match=r"expected 96 x 96 .* got 96 x 64; its EXIF says that it is to be turned by 90"
    ):
        open_capture(folder).read(0)


def as_jpeg(folder, code, crop=96):
    """The images of one camera as JPEGs whose EXIF has this orientation."""
    file = folder / "cameras.json"
    description = json.loads(file.read_text())
    camera = description["cameras"][3]
    for path in folder.glob(f"image/{camera['name']}/*.png"):
        _, data = cv2.imencode(".jpg", cv2.imread(str(path))[:crop])
        tiff = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0" + bytes([code]) + b"\0\0\0\0\0\0"
        head = b"\xff\xd8\xff\xe1" + (len(tiff) + 2).to_bytes(2, "big") + tiff
        path.with_suffix(".jpg").write_bytes(head + data.tobytes()[2:])
    camera["image"] = camera["image"].replace(".png", ".jpg")
    file.write_text(json.dumps(description))
