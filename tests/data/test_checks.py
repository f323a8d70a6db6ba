"""Checks of a capture: each common mistake is named, good captures have no issues."""

import logging
import shutil
from dataclasses import replace
from unittest.mock import patch

import cv2
import numpy as np
import pytest
import torch
from reference.ball import BallCapture, photograph, ring
from reference.capture_folder import description_of, edit_description
from reference.computed_once import carve_once

from viewmend.cli import main
from viewmend.data.capture_folder import open_capture
from viewmend.data.checks import leave_one_out, synchronisation
from viewmend.data.checks.colours import find_odd_images
from viewmend.data.checks.diagnosis import diagnose, find_bad_masks, find_wrong_unit
from viewmend.data.checks.leave_one_out import OthersHulls, find_outlier_by_hull, find_outlier_by_outlines
from viewmend.data.checks.synchronisation import (
    check_image_mask_sync,
    describe_delay,
    find_desynchronised_cameras,
)
from viewmend.data.errors import Issue
from viewmend.data.native_writer import write_capture
from viewmend.data.prepare import prepare
from viewmend.geometry.alignment import Alignment
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import MultiViewFrame


@pytest.fixture(autouse=True)
def _carved_once(monkeypatch):
    """Hulls of equal masks are carved once, and as coarse as the images are small."""
    carve_once(monkeypatch, coarsely=True)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("diagnosis") / "studio"
    write_capture(Studio(StudioConfig(seed=2, cameras=8, frames=2, size_px=96)), path, images="png")
    return path


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    path = tmp_path_factory.mktemp("moving") / "studio"
    write_capture(Studio(StudioConfig(seed=2, cameras=8, frames=7, fps=10, size_px=128)), path, images="png")
    return path


@pytest.fixture
def folder(good, tmp_path):
    return shutil.copytree(good, tmp_path / "studio")


def names_of(folder):
    return [camera["name"] for camera in description_of(folder)["cameras"]]


def change_poses(folder, change, names=None):
    def apply(content):
        for camera in content["cameras"]:
            if names is None or camera["name"] in names:
                R, t = change(np.array(camera["R"]), np.array(camera["t"]))
                camera["R"], camera["t"] = R.tolist(), t.tolist()

    edit_description(folder, apply)


def change_images(folder, change, camera="*", kind="mask"):
    for file in folder.glob(f"{kind}/{camera}/*.png"):
        cv2.imwrite(str(file), change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))


def empty(mask):
    return 0 * mask


def invert(mask):
    return 255 - mask


def flip(R, t):
    return np.diag([1, -1, -1]) @ R, np.diag([1, -1, -1]) @ t


# Mistakes in the calibration. Each makes hull and masks disagree, and each is fatal.


def swap_calibrations(content):
    a, b = content["cameras"][0], content["cameras"][2]
    for key in ("K", "R", "t"):
        a[key], b[key] = b[key], a[key]


def double_intrinsics(content):
    for camera in content["cameras"]:
        camera["K"] = [[2 * x for x in row] for row in camera["K"][:2]] + [[0, 0, 1]]


FATAL = {
    "camera-to-world;": lambda f: change_poses(f, lambda R, t: (R.T, -R.T @ t)),
    "OpenGL axes": lambda f: change_poses(f, flip),
    "camera-to-world with OpenGL axes": lambda f: change_poses(
        f, lambda R, t: (R.T @ np.diag([1, -1, -1]), -R.T @ t)
    ),
    "R is camera-to-world (transposed)": lambda f: change_poses(f, lambda R, t: (R.T, t)),
    "t is the camera's centre": lambda f: change_poses(f, lambda R, t: (R, -R.T @ t)),
    "check metres_per_unit": lambda f: change_poses(f, lambda R, t: (R, 100 * t)),
    "are swapped; exchange their files": lambda f: edit_description(f, swap_calibrations),
    "K is for images 2 times as large; scale fx, fy, cx, cy and the skew by 0.5": (
        lambda f: edit_description(f, double_intrinsics)
    ),
    "they are inverted": lambda f: change_images(f, invert),
    "they are full": lambda f: change_images(f, lambda mask: 0 * mask + 255),
    "all masks are mirrored": lambda f: change_images(f, lambda mask: mask[:, ::-1]),
    "all masks are upside down": lambda f: change_images(f, lambda mask: mask[::-1]),
    "all masks are rotated by 90 degrees clockwise": lambda f: change_images(
        f, lambda mask: np.rot90(mask, -1)
    ),
}


