"""Files as other tools and systems write them: what they mean is understood, or refused by its name."""

import json
import re

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from reference.films import write_film
from reference.foreign_formats import write_colmap, write_easymocap, write_transforms
from reference.foreign_rigs import write_opencv, write_toml
from reference.random_rigs import opencv, random_rig, write_images

from viewmend.data.capture_folder import open_capture
from viewmend.data.errors import CaptureError
from viewmend.data.formats import read_any_calibration
from viewmend.data.formats.files import frame_pattern

# What the values of masks mean.


def palette(index, colours):
    image = Image.fromarray(index, "P")
    image.putpalette([*np.ravel(colours), *[0] * (768 - np.size(colours))])
    return image


def written(inside):
    """Mask files' content with this foreground, (height, width) of bool, by kind."""
    label = np.where(inside, np.where(np.arange(inside.shape[1]) % 2, 1, 2), 0).astype(np.uint8)
    several = np.array([[0, 0, 0], [0, 0, 255], [0, 128, 0]], np.uint8)
    return {
        "0 and 1": inside.astype(np.uint8),
        "0 and 128": 128 * inside.astype(np.uint8),
        "indices": label,
        "a palette": palette(label, [[0, 0, 0], [128, 0, 0], [0, 128, 0]]),
        "a palette with white as background": palette(label, [[255, 255, 255], [10, 0, 0], [0, 255, 0]]),
        "a palette of greys": palette((label > 0).astype(np.uint8), [[0, 0, 0], [255, 255, 255]]),
        "a palette with the object in black": palette(label, [[200, 0, 200], [0, 0, 0], [0, 0, 0]]),
        "dark red": (np.array([0, 0, 128]) * inside[..., None]).astype(np.uint8),
        "several colours": several[label],
        "16 bit": 65535 * inside.astype(np.uint16),
        "0 and 1 in 16 bit": inside.astype(np.uint16),
        "indices in 16 bit": np.array([0, 1001, 1002], np.uint16)[label],
        "two levels": Image.fromarray(inside),
        "colours of 16 bit": np.repeat(65535 * inside.astype(np.uint16)[..., None], 3, 2),
        "a palette of 1 bit": palette((label > 0).astype(np.uint8), [[40, 40, 90], [10, 200, 10]]),
        "several colours and nearly opaque alpha": np.dstack(
            [several[label], np.full(inside.shape, 254, np.uint8)]
        ),
        "grey and alpha": Image.fromarray(np.dstack([0 * label + 255, 255 * inside]).astype(np.uint8), "LA"),
    }


@pytest.mark.parametrize("kind", written(np.zeros((1, 1), bool)))
def test_masks_mean_the_same(plain, kind):
    expected = open_capture(plain.path).read(0).mask
    for view, name in enumerate("abcd"):
        file, image = plain.path / f"masks/{name}_000.png", written((expected[view] > 0).numpy())[kind]
        bits = {"bits": 1} if kind == "a palette of 1 bit" else {}
        image.save(file, **bits) if isinstance(image, Image.Image) else cv2.imwrite(str(file), image)
    assert torch.equal(open_capture(plain.path).read(0).mask, expected)


def test_labels_are_mentioned_once_and_faint_masks_are_no_labels(plain, caplog):
    for time in (0, 1):
        for name in "abcd":
            plain.put(
                f"masks/{name}_00{time}.png", written(plain.get(f"masks/{name}_000.png") > 0)["0 and 1"]
            )
    capture = open_capture(plain.path)
    assert (capture.read(0).mask.unique() == capture.read(1).mask.unique()).all()
    assert [record.message for record in caplog.records] == [
        "ball: masks have no values above 1: they are read as labels, with 0 as background"
    ]
    plain.put("masks/b_000.png", np.full((32, 40), 255, np.uint8))
    caplog.clear()
    assert set(open_capture(plain.path).read(0).mask[0].unique().tolist()) == {0, 255}
    assert "masks of a, c, d have no values above 1" in caplog.text
    plain.put("masks/a_000.png", written(plain.get("masks/a_000.png") > 0)["0 and 128"])
    assert set(open_capture(plain.path).read(0).mask[0].unique().tolist()) == {0, 255}
    assert "masks of a, c, d have no values above 128" in caplog.text
    plain.put(
        "masks/a_000.png", np.eye(32, 40, dtype=np.uint8) // np.arange(1, 41, dtype=np.uint8)
    )  # one faint pixel
    assert open_capture(plain.path).read(0).mask[0].max() == 1


def test_noise_of_masks_without_a_subject_is_no_label(plain, rng):
    for name in "abcd":
        noise = torch.randint(0, 6, (32, 40), generator=rng) * (torch.rand(32, 40, generator=rng) < 0.2)
        plain.put(f"masks/{name}_000.png", noise.byte().numpy())
    assert not open_capture(plain.path).read(0).has_subject


def test_labels_survive_jpeg(plain, caplog):
    expected = open_capture(plain.path).read(0).mask
    for view, name in enumerate("abcd"):
        done, data = cv2.imencode(".jpg", written((expected[view] > 0).numpy())["dark red"])
        assert done
        (plain.path / f"masks/{name}_000.png").write_bytes(data.tobytes())
    mask = open_capture(plain.path).read(0).mask
    assert "they are scaled, with 12" in caplog.text or "they are scaled, with 13" in caplog.text
    assert ((mask > 127) == (expected > 127)).float().mean() > 0.99 and mask[
        expected > 0
    ].float().median() > 240


def test_a_coloured_background_is_refused(plain):
    inside = plain.get("masks/a_000.png") > 0
    plain.put("masks/a_000.png", np.where(inside[..., None], [37, 231, 253], [84, 1, 68]).astype(np.uint8))
    with pytest.raises(
        CaptureError,
        match=r"a_000\.png.*expected black as a mask's background, got the colours 253 231 37, 68 1",
    ):
        open_capture(plain.path).read(0)


def blender(folder, pictures):
    """A `transforms_train.json`, of which each image has a name and content; None is missing."""
    frames = []
    for number, (name, picture) in enumerate(pictures.items()):
        if picture is not None:
            cv2.imwrite(str(folder / f"{name}.png"), picture)
        matrix = np.eye(4)
        matrix[2, 3] = number
        frames.append({"file_path": f"./{name}", "transform_matrix": matrix.tolist()})
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))


def test_alpha_of_any_image_counts(tmp_path, caplog):
    cut = np.full((20, 30, 4), 255, np.uint8)
    cut[:10, :, 3] = 0
    opaque = cut[..., :3].copy()
    blender(tmp_path, {"a": None, "b": cut, "c": cut.astype(np.uint16) * 257})
    assert open_capture(tmp_path).read(0).mask.sum().item() == 2 * 300 * 255
    assert "cameras without their image are left out: a" in caplog.text
    for picture, got in (
        (opaque, "got 3 channels"),
        (np.dstack([opaque, opaque[..., 0]]), "got an opaque image"),
    ):
        blender(tmp_path, {"a": picture, "b": cut, "c": cut})
        with pytest.raises(CaptureError, match=f"a.png: camera 'a', frame '0': expected .*alpha.*{got}"):
            open_capture(tmp_path).read(0)


def test_images_without_suffix_may_have_any(tmp_path):
    pictures = {name: np.full((20, 30, 3), 60, np.uint8) for name in "abcd"}
    blender(tmp_path, pictures)
    for name, suffix in (("a", ".jpg"), ("b", ".JPG"), ("c", ".tif")):
        cv2.imwrite(str(tmp_path / f"{name}{suffix}"), pictures[name])
        (tmp_path / f"{name}.png").unlink()
    assert open_capture(tmp_path).read(0).cameras.names == ("a", "b", "c", "d")
    for file in [file for file in tmp_path.iterdir() if file.suffix != ".json"]:
        file.unlink()
    with pytest.raises(
        CaptureError, match=r"expected an image 'a', or this with an image suffix .* got none; add"
    ):
        open_capture(tmp_path)