def test_good_captures_have_no_issues(good, moving, tmp_path):
    capture = open_capture(good)
    assert diagnose(capture.read(0), capture.bounds) == ()
    assert warnings_of(moving, tmp_path) == []


@pytest.mark.parametrize("words", FATAL)
def test_fatal_mistakes_are_explained(folder, words, monkeypatch):
    FATAL[words](folder)
    issues: list[Issue] = []

    def diagnose_once(*arguments):
        issues.extend(diagnose(*arguments))
        return tuple(issues)

    monkeypatch.setattr("viewmend.data.prepare.diagnose", diagnose_once)
    with pytest.raises(ValueError) as refused:
        prepare(open_capture(folder))
    found = [issue.text for issue in issues if issue.fatal]
    assert len(found) == 1 and words in found[0]
    assert found[0] in str(refused.value)


def test_all_commands_report_the_same(folder, capsys):
    change_poses(folder, flip)
    assert (
        main(["mend", str(folder), "--out", str(folder / "out"), "--path", "orbit", "--model", "telea"]) == 2
    )
    message = capsys.readouterr().err
    assert main(["serve", str(folder), "--port", "0", "--model", "telea"]) == 2
    assert capsys.readouterr().err == message and "http" not in message
    main(["check", str(folder)])
    issue = capsys.readouterr().out.splitlines()[-1].removeprefix("  - ")
    assert "OpenGL axes" in issue and issue in message


# Faults of single cameras.


@pytest.mark.parametrize(("words", "change"), [("empty", empty), ("inverted", invert)])
def test_a_bad_mask_is_reported_once_and_its_camera_left_out(folder, caplog, words, change):
    name = names_of(folder)[3]
    change_images(folder, change, name)
    with caplog.at_level(logging.WARNING):
        capture = prepare(open_capture(folder), align=False)
        frames = [capture.read(0), capture.read(1)]
    assert all(name not in frame.cameras.names and len(frame.cameras) == 7 for frame in frames)
    assert len(caplog.messages) == 1 and f"camera '{name}': its mask is {words}" in caplog.messages[0]


@pytest.mark.parametrize("damaged", [0, 1])
def test_a_mask_that_is_empty_once_affects_only_its_frame(folder, damaged):
    name = names_of(folder)[3]
    cv2.imwrite(str(sorted(folder.glob(f"mask/{name}/*.png"))[damaged]), np.zeros((96, 96), np.uint8))
    capture = prepare(open_capture(folder), align=False)
    assert [name in capture.read(time).cameras.names for time in (0, 1)] == [damaged != 0, damaged != 1]


def test_an_empty_mask_is_correct_if_the_subject_is_out_of_view(folder):
    name = names_of(folder)[3]
    change_images(folder, empty, name)
    turn = np.diag([-1, 1, -1])
    change_poses(folder, lambda R, t: (turn @ R, turn @ t), [name])
    assert name in prepare(open_capture(folder), align=False).read(0).cameras.names


def test_a_camera_with_another_pose_is_left_out(folder, caplog):
    name = names_of(folder)[5]
    change_poses(folder, flip, [name])
    assert name not in prepare(open_capture(folder), align=False).read(1).cameras.names
    assert f"camera '{name}' disagrees" in caplog.text


def test_a_held_out_camera_affects_no_other(folder, caplog):
    held, *inputs = names_of(folder)
    before = prepare(open_capture(folder), inputs, align=False).read(0)
    change_images(folder, empty, held)
    assert held in prepare(open_capture(folder), inputs, align=False).read(0).cameras.names
    assert len(caplog.messages) == 1 and f"camera '{held}': its mask is empty" in caplog.text
    caplog.clear()
    change_images(folder, lambda mask: 0 * mask + 255, held)
    after = prepare(open_capture(folder), inputs, align=False).read(0)
    assert before.cameras.names == after.cameras.names and "scores against it are meaningless" in caplog.text
    assert torch.equal(before.without([held]).mask, after.without([held]).mask)


def test_a_wrong_unit_is_reported(folder, caplog):
    edit_description(folder, lambda content: content.update(metres_per_unit=0.01))
    prepare(open_capture(folder), align=False)
    assert "check metres_per_unit" in caplog.text


def test_a_rig_of_an_impossible_size_is_reported_once(folder, caplog, monkeypatch):
    edit_description(folder, lambda content: content.update(metres_per_unit=1000))
    cameras = open_capture(folder).cameras
    (found,) = find_wrong_unit(cameras)
    assert "a rig of 0.05 to 500 m" in found.text and "viewmend convert" in found.text
    assert find_wrong_unit(cameras, [found]) == ()
    prepare(open_capture(folder), align=False)
    assert caplog.text.count("check metres_per_unit") == 1
    caplog.clear()
    monkeypatch.setattr("viewmend.data.prepare.diagnose", lambda frame, bounds: ())
    prepare(open_capture(folder), align=False)
    assert caplog.text.count("a rig of 0.05 to 500 m") == 1


def delay(*kinds):
    """Repeat two frames of camera 3, so that it is late."""

    def change(folder):
        for kind in kinds:
            files = sorted((folder / kind / names_of(folder)[3]).glob("*.png"))
            data = [file.read_bytes() for file in files]
            for time, file in enumerate(files):
                file.write_bytes(data[max(0, time - 2)])

    return change


def spoil(change, kind="image"):
    return lambda folder: change_images(folder, change, names_of(folder)[3], kind)