def test_the_size_of_a_large_tiff_is_at_its_end(tmp_path, rng):
    rig = random_rig(3, 2)
    write_toml(tmp_path / "Calib.toml", opencv([camera | {"width": 700, "height": 600} for camera in rig]))
    for camera in rig:
        (tmp_path / "images" / camera["name"]).mkdir(parents=True)
        picture = torch.randint(0, 256, (600, 700, 3), generator=rng).byte().numpy()
        cv2.imwrite(str(tmp_path / "images" / camera["name"] / "000.tif"), picture)
    assert open_capture(tmp_path).cameras.size_px.tolist() == [[700, 600]] * len(rig)
    (tmp_path / "images" / rig[0]["name"] / "000.tif").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"000\.tif' .* got a file that is no image or is damaged; copy"):
        open_capture(tmp_path)


# COLMAP's models.


@pytest.mark.parametrize("binary", [False, True])
def test_the_largest_model_of_colmap_is_read(tmp_path, binary, caplog):
    rig = random_rig(3, 6)
    write_images(tmp_path, rig)
    write_colmap(tmp_path, rig, binary=binary)
    (tmp_path / "sparse/0").rename(tmp_path / "sparse/2")
    write_colmap(tmp_path, rig[:3], binary=not binary)
    assert len(read_any_calibration(tmp_path).cameras) == 6
    assert not caplog.records
    (tmp_path / "sparse/2").rename(tmp_path / "elsewhere")
    assert len(read_any_calibration(tmp_path).cameras) == 3
    assert all(camera["image"].removeprefix("images/") in caplog.text for camera in rig[3:])


def text_model(folder, change):
    rig = random_rig(4, 3)
    write_images(folder, rig)
    write_colmap(folder, rig, "OPENCV", binary=False)
    for name in ("cameras", "images"):
        file = folder / f"sparse/0/{name}.txt"
        file.write_bytes(change(file.read_bytes()))


@pytest.mark.parametrize(
    "change",
    [
        lambda data: b"\xef\xbb\xbf" + data,
        lambda data: data.replace(b"\n", b"\n\n", 1),
        lambda data: data.replace(b"\n", b"\r\n"),
        lambda data: b"  # indented\n" + data + b"\n\n# the end\n",
        lambda data: data.replace(b".png\n\n", b".png\n1.5 2.5 -1 3 4 17\n"),
        lambda data: data.rstrip(b"\n"),
    ],
)
def test_text_of_colmap_may_have_other_lines(tmp_path, change):
    text_model(tmp_path, change)
    assert len(read_any_calibration(tmp_path).cameras) == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda data: data.replace(b".png\n\n", b".png\n"),
            r"images.txt: expected the points .* in line 3, got '14 ",
        ),
        (
            lambda data: data.replace(b".png\n\n", b".png\n1 2\n"),
            r"images.txt: expected the points .* in line 3, got '1 2",
        ),
        (lambda data: data.replace(b"OPENCV", b"OPENCV one"), r"cameras.txt: expected an id, .* in line 2"),
        (lambda data: data.decode().encode("utf-16"), "expected cameras.txt in UTF-8, got another encoding"),
    ],
)
def test_other_lines_of_colmap_are_named(tmp_path, change, message):
    text_model(tmp_path, change)
    with pytest.raises(CaptureError, match=message):
        read_any_calibration(tmp_path)


# transforms.json.