def remove_upper_half(mask):
    rows = np.flatnonzero(mask.any(1))
    mask[: (rows[0] + rows[-1]) // 2] = 0
    return mask


def exchange_images(folder):
    first, second = (folder / "image" / names_of(folder)[view] for view in (3, 5))
    first.rename(folder / "aside")
    second.rename(first)
    (folder / "aside").rename(second)


def to_grey(image):
    return image.mean(-1, keepdims=True).repeat(3, -1).astype(np.uint8)


FAULTS = {
    "late": (delay("image", "mask"), "late by about 2 frames"),
    "late images": (delay("image"), "the images of camera '{}': late by about 2 frames"),
    "late masks": (delay("mask"), "camera '{}': late by about 2 frames"),
    "half a mask": (spoil(remove_upper_half, "mask"), "'{}'"),
    "wide mask": (spoil(lambda mask: cv2.dilate(mask, np.ones((13, 13))), "mask"), "'{}'"),
    "negative": (spoil(lambda image: 255 - image), "do not match those of the other cameras"),
    "upside down": (spoil(lambda image: image[::-1]), "fit much better upside down"),
    "mirrored": (spoil(lambda image: image[:, ::-1]), "fit much better mirrored"),
    "blurred": (spoil(lambda image: cv2.GaussianBlur(image, (0, 0), 4)), "'{}'"),
    "grey": (spoil(to_grey), "are grey"),
    "BGR": (spoil(lambda image: image[..., ::-1]), "fit much better with red and blue exchanged"),
    "black": (spoil(lambda image: 0 * image), "is black or of one colour, so it is left out"),
    "white": (spoil(lambda image: 0 * image + 255), "is black or of one colour, so it is left out"),
    "full mask": (spoil(lambda mask: 0 * mask + 255, "mask"), "mask is full, so it is left out"),
    "mask upside down": (spoil(lambda mask: mask[::-1], "mask"), "the mask of camera '{}' is upside down"),
    "exchanged images": (exchange_images, "do not match those of the other cameras"),
}


def warnings_of(path, tmp_path, change=lambda folder: None):
    """The warnings while a changed copy of a capture is prepared.

    What prepares a capture without a warning is left out: shifting images, matching colours, tightening masks.
    """
    folder = shutil.copytree(path, tmp_path / "changed")
    change(folder)
    records = []
    handler = logging.Handler()
    handler.emit = lambda record: records.append(record.getMessage())
    logging.getLogger("viewmend").addHandler(handler)
    try:
        with patch("viewmend.data.prepare.shared_offset", return_value=Alignment((0.0, 0.0), 1.0, 1.0)):
            prepare(open_capture(folder), first=3, match_colours=False, tighten_masks=False)
    finally:
        logging.getLogger("viewmend").removeHandler(handler)
    return records


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_camera_is_named(moving, tmp_path, fault):
    change, words = FAULTS[fault]
    found = warnings_of(moving, tmp_path, change)
    name = names_of(moving)[3]
    assert any(words.format(name) in text and f"'{name}'" in text for text in found), found
    others = [other for other in names_of(moving) if other != name and fault != "exchanged images"]
    assert not any(f"camera '{other}'" in text for other in others for text in found), found


def test_check_names_a_late_camera_as_mend_does(moving, tmp_path, capsys):
    found = warnings_of(moving, tmp_path, delay("image", "mask"))
    assert main(["check", str(tmp_path / "changed"), "--frame", "3"]) == 0
    issue = capsys.readouterr().out.splitlines()[-1].removeprefix("  - ")
    assert "late by about 2 frames" in issue and any(text.endswith(issue) for text in found)
    assert "or raise its offset_ms in cameras.json by 200" in issue


def test_a_late_camera_is_found_between_frames_that_others_lack(moving, tmp_path):
    names = names_of(moving)

    def change(folder):
        delay("image", "mask")(folder)
        for time, absent in ((0, names[:2]), (6, names[2:])):  # no camera has both
            for name in absent:
                sorted((folder / "image" / name).glob("*.png"))[time - 7].unlink()

    assert any(f"camera '{names[3]}': late by" in text for text in warnings_of(moving, tmp_path, change))


def test_frames_that_were_lost_on_the_way_are_found(moving, tmp_path, monkeypatch):
    monkeypatch.setattr(synchronisation, "MAX_DELAY", 2)
    folder = shutil.copytree(moving, tmp_path / "changed")
    name = names_of(folder)[3]
    for kind in ("image", "mask"):
        files = sorted((folder / kind / name).glob("*.png"))
        for time in (3, 4, 5):
            shutil.copy(files[time + 1], files[time])
    capture = open_capture(folder)
    assert find_desynchronised_cameras(capture, capture.read(0)) == ()
    (issue,) = find_desynchronised_cameras(capture, capture.read(0), last=4)
    assert f"camera '{name}': early by about 1 frame" in issue.text
    first, last = capture.frame_ids[0], capture.frame_ids[4]
    assert (
        f"(at frame '{last}', but not at frame '{first}': frames were lost or repeated in between)"
        in issue.text
    )


# EXIF orientation.


def to_jpeg(folder, orientation, crop=96, view=3):
    """Replace the images of a camera by JPEGs with this EXIF orientation."""
    name = names_of(folder)[view]
    for path in folder.glob(f"image/{name}/*.png"):
        _, data = cv2.imencode(".jpg", cv2.imread(str(path))[:crop])
        tiff = (
            b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0"
            + bytes([orientation])
            + b"\0\0\0\0\0\0"
        )
        head = b"\xff\xd8\xff\xe1" + (len(tiff) + 2).to_bytes(2, "big") + tiff
        path.with_suffix(".jpg").write_bytes(head + data.tobytes()[2:])
    edit_description(
        folder, lambda content: content["cameras"][view].update(image=f"image/{name}/{{frame}}.jpg")
    )


@pytest.mark.parametrize(("orientation", "words"), [(3, "turned by 180 degrees"), (2, "mirrored")])
def test_exif_rotation_is_reported_once(folder, caplog, orientation, words):
    to_jpeg(folder, orientation)
    capture = open_capture(folder)
    capture.read(0)
    capture.read(1)
    found = [text for text in caplog.messages if "EXIF" in text]
    assert (
        len(found) == 1
        and words in found[0]
        and f"'{names_of(folder)[3]}'" in found[0]
        and "exiftran" in found[0]
    )


def test_each_exif_rotation_is_reported_with_its_own_cameras(folder, caplog):
    to_jpeg(folder, 3, view=3)
    to_jpeg(folder, 2, view=1)
    open_capture(folder).read(0)
    names = names_of(folder)
    found = [text for text in caplog.messages if "EXIF" in text]
    assert len(found) == 2
    for words, view in (("turned by 180 degrees", 3), ("mirrored", 1)):
        assert [f"(cameras '{names[view]}')" in text for text in found if words in text] == [True]


def test_exif_rotation_explains_a_wrong_size(folder):
    to_jpeg(folder, 6, crop=64)
    message = r"expected 96 x 96 .* got 96 x 64; EXIF says that it should be turned by 90"
    with pytest.raises(ValueError, match=message):
        open_capture(folder).read(0)


# Thresholds and synchronisation.


@pytest.fixture(scope="module")
def ball():
    return photograph(ring(8))


@pytest.mark.parametrize(("cameras", "own", "left_out"), [(8, 0.07, "c1"), (5, 0.07, None), (5, 0.21, "c1")])
def test_rigs_of_few_cameras_keep_one_that_is_a_little_wrong(monkeypatch, ball, cameras, own, left_out):
    removed, outside = torch.zeros(2, cameras)
    removed[1] = own
    found = OthersHulls(torch.zeros(cameras, 1, 1, dtype=torch.bool), removed, outside)
    monkeypatch.setattr(leave_one_out, "leave_one_out", lambda frame, bounds, hull: found)
    (issue,) = find_outlier_by_hull(ball.select(ball.cameras.names[:cameras]), None)
    assert issue.camera == left_out


def test_a_rough_rig_has_no_late_camera_by_chance(moving, monkeypatch):
    capture = open_capture(moving)
    frames, late = [capture.read(time) for time in range(7)], []
    for time, frame in enumerate(frames):
        mask, rgb, earlier = frame.mask.clone(), frame.rgb.clone(), frames[max(0, time - 2)]
        mask[3], rgb[3] = earlier.mask[3], earlier.rgb[3]
        late.append(replace(frame, mask=mask, rgb=rgb))
    assert synchronisation.find_desynchronised_camera(late, 3, capture.bounds)
    unexplained = synchronisation._unexplained
    monkeypatch.setattr(synchronisation, "_unexplained", lambda *args: 0.08 + unexplained(*args))
    assert synchronisation.find_desynchronised_camera(late, 3, capture.bounds) == ()


@pytest.mark.parametrize("count", [1, 3, 4, 8])
def test_inverted_masks_are_fatal_from_half_of_them_on(ball, count):
    mask = ball.mask.clone()
    mask[:count] = 255 - mask[:count]
    frame, names = replace(ball, mask=mask), ball.cameras.names
    issues = find_bad_masks(frame, names, None)
    if count < 4:
        assert [issue.camera for issue in issues] == list(names[:count])
        assert not any(issue.fatal for issue in issues)
    else:
        assert len(issues) == 1 and issues[0].fatal and f"in {count} of 8 cameras" in issues[0].text
        assert [issue.fatal for issue in find_bad_masks(frame, names[2:6], None)] == [True], (
            "half of the inputs"
        )


@pytest.mark.parametrize("held", [False, True])
def test_an_empty_mask_is_named_for_inputs_and_for_held_out_cameras(ball, held):
    mask = ball.mask.clone()
    mask[3] = 0
    names = ball.cameras.names
    inputs = [name for name in names if name != names[3] or not held]
    (issue,) = find_bad_masks(replace(ball, mask=mask), inputs, None)
    assert issue.camera == (None if held else names[3])
    assert f"camera '{names[3]}': its mask is empty" in issue.text
    assert ("scores against it are meaningless" in issue.text) == held
    assert find_bad_masks(replace(ball, mask=0 * mask), inputs, None) == ()


def test_a_camera_whose_mask_is_empty_is_not_called_early(moving):
    capture = open_capture(moving)
    frames = [capture.read(time) for time in range(7)]
    for frame in frames[3:]:
        frame.mask[3] = 0
    assert synchronisation.find_desynchronised_camera(frames, 3, capture.bounds) == ()


def chequered(times, delay=0, view=1, size=64):
    """A square in front of a wall, moving two pixels per frame. The images of one camera are delayed."""
    grid = torch.arange(size) // 4 % 2
    wall = 40 * (grid[:, None] ^ grid[None]).byte()

    def square(time):
        inside = torch.zeros(size, size, dtype=torch.bool)
        inside[20:44, 10 + 2 * time : 26 + 2 * time] = True
        return inside

    frames = []
    for time in times:
        shown = torch.stack([square(time), square(time)])
        masks = 255 * shown.byte()
        shown[view] = square(time - delay)
        rgb = torch.where(shown, 200, wall).byte()[:, None].repeat(1, 3, 1, 1)
        frames.append(MultiViewFrame(ring(2, size), rgb, masks, time))
    return frames


@pytest.mark.parametrize(("delay", "view"), [(-3, 0), (-1, 1), (1, 0), (2, 1), (4, 0)])
def test_delayed_images_are_reported(delay, view):
    (issue,) = check_image_mask_sync(chequered(range(9), delay, view))
    assert f"'c{view}': {describe_delay(delay)} compared with its masks" in issue.text
    assert not issue.camera and not issue.fatal


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_images_in_sync_are_not_reported(count):
    assert check_image_mask_sync(chequered(range(count))) == ()
    assert check_image_mask_sync([BallCapture(ring(4)).read(0)] * count) == ()


def test_sync_needs_four_frames_with_masks_and_tolerates_a_damaged_image():
    assert check_image_mask_sync(chequered(range(3), 1)) == ()
    assert len(check_image_mask_sync(chequered(range(4), 1))) == 1
    assert check_image_mask_sync([replace(frame, mask=None) for frame in chequered(range(9), 2)]) == ()
    frames = chequered(range(5))
    frames[2].rgb[1] //= 8
    assert check_image_mask_sync(frames) == ()


# Agreement of outlines.


@pytest.fixture(scope="module")
def studio():
    return Studio(StudioConfig(seed=10002, cameras=8, frames=1, size_px=192))


@pytest.fixture(scope="module")
def still(studio):
    """The frame of the studio; leave it as it is."""
    return studio.read(0)


def displace(frame, name, step_m):
    """Move the centre of one camera."""
    pose = frame.cameras.camera_from_world.clone()
    pose[frame.cameras.names.index(name), :3, 3] += torch.tensor(step_m)
    return replace(frame, cameras=replace(frame.cameras, camera_from_world=pose))


def roughen(frame, px, seed):
    """Add noise to all principal points."""
    K = frame.cameras.K.clone()
    K[:, :2, 2] += px * torch.randn(len(K), 2, generator=torch.Generator().manual_seed(seed))
    return replace(frame, cameras=replace(frame.cameras, K=K))


@pytest.mark.parametrize("name", ["cam00", "cam03", "cam06"])
@pytest.mark.parametrize("step_m", [(0.06, 0.0, 0.0), (0.0, -0.05, 0.0), (-0.04, 0.04, 0.0)])
def test_a_displaced_camera_is_found_by_outlines(studio, still, name, step_m):
    found = find_outlier_by_outlines(displace(still, name, step_m), studio.bounds)
    assert found is not None and found[0] == (name,) and found[1] > 4


@pytest.mark.parametrize(("seed", "name"), [(1, "cam00"), (2, "cam03")])
def test_a_displaced_camera_is_found_in_a_rough_rig(studio, still, seed, name):
    frame = displace(roughen(still, 0.5, seed), name, (0.04, 0.0, 0.0))
    found = find_outlier_by_outlines(frame, studio.bounds)
    assert found is not None and name in found[0] and 1.5 < found[1] < 2.5


@pytest.mark.parametrize(("px", "seed"), [(0.5, 0), (0.5, 1), (1.0, 2), (1.0, 0)])
def test_a_rough_rig_has_no_outlier(studio, still, px, seed):
    assert find_outlier_by_outlines(roughen(still, px, seed), studio.bounds) is None


@pytest.mark.parametrize("seed", [10002, 10022, 10030])
def test_a_clean_rig_has_no_outlier(seed):
    """In the last two the outline of one camera stands out among small residuals."""
    scene = Studio(StudioConfig(seed=seed, cameras=8, frames=1, size_px=192))
    assert find_outlier_by_outlines(scene.read(0), scene.bounds) is None


def test_single_points_make_no_outlier(studio, still, monkeypatch):
    """Thin parts are missed by single lines of sight; the more others agree, the more one of them matters."""

    def residuals(lines, rig):
        own = (lines.view == 1) & (len(rig.K) == 8)  # only while the camera is there
        return np.where(own & (np.cumsum(own) <= count), 16.0, 0.0)

    monkeypatch.setattr(leave_one_out.LinesOfSight, "least_residuals", residuals)
    count = 3
    assert find_outlier_by_outlines(still, studio.bounds) is None
    count = 12
    assert find_outlier_by_outlines(still, studio.bounds)[0] == ("cam01",)


def test_common_shifts_small_rigs_and_missing_outlines_have_no_outlier(studio, still):
    frame = still
    moved = displace(frame, "cam00", (0.06, 0.0, 0.0))
    for other in (
        replace(frame, cameras=frame.cameras.moved(1.5, -1.0)),
        moved.select(frame.cameras.names[:7:2]),
        replace(moved, mask=torch.zeros_like(frame.mask)),
        replace(moved, mask=torch.full_like(frame.mask, 255)),
        replace(moved, mask=None),
    ):
        assert find_outlier_by_outlines(other, studio.bounds) is None


@pytest.mark.parametrize(
    ("step_m", "words"), [(0.06, "alone removes"), (0.02, "outlines of the other cameras agree")]
)
def test_a_displaced_camera_is_diagnosed_once(studio, still, step_m, words):
    """A large step shows in the hull; a small one only in the outlines."""
    issues = diagnose(displace(still, "cam03", (step_m, 0.0, 0.0)), studio.bounds)
    assert len(issues) == 1 and "'cam03'" in issues[0].text and words in issues[0].text


@pytest.mark.parametrize("held", ["cam2", "cam4"])
def test_three_cameras_of_a_rough_rig_do_not_outvote_one(shared, held):
    capture = open_capture(shared / "captures/utrecht")
    assert not find_odd_images(capture.read(0).without([held]), capture.bounds)


def test_a_late_camera_is_found_beside_frames_without_a_subject(moving, tmp_path):
    """Also where the frame in the middle, and the last, have none."""
    folder = shutil.copytree(moving, tmp_path / "studio")
    name, files = names_of(folder)[3], sorted(folder.glob("mask/*/*.png"))
    own = [file for file in files if file.parent.name == name]
    for late, early in reversed(list(zip(own[2:], own[:-2], strict=True))):
        shutil.copy(early, late)
        shutil.copy(folder / "image" / name / early.name, folder / "image" / name / late.name)
    for file in files:
        if file.stem in {own[3].stem, own[6].stem}:
            cv2.imwrite(str(file), empty(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))
    capture = open_capture(folder)
    [issue] = find_desynchronised_cameras(capture, capture.read(2), 6)
    assert f"camera '{name}': late by about 2 frames" in issue.text


def test_the_first_frame_with_a_subject_is_checked(folder, capsys):
    for file in folder.glob("mask/*/*.png"):
        if file.stem == "000000":
            cv2.imwrite(str(file), np.zeros((96, 96), np.uint8))
    assert main(["check", str(folder)]) == 0
    assert "hull of frame '000001'" in capsys.readouterr().out
    assert main(["check", str(folder), "--frame", "0"]) == 2
    assert "masks of frame '000000', got none; choose another --frame" in capsys.readouterr().err