def films(folder, times=(0, 5, 10), **more):
    """A `transforms.json` of three cameras at three times, `image/c0_0000.png`; `more` is added to the file."""
    rig, frames = random_rig(5, 3), []
    write_transforms(folder, rig)
    entries = json.loads((folder / "transforms.json").read_text())["frames"]
    for time in times:
        for number, entry in enumerate(entries):
            path = f"image\\c{number}_{time:04d}.png"
            (folder / "image").mkdir(exist_ok=True)
            cv2.imwrite(
                str(folder / path.replace("\\", "/")), np.full((entry["h"], entry["w"], 3), time, np.uint8)
            )
            frames.append(entry | {"file_path": path, "mask_path": None, "time": time / 10})
    content = {"frames": frames} | more
    (folder / "transforms.json").write_text(json.dumps(content))
    return content


def test_times_of_transforms_are_frames(tmp_path):
    films(tmp_path)
    capture = open_capture(tmp_path)
    assert capture.cameras.names == ("c0", "c1", "c2") and capture.frame_ids == ("0000", "0005", "0010")
    assert not capture.gaps and capture.read(2).rgb[1, 0, 0, 0] == 10


@pytest.mark.parametrize("shift", [0.0, 1e-4], ids=["the same poses", "poses of each image"])
def test_a_fixed_rig_of_several_times_needs_no_time(tmp_path, shift):
    content = films(tmp_path)
    for number, frame in enumerate(content["frames"]):
        frame.pop("time")
        frame["transform_matrix"][0][3] += shift * (number % 2)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = open_capture(tmp_path)
    assert capture.cameras.names == ("c0", "c1", "c2") and capture.frame_ids == ("0000", "0005", "0010")
    assert capture.read(2).rgb[1, 0, 0, 0] == 10


@pytest.mark.parametrize("timed", [False, True])
def test_masks_of_transforms_have_the_numbers_of_their_images(tmp_path, timed):
    content = films(tmp_path)
    (tmp_path / "mask").mkdir()
    for frame in content["frames"]:
        frame["mask_path"] = frame["file_path"].replace("\\", "/").replace("image", "mask", 1)
        cv2.imwrite(str(tmp_path / frame["mask_path"]), np.full((frame["h"], frame["w"]), 255, np.uint8))
        if not timed:
            frame.pop("time")
    lost = content["frames"][4].pop("mask_path")
    (tmp_path / lost).unlink()
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = open_capture(tmp_path)
    assert capture.has_masks and capture.gaps == (("c1", "0005"),)
    content["frames"][4]["mask_path"] = lost.replace("0005", "5")
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(
        CaptureError, match="expected equal numbers in mask_path" if timed else "numbers of images in"
    ):
        open_capture(tmp_path)


def test_images_that_transforms_do_not_mention_are_named(tmp_path, caplog):
    content = films(tmp_path, times=(0,))
    (tmp_path / "image").rename(tmp_path / "images")
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("image", "images", 1)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    open_capture(tmp_path)
    assert not caplog.messages
    lost = content["frames"].pop()["file_path"].replace("\\", "/")
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    open_capture(tmp_path)
    assert f"images that the calibration does not mention are ignored: {lost}" in caplog.text


def spoil(content, **changes):
    content["frames"][0] |= changes


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: spoil(c, time=None), "expected a 'time' in each frame"),
        (
            lambda c: [f.pop("time") and f.update(depth_file_path="d.png") for f in c["frames"]],
            "got image/c0_0000.png and image/c0_0005.png at the same",
        ),
        (lambda c: spoil(c, file_path="image/other.png"), "expected equal numbers in file_path"),
        (lambda c: c["frames"].pop(0) and c["frames"].pop(2), "only image/c0_0010.png"),
        (lambda c: c.update(rolling_shutter=[0, 0, 0.02, 0]), "got rolling_shutter"),
        (lambda c: c.update(from_na=True), "got from_na"),
        (lambda c: c.update(camera_model="OPENCV_FISHEYE"), "got OPENCV_FISHEYE"),
        (lambda c: spoil(c, camera_model="EQUIRECTANGULAR"), "got EQUIRECTANGULAR"),
        (lambda c: c.update(equirectangular=True, from_mitsuba=True), "got equirectangular, from_mitsuba"),
        (lambda c: spoil(c, transform_matrix_start=[[0]]), "got transform_matrix_start other than"),
        (
            lambda c: [f.update(time=f["time"] + n / 1e4) for n, f in enumerate(c["frames"])],
            "equal 'time' for equal",
        ),
        (
            lambda c: (spoil(c, depth_file_path="d.png"), c.update(depth_unit_scale_factor=1.0)),
            "got a scale of 1",
        ),
    ],
)
def test_keys_that_change_the_meaning_are_not_ignored(tmp_path, change, message):
    content = films(tmp_path)
    change(content)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


def test_unknown_keys_are_mentioned(tmp_path, caplog):
    content = films(tmp_path, aabb_scale=16, white_transparent=True, camera_convention="OpenCV")
    spoil(content, sharpness=3, mask_color=[0, 0, 255])
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    open_capture(tmp_path)
    assert "these keys are not known and have no effect: camera_convention, mask_color" in caplog.text


def test_a_vertical_angle_is_a_focal_length(tmp_path):
    blender(tmp_path, {"a": np.zeros((20, 30, 3), np.uint8), "b": np.zeros((20, 30, 3), np.uint8)})
    file = tmp_path / "transforms_train.json"
    file.write_text(
        file.read_text().replace('"camera_angle_x": 0.8', '"camera_angle_x": 0.8, "camera_angle_y": 0.5')
    )
    cameras = open_capture(tmp_path).cameras
    assert cameras.K[0, 1, 1].item() == pytest.approx(10 / np.tan(0.25))
    assert cameras.K[0, 0].tolist() == pytest.approx([15 / np.tan(0.4), 0, 15]) and cameras.K[0, 1, 2] == 10
    assert cameras.centers[1].tolist() == pytest.approx([0, 0, 1])


# Names of files and folders.


def mocap(folder, ids, places=("images", "masks")):
    """A capture of EasyMocap, whose cameras have images of these frame ids."""
    rig = random_rig(6, len(ids))
    folder.mkdir(exist_ok=True)
    write_easymocap(folder, opencv(rig))
    for camera, own in zip(rig, ids, strict=True):
        for place in places:
            (folder / place / camera["name"]).mkdir(parents=True)
            for name in own:
                image = np.full((camera["height"], camera["width"]), 255, np.uint8)
                cv2.imwrite(str(folder / place / camera["name"] / f"{name}.png"), image)
    return [camera["name"] for camera in rig]


def test_files_of_file_managers_are_not_there(tmp_path):
    names = mocap(tmp_path, [["000", "001"]] * 3)
    for place in (tmp_path, *(tmp_path / kind / name for kind in ("images", "masks") for name in names)):
        for junk in ("._000.png", ".DS_Store", "Thumbs.db", "desktop.ini", "._intri.yml", "notes 1.txt"):
            (place / junk).write_bytes(b"\0\5\x16\7")
    for folder in ("@eaDir", "__MACOSX", ".thumbnails"):
        (tmp_path / "images" / folder).mkdir()
    capture = open_capture(tmp_path)
    assert capture.frame_ids == ("000", "001") and not capture.gaps and len(capture.cameras) == 3


def test_paths_of_windows_are_read(plain):
    plain.edit(lambda d: [c.update(image=c["image"].replace("/", "\\")) for c in d["cameras"]])
    assert not open_capture(plain.path).gaps
    plain.edit(lambda d: d["cameras"][0].update(image="..\\x.png"))
    with pytest.raises(CaptureError, match="expected a path inside the capture folder"):
        open_capture(plain.path)


def test_files_are_found_in_each_unicode_form(plain, tmp_path):
    composed, decomposed = "\u00fc", "u\u0308"
    for folder, place in (("images", composed), ("masks", decomposed)):
        (plain.path / folder).rename(plain.path / f"{folder} {decomposed}")
        for file in sorted((plain.path / f"{folder} {decomposed}").iterdir()):
            file.rename(file.with_name(f"{place} {file.name}"))
    plain.edit(
        lambda d: [
            c.update({k: f"{k}s {composed}/{composed} {c['name']}_{{frame}}.png" for k in ("image", "mask")})
            for c in d["cameras"]
        ]
    )
    capture = open_capture(plain.path)
    assert not capture.gaps and capture.read(1).mask is not None
    plain.edit(lambda d: d["cameras"][1].update(image=f"{composed * 300}.png"))
    with pytest.raises(CaptureError, match="expected the camera's image in at least one frame"):
        open_capture(plain.path)
    blender(tmp_path, dict.fromkeys((f"a {decomposed}", f"b {decomposed}"), np.zeros((20, 30, 3), np.uint8)))
    blender(tmp_path, dict.fromkeys((f"a {composed}", f"b {composed}")))
    assert open_capture(tmp_path).cameras.names == (f"a {decomposed}", f"b {decomposed}")


def test_images_named_by_clocks_are_refused(tmp_path):
    names = mocap(
        tmp_path, [[f"{1700000000000 + 33 * time + camera}" for time in range(4)] for camera in range(4)]
    )
    with pytest.raises(
        CaptureError, match=f"expected the same frame ids .* 1700000000001 of {names[1]}.* rename"
    ):
        open_capture(tmp_path)


@pytest.mark.parametrize("name", ["000{}_cam{}", "cam{1}", "IMG_04{1}{1}", "0001"])
def test_a_single_image_of_each_camera_is_one_moment(tmp_path, caplog, name):
    ids = [[name.format(1, camera)] for camera in range(1, 5)]
    cameras = mocap(tmp_path, ids)
    capture = open_capture(tmp_path)
    assert len(capture.frame_ids) == 1 and not capture.gaps and capture.has_masks
    assert capture.read(0).cameras.names == tuple(cameras) and bool(
        (capture.read(0).mask[:, 0, 0] == 255).all()
    )
    said = f"names differ: images/{cameras[0]}/{ids[0][0]}.png, images/{cameras[1]}/{ids[1][0]}.png"
    assert (said in caplog.text) == (name != "0001")


def test_masks_may_have_other_names_than_single_images(tmp_path):
    names = mocap(tmp_path, [["0001"]] * 3)
    for number, name in enumerate(names):
        (tmp_path / f"masks/{name}/0001.png").rename(tmp_path / f"masks/{name}/mask_{number}.png")
    capture = open_capture(tmp_path)
    assert capture.frame_ids == ("0001",) and not capture.gaps and capture.has_masks


@pytest.mark.parametrize(
    ("ids", "got"),
    [
        ([["0001", "0002"]] * 3 + [["1", "2"]], r"for {3} \(such as 0001 of {0}, 1 of {3}\)"),
        ([["451", "452"], ["461", "462"], ["471", "472"]], "for {0}, {1}, {2} "),
        ([["1"], ["1"], ["1", "2", "3"]], r"for {2} \(such as 1 of {0}, 2 of {2}\)"),
    ],
)
def test_short_footage_with_other_ids_is_refused(tmp_path, ids, got):
    names = mocap(tmp_path, ids)
    with pytest.raises(
        CaptureError, match=f"expected the same frame ids .* got others {got.format(*names)}.*rename"
    ):
        open_capture(tmp_path)


def test_masks_with_other_ids_are_refused_and_further_masks_are_not_used(tmp_path):
    names = mocap(tmp_path / "a", [["1", "2"]] * 3)
    for name in names:
        for number in (1, 2):
            (tmp_path / f"a/masks/{name}/{number}.png").rename(tmp_path / f"a/masks/{name}/00{number}.png")
    with pytest.raises(
        CaptureError, match=rf"{names[2]} \(masks\) \(such as 1 of {names[0]}, 001 of {names[0]} \(m"
    ):
        open_capture(tmp_path / "a")
    names = mocap(tmp_path / "b", [["1", "2", "3", "4", "5"]] * 3)
    for name in names:
        for number in (1, 3, 4, 5):
            (tmp_path / f"b/images/{name}/{number}.png").unlink()
    capture = open_capture(tmp_path / "b")
    assert capture.frame_ids == ("2",) and not capture.gaps


def test_cameras_of_short_footage_may_miss_images(tmp_path):
    names = mocap(tmp_path, [["1", "2"], ["1"], ["2"], ["1", "2"]])
    assert open_capture(tmp_path).gaps == ((names[1], "2"), (names[2], "1"))


def test_numbers_that_begin_elsewhere_are_mentioned(tmp_path, caplog):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    names = mocap(tmp_path / "a", [["0", "1", "2"], ["1", "2", "3"], ["0", "1", "2"], ["0", "2"]])
    open_capture(tmp_path / "a")
    assert f"begin at 0, but at 1 for {names[1]}, {names[1]} (masks); if" in caplog.text
    caplog.clear()
    mocap(
        tmp_path / "b", [["0", "1", "2", "3"], ["1", "2", "3"], ["0", "1", "2", "3"]]
    )  # the first image is missing
    open_capture(tmp_path / "b")
    assert not caplog.records


def test_images_with_other_names_are_mentioned(tmp_path, caplog):
    names = mocap(tmp_path, [["preview", "0001", "0002", "0003", "0001 (1)"]] * 3)
    assert open_capture(tmp_path).frame_ids == ("0001", "0002", "0003")
    (said,) = [record.message for record in caplog.records]
    assert (
        f"images of {names[0]}: 2 of 5, such as 0001 (1).png, are ignored, as their names follow another"
        in said
    )


@pytest.mark.parametrize(
    "clock",
    ["{second}.{milli:03d}", "frame_{time:06d}_{second}{milli:03d}", "2024-05-01T12-30-{second}.{milli:03d}"],
)
def test_names_with_several_numbers_are_matched_as_a_whole(tmp_path, clock):
    """Such as clocks across a second, and numbers with a clock; those of each camera's own are refused."""
    moments = [(time, 20 + (930 + 33 * time) // 1000, (930 + 33 * time) % 1000) for time in range(4)]
    ids = [
        [clock.format(time=t, second=s, milli=m + 9 * camera) for t, s, m in moments] for camera in range(3)
    ]
    mocap(tmp_path / "equal", ids[:1] * 3)
    capture = open_capture(tmp_path / "equal")
    assert (
        len(capture.frame_ids) == 4
        and not capture.gaps
        and list(capture.frame_ids) == sorted(capture.frame_ids)
    )
    mocap(tmp_path / "own", ids)
    with pytest.raises(CaptureError, match="expected the same frame ids in the names of all cameras' images"):
        open_capture(tmp_path / "own")


def test_captures_inside_the_folder_are_named(plain, tmp_path):
    mocap(tmp_path / "take_1", [["1"]] * 2)
    (tmp_path / "notes").mkdir()
    for format, takes in ((None, "ball, take_1"), ("plain", "ball"), ("easymocap", "take_1")):
        first = tmp_path / takes.split(",")[0]
        with pytest.raises(
            CaptureError, match=rf"got a folder of captures \({takes}\); open one, such as {first}"
        ):
            open_capture(tmp_path, format=format)
    with pytest.raises(CaptureError, match="the folder has neither it nor another format's files"):
        open_capture(tmp_path / "notes")
    with pytest.raises(CaptureError, match="expected a capture of format 'colmap', got none of its files"):
        open_capture(tmp_path, format="colmap")


# Folders of tools.


def rig_with_films(folder, name):
    """A rig of three cameras with a film of each in a folder."""
    rig = [
        camera | {"width": 64, "height": 48, "name": f"cam{n}"} for n, camera in enumerate(random_rig(7, 3))
    ]
    for number in range(3):
        write_film(folder / f"{name.format(number)}.mp4", [np.full((48, 64, 3), 9, np.uint8)] * 3)
    return opencv(rig)


@pytest.mark.parametrize("calibration", ["Calibration", "../calibration"])
def test_a_trial_of_pose2sim_is_opened_and_its_session_refused(tmp_path, calibration):
    session = tmp_path / "participant/S01"
    rig_with_films(session / "Trial_2/videos", "cam{}")
    rig = rig_with_films(session / "Trial_1/videos", "cam{}")
    write_toml(session / calibration / "Calib_scene.toml", rig)
    (session / "Config.toml").write_text("[project]\nframe_rate = 60\n")
    capture = open_capture(session / "Trial_1")
    assert len(capture.cameras) == len(capture.frame_ids) == 3 and capture.metres_per_unit == 1
    if calibration == "Calibration":
        with pytest.raises(CaptureError, match="got a folder with Trial_1, Trial_2; open one of these"):
            open_capture(session)
        (session / "Day_1").mkdir()
        for trial in ("Trial_1", "Trial_2"):
            (session / trial).rename(session / "Day_1" / trial)
        with pytest.raises(
            CaptureError, match="got a folder with Day_1/Trial_1, Day_1/Trial_2; open one of these"
        ):
            open_capture(session)


def test_a_recording_of_freemocap_is_opened(tmp_path):
    rig = rig_with_films(tmp_path / "synchronized_videos", "Camera_{:03d}_synchronized")
    rig_with_films(tmp_path / "annotated_videos", "Camera_{:03d}_synchronized_mediapipe")
    (tmp_path / "output_data").mkdir()
    write_toml(tmp_path / "recording_camera_calibration.toml", rig, "aniposelib")
    capture = open_capture(tmp_path)
    assert capture.metres_per_unit == 0.001 and len(capture.cameras) == len(capture.frame_ids) == 3


def test_a_pattern_has_all_digits_of_the_frame():
    assert frame_pattern(["a/0001.png", "a/0010.png"]) == ("a/{frame}.png", ("0001", "0010"))
    assert frame_pattern(["t0/c1.png", "t16/c1.png"]) == ("t{frame}/c1.png", ("0", "16"))
    for paths in (["a/1.png", "b/2.png"], ["a1/1.png", "a2/2.png"]):
        with pytest.raises(ValueError, match="expected paths that differ in a number"):
            frame_pattern(paths)


def test_a_size_of_minus_one_is_unknown_to_easymocap(tmp_path):
    names = mocap(tmp_path, [["000"]] * 3)
    file = tmp_path / "intri.yml"
    file.write_text(re.sub(r"([HW]_\w+:) \d+", r"\1 -1.", file.read_text()))
    assert open_capture(tmp_path).cameras.names == tuple(names)


def test_a_fisheye_lens_of_opencv_is_refused(tmp_path):
    rig = random_rig(5, 3)
    write_images(tmp_path, rig)
    write_opencv(tmp_path, opencv(rig), style="files")
    for camera in rig:
        place = tmp_path / "images" / camera["name"]
        place.mkdir()
        (tmp_path / camera["image"]).rename(place / "000.png")
    for file in sorted((tmp_path / "masks").rglob("*.png")):
        file.unlink()
    (tmp_path / "masks").rmdir()
    for file in (tmp_path / "calib").iterdir():
        file.write_text(file.read_text() + "fisheye_model: 1\n")
    (tmp_path / "calib" / "large.xml").write_bytes(b"<opencv>" + b" " * 2**21)
    with pytest.raises(CaptureError, match="got fisheye_model; undistort the images first"):
        open_capture(tmp_path)


def test_names_of_colmap_are_in_utf8(tmp_path):
    rig = random_rig(5, 3)
    write_colmap(tmp_path, opencv(rig))
    file = tmp_path / "sparse/0/images.bin"
    name = rig[0]["image"].removeprefix("images/").encode()
    file.write_bytes(file.read_bytes().replace(name, b"\xe4" + name[1:]))
    with pytest.raises(CaptureError, match=r"expected the names in images\.bin in UTF-8"):
        open_capture(tmp_path)
