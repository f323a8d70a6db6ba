"""Faults that users of other tools reported in public: calibrations and folders that do not match one to one."""

import io
import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from reference import foreign_studios as studios
from reference.ball import BallCapture, ring
from reference.films import picture, write_film
from reference.foreign_formats import write_colmap, write_easymocap
from reference.foreign_images import write_agisoft, write_middlebury
from reference.foreign_rigs import write_opencv, write_qualisys, write_toml
from reference.random_rigs import opencv, random_rig, write_images

from viewmend.data.capture_folder import open_capture
from viewmend.data.checks.colours import find_odd_images
from viewmend.data.checks.leave_one_out import find_cut_off_subject, find_outlier_by_hull
from viewmend.data.errors import CaptureError
from viewmend.data.formats import read_any_calibration
from viewmend.data.formats.files import list_images
from viewmend.data.image_orientation import (
    avif_orientation,
    exif_orientation,
    orientation_of,
    tiff_orientation,
)
from viewmend.data.native_writer import write_capture
from viewmend.geometry.cameras import concatenate_cameras
from viewmend.geometry.proxy import reconstruct
from viewmend.studio.stage import Studio, StudioConfig

EASYMOCAP, QUALISYS, POSE2SIM, OPENCV = "easymocap", "qualisys", "pose2sim", "opencv"


def rig_of(count):
    """A rig whose cameras all have images of 64 x 48 pixels."""
    return [camera | {"width": 64, "height": 48} for camera in random_rig(5, count)]


def write_calibration(folder, rig, format):
    writers = {
        EASYMOCAP: write_easymocap,
        QUALISYS: write_qualisys,
        POSE2SIM: write_toml,
        OPENCV: write_opencv,
    }
    places = {QUALISYS: folder / "session.qca.txt", POSE2SIM: folder / "Calib.toml"}
    folder.mkdir(parents=True, exist_ok=True)
    style = {"style": "files"} if format == OPENCV else {}
    writers[format](places.get(format, folder), rig if format == QUALISYS else opencv(rig), **style)


@pytest.mark.parametrize("format", [EASYMOCAP, QUALISYS, POSE2SIM, OPENCV])
def test_cameras_without_footage_are_left_out_and_named(tmp_path, caplog, format):
    rig = rig_of(5)
    write_calibration(tmp_path, rig, format)
    for camera in rig[:3]:
        write_film(tmp_path / f"videos/{camera['name']}.mp4", [picture(n) for n in range(3)])
    write_film(tmp_path / "videos/witness.mp4", [picture(n) for n in range(3)])
    write_film(tmp_path / "videos/background.mp4", [picture(0)])
    capture = open_capture(tmp_path)
    assert list(capture.cameras.names) == [camera["name"] for camera in rig[:3]]
    assert f"without footage are left out: {rig[3]['name']}, {rig[4]['name']}" in caplog.text
    assert (
        "no calibrated camera is not used: videos/witness.mp4" in caplog.text
        and "background" not in caplog.text
    )


@pytest.mark.parametrize(
    ("chosen", "times", "fps"), [((0, 1), 24, 60), ((2, 3), 12, 30), ((0, 1, 2, 3), 12, 30)]
)
def test_of_fast_and_slow_videos_all_frames_of_the_chosen_are_used(tmp_path, chosen, times, fps):
    rig = rig_of(4)
    write_calibration(tmp_path, rig, POSE2SIM)
    for number, camera in enumerate(rig):
        is_fast = number < 2
        frames = [picture(n) for n in range(24 if is_fast else 12)]
        write_film(tmp_path / f"videos/{camera['name']}.mp4", frames, fps=60 if is_fast else 30)
    capture = open_capture(tmp_path, [rig[number]["name"] for number in chosen])
    assert (len(capture.frame_ids), capture.fps) == (times, fps)
    assert capture.read(times - 1).cameras.names == capture.cameras.names
    assert not any("as listed" in issue.text for issue in capture.issues)


def test_a_name_with_two_dots_keeps_its_suffix(tmp_path):
    cv2.imwrite(str(tmp_path / "frame0001.v2.png"), np.zeros((4, 4, 3), np.uint8))
    images = list_images(tmp_path, "")
    assert [images.pattern.replace("{frame}", frame) for frame in images.frames] == ["frame0001.v2.png"]


DATA_SETS = {
    "actorshq": (studios.write_actorshq, "{}", "4x/rgbs/{}"),
    "genebody": (studios.write_genebody, "{}", "image/{}"),
    "mvhumannet": (studios.write_mvhumannet, "{}", "images/{}"),
    "panoptic": (studios.write_panoptic, "00_{}", "hdImgs/{}"),
    "dna": (studios.write_dna, "{}", None),
}


@pytest.mark.parametrize("name", DATA_SETS)
def test_cameras_of_data_sets_without_images_are_named(tmp_path, caplog, name):
    write, names, images = DATA_SETS[name]
    rig = [camera | {"name": names.format(f"{n + 10}")} for n, camera in enumerate(opencv(rig_of(4)))]
    last = rig[-1]["name"]
    if name == "mvhumannet":
        rig = [camera | {"width": 512, "height": 375, "K": rig[0]["K"]} for camera in rig]
    write(tmp_path, rig, ["0001", "0002"], gaps=[(last, "0001"), (last, "0002")])
    if images is not None and name != "panoptic":
        (tmp_path / images.format("stranger")).mkdir()
    capture = open_capture(tmp_path)
    assert len(capture.cameras) == 3 and last not in capture.cameras.names
    assert f"cameras without footage are left out: {last}" in caplog.text
    if images is not None and name != "panoptic":
        assert re.search("no calibrated camera is not used: .*/stranger", caplog.text)


def test_images_that_middlebury_and_riftcast_do_not_mention_are_named(tmp_path, caplog):
    rig = [camera | {"name": str(n), "image": f"images/{n}.png"} for n, camera in enumerate(rig_of(4))]
    (tmp_path / "middlebury").mkdir()
    write_images(tmp_path / "middlebury", rig)
    write_middlebury(tmp_path / "middlebury/rig_par.txt", opencv(rig)[:3])
    assert len(open_capture(tmp_path / "middlebury").cameras) == 3
    assert "does not mention are ignored: images/3.png" in caplog.text
    studios.write_riftcast(tmp_path / "rift", rig, ["0001"])
    path = tmp_path / "rift/calibration.json"
    path.write_text(json.dumps({"cameras": json.loads(path.read_text())["cameras"][:3]}))
    assert len(open_capture(tmp_path / "rift").cameras) == 3
    assert "does not mention are ignored: frame_0001/rgb/rgb_3.jpeg" in caplog.text


def test_times_of_middlebury_are_frames(tmp_path):
    rig = rig_of(4)
    images = [
        camera | {"image": f"images/{camera['name']}_{time:04d}.png", "name": f"{camera['name']}_{time:04d}"}
        for time in (3, 8)
        for camera in rig
    ]
    write_images(tmp_path, images)
    write_middlebury(tmp_path / "rig_par.txt", opencv(images))
    capture = open_capture(tmp_path)
    assert len(capture.cameras) == 4 and capture.frame_ids == ("0003", "0008") and capture.has_masks
    for camera in rig:
        (center,) = capture.cameras.select([camera["name"]]).centers
        torch.testing.assert_close(
            center.double(), -torch.tensor(camera["R"].T @ camera["t"]), atol=1e-5, rtol=1e-5
        )


def test_footage_next_to_incomplete_files_of_opencv_is_named(tmp_path, caplog):
    rig = rig_of(4)
    write_opencv(tmp_path, opencv(rig))
    for camera in rig:
        write_film(tmp_path / f"{camera['name']}/video.mp4", [picture(n) for n in range(3)])
    path = tmp_path / rig[3]["name"] / "config.xml"
    path.write_text(path.read_text().replace("Rotation", "Unknown"))
    assert len(open_capture(tmp_path).cameras) == 3
    assert f"no calibrated camera is not used: {rig[3]['name']}" in caplog.text


def test_a_second_file_of_a_rig_is_named(tmp_path, caplog):
    rig = rig_of(3)
    for name in ("a.qca.txt", "b.qca.txt"):
        write_qualisys(tmp_path / name, rig)
    for camera in rig:
        write_film(tmp_path / f"videos/{camera['name']}.mp4", [picture(n) for n in range(3)])
    open_capture(tmp_path)
    assert "a.qca.txt: this calibration is used, and not b.qca.txt" in caplog.text


def test_chapters_next_to_a_thumbnail_are_named(tmp_path):
    rig = rig_of(3)
    write_calibration(tmp_path, rig, EASYMOCAP)
    for camera in rig:
        for chapter in (1, 2):
            write_film(tmp_path / f"videos/{camera['name']}/GX0{chapter}0042.MP4", [picture(chapter)])
        Image.new("RGB", (64, 48)).save(tmp_path / f"videos/{camera['name']}/GX010042.jpg")
    with pytest.raises(CaptureError, match=r"expected one video of camera .*GX010042.*GX020042"):
        open_capture(tmp_path)


def test_footage_one_folder_deeper_is_named(tmp_path):
    rig = rig_of(3)
    write_calibration(tmp_path, rig, EASYMOCAP)
    for camera in rig:
        write_film(tmp_path / f"videos/{camera['name']}/100GOPRO/GX010042.MP4", [picture(0)])
    with pytest.raises(CaptureError, match=r"got some in videos/\w+/100GOPRO alone; move them up"):
        open_capture(tmp_path)


def test_a_camera_may_have_its_film_in_a_folder_of_its_own(tmp_path):
    rig = rig_of(4)
    write_calibration(tmp_path, rig, EASYMOCAP)
    films = [f"{camera['name']}.mp4" for camera in rig[:3]] + [f"{rig[3]['name']}/GX010042.MP4"]
    masks = [*films[1:], f"{rig[0]['name']}/mask.mp4"]
    for place, names in (("videos", films), ("masks", masks)):
        for name in names:
            write_film(tmp_path / place / name, [picture(n) for n in range(3)])
    capture = open_capture(tmp_path)
    assert len(capture.cameras) == 4 and capture.has_masks
    write_film(tmp_path / f"videos/{rig[3]['name']}/GX020042.MP4", [picture(3)])
    with pytest.raises(CaptureError, match=rf"one video of camera '{rig[3]['name']}', got 2 .*GX020042"):
        open_capture(tmp_path)


@pytest.mark.parametrize("name", ["{:06d}.png", "{:04d}.png", "mask_{:05d}.png"])
def test_masks_of_films_may_be_numbered_from_1(tmp_path, name):
    rig = rig_of(3)
    write_calibration(tmp_path, rig, EASYMOCAP)
    for camera in rig:
        write_film(tmp_path / f"videos/{camera['name']}.mp4", [picture(n) for n in range(3)])
        (tmp_path / "masks" / camera["name"]).mkdir(parents=True)
        for number in (1, 2, 3):
            mask = np.full(picture(0).shape[:2], 250 + number, np.uint8)
            cv2.imwrite(str(tmp_path / "masks" / camera["name"] / name.format(number)), mask)
    capture = open_capture(tmp_path)
    assert len(capture.frame_ids) == 3 and not capture.gaps
    assert [int(capture.read(time).mask.max()) for time in range(3)] == [251, 252, 253]


@pytest.mark.parametrize("names", ["{}/GX0{}0042.MP4", "{}_GX0{}0042.MP4"])
def test_several_films_of_a_camera_are_named(tmp_path, names):
    rig = rig_of(3)
    write_calibration(tmp_path, rig, EASYMOCAP)
    for camera in rig:
        for chapter in (1, 2):
            write_film(tmp_path / "videos" / names.format(camera["name"], chapter), [picture(chapter)])
    with pytest.raises(
        CaptureError, match=r"expected one video of camera .*GX010042.*GX020042.*join the chapters"
    ):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("suffix", "codec"), [("h264", "libx264"), ("264", "libx264"), ("mxf", "mpeg2video")]
)
def test_films_of_other_recorders_are_opened(tmp_path, suffix, codec):
    rig = rig_of(3)
    write_calibration(tmp_path, rig, EASYMOCAP)
    for camera in rig:
        path = tmp_path / f"videos/{camera['name']}.{suffix}"
        write_film(path, [picture(n) for n in range(4)], codec=codec, fps=25, options={"bf": "0"})
    capture = open_capture(tmp_path)
    assert len(capture.frame_ids) == 4 and capture.read(3).rgb.shape == (3, 3, 48, 64)


def test_films_of_an_unknown_kind_are_named(tmp_path):
    rig = rig_of(3)
    write_calibration(tmp_path, rig, EASYMOCAP)
    (tmp_path / "videos").mkdir()
    for camera in rig:
        (tmp_path / f"videos/{camera['name']}.braw").write_bytes(b"raw")
    with pytest.raises(
        CaptureError, match=rf"unknown kind \(videos/{rig[0]['name']}.braw.*convert them to MP4"
    ):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.remove(c.find("transform")), "not aligned are left out: .*cam"),
        (lambda c: c.set("enabled", "0"), "disabled in Metashape are left out: .*cam"),
        (lambda c: c.set("component_id", "9"), "another component.* are left out: .*cam"),
        (lambda c: [c.set("master_id", "0"), c.remove(c.find("transform"))], "multi-camera system .*: .*cam"),
    ],
)
def test_photos_of_metashape_that_are_not_used_are_named(tmp_path, caplog, change, message):
    rig = rig_of(4)
    write_agisoft(tmp_path / "cameras.xml", rig)
    write_images(tmp_path, rig)
    Image.new("RGB", (9, 9)).save(tmp_path / "images/never.png")
    tree = ET.parse(tmp_path / "cameras.xml")
    change(tree.findall(".//cameras//camera")[2])
    tree.write(tmp_path / "cameras.xml")
    capture = open_capture(tmp_path)
    assert len(capture.cameras) == 3
    (found,) = (r.message for r in caplog.records if "left out" in r.message and rig[1]["name"] in r.message)
    assert re.search(message, found)
    assert "does not mention are ignored: images/never.png" in caplog.text


def edit_agisoft(folder, rig, edit):
    """Write a rig in Metashape's format, and change its XML."""
    write_agisoft(folder / "cameras.xml", rig)
    tree = ET.parse(folder / "cameras.xml")
    edit(tree.getroot())
    tree.write(folder / "cameras.xml")


def test_photos_of_metashape_without_a_calibrated_sensor_are_named(tmp_path, caplog):
    rig = rig_of(4)
    write_images(tmp_path, rig)

    def remove(root, kept):
        sensors = root.findall(".//sensor")
        for sensor in sensors[kept:]:
            for calibration in sensor.findall("calibration"):
                sensor.remove(calibration)

    edit_agisoft(tmp_path, rig, lambda root: remove(root, 3))
    assert len(open_capture(tmp_path).cameras) == 3
    assert f"sensor has no calibration are left out: {rig[3]['name']}" in caplog.text
    edit_agisoft(tmp_path, rig, lambda root: remove(root, 1))
    with pytest.raises(
        CaptureError, match="expected a sensor with a calibration, got none; align the photos"
    ):
        open_capture(tmp_path)


@pytest.mark.parametrize("grouped", [False, True])
def test_photos_of_metashape_with_one_name_in_several_folders(tmp_path, grouped):
    """Metashape's labels are names of files without their folders."""
    rig = rig_of(3)
    write_images(tmp_path, rig, "DSC_7")
    flat = [camera | {"image": "images/DSC_7.png"} for camera in rig]

    def group(root):
        (cameras,) = root.findall(".//cameras")
        (old,) = cameras.findall("group")
        for camera, photo in zip(rig, old.findall("camera[@id]")[1:], strict=False):
            own = ET.SubElement(cameras, "group", label=camera["name"])
            old.remove(photo)
            own.append(photo)

    edit_agisoft(tmp_path, flat, group if grouped else lambda _: None)
    if grouped:
        capture = open_capture(tmp_path)
        names = [name.split("_")[0] for name in capture.cameras.names]
        assert sorted(names) == sorted(camera["name"] for camera in rig)
    else:
        with pytest.raises(
            CaptureError, match=r"one image of the photo 'DSC_7', got images/.*group of the folder's name"
        ):
            open_capture(tmp_path)


def test_a_second_chunk_of_metashape_is_named(tmp_path, caplog):
    rig = rig_of(3)
    write_images(tmp_path, rig)

    def add(root):
        (chunk,) = root.findall("chunk")
        second = ET.fromstring(ET.tostring(chunk))
        second.set("label", "Take 2")
        second.find("cameras/group").remove(second.findall(".//camera[@enabled='true']")[0])
        root.append(second)

    edit_agisoft(tmp_path, rig, add)
    assert len(open_capture(tmp_path).cameras) == 3
    assert "the chunk '1' is used, and not Take 2" in caplog.text


def several_times(rig, layout, shift=0.0):
    """Each camera of a rig at three times, as images of a reconstruction; positions differ by `shift`."""
    rng = np.random.default_rng(1)
    images = []
    for time in (0, 8, 16):
        for camera in rig:
            path = layout.format(camera=camera["name"], time=time)
            t = camera["t"] + camera["R"] @ rng.uniform(-shift, shift, 3)
            images.append(
                camera | {"name": path, "t": t, "image": f"images/{path}.png", "mask": f"masks/{path}.png"}
            )
    return images


def write_flat_images(folder, images):
    for image in images:
        for kind in ("image", "mask"):
            path = folder / image[kind]
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.full((image["height"], image["width"], 3), 200, np.uint8))


@pytest.mark.parametrize(
    "layout",
    ["{camera}/{time:06d}", "{time:04d}/{camera}", "{camera}_{time:03d}", "rig/{camera}/image{time}"],
)
@pytest.mark.parametrize("shift", [0.0, 0.002])
@pytest.mark.parametrize("binary", [False, True])
def test_times_of_colmap_are_frames(tmp_path, layout, shift, binary):
    rig = rig_of(4)
    images = several_times(rig, layout, shift)
    write_flat_images(tmp_path, images)
    write_colmap(tmp_path, opencv(images), binary=binary)
    capture = open_capture(tmp_path)
    assert (
        len(capture.cameras) == 4 and len(capture.frame_ids) == 3 and capture.has_masks and not capture.gaps
    )
    found = dict(zip(capture.cameras.names, capture.cameras.centers.numpy(), strict=True))
    assert found.keys() == {camera["name"] for camera in rig}
    for camera in rig:
        np.testing.assert_allclose(found[camera["name"]], -camera["R"].T @ camera["t"], atol=0.01)


@pytest.mark.parametrize(
    ("layout", "pattern"),
    [("cam{camera:02d}/{time:02d}", "cam00/{frame}.png"), ("cam{camera}_{time}", "cam0_{frame}.png")],
)
def test_a_camera_with_one_image_keeps_its_number(tmp_path, layout, pattern):
    rig = [camera | {"name": number} for camera, number in zip(rig_of(3), (0, 8, 16), strict=True)]
    images = several_times(rig, layout)
    write_flat_images(tmp_path, images)
    write_colmap(tmp_path, opencv([one for number, one in enumerate(images) if number not in (0, 6)]))
    assert len(open_capture(tmp_path).cameras) == 3
    assert (f"images/{pattern}", f"masks/{pattern}") in [
        (camera.image, camera.mask) for camera in read_any_calibration(tmp_path).cameras
    ]


@pytest.mark.parametrize("format", ["colmap", "middlebury", "agisoft"])
def test_an_image_without_mask_is_left_out_if_others_have_one(tmp_path, caplog, format):
    rig = rig_of(4)
    write_images(tmp_path, rig)
    if format == "colmap":
        write_colmap(tmp_path, opencv(rig))
    elif format == "middlebury":
        write_middlebury(tmp_path / "rig_par.txt", opencv(rig))
    else:
        write_agisoft(tmp_path / "cameras.xml", opencv(rig))
    for mask in (tmp_path / "masks").rglob("*.png"):
        mask.unlink()
    with pytest.raises(
        CaptureError, match=r"masks/.*png\.png: .* expected the camera's mask in at least one frame"
    ):
        open_capture(tmp_path)
    for camera in rig[1:]:
        mask = np.full((camera["height"], camera["width"]), 255, np.uint8)
        cv2.imwrite(str(tmp_path / camera["image"].replace("images", "masks", 1)), mask)
    assert len(open_capture(tmp_path).cameras) == 3
    assert "is not used: expected masks, which the other cameras have, got none; add them" in caplog.text


def test_photos_of_none_of_the_moments_are_left_out_and_named(tmp_path, caplog):
    """Photos of the empty room help COLMAP to place a rig that was recorded at several times."""
    rig = rig_of(3)
    images = several_times(rig, "{camera}/{time:06d}")
    more = several_times(random_rig(9, 3), "room/DSC_{camera}")[:3]
    room = [camera | {"width": 64, "height": 48} for camera in more]
    write_flat_images(tmp_path, images + room)
    write_colmap(tmp_path, opencv(images + room), binary=False)
    capture = open_capture(tmp_path)
    assert set(capture.cameras.names) == {camera["name"] for camera in rig} and len(capture.frame_ids) == 3
    assert re.search("none of the rig's moments are left out: images/room/DSC_.*png", caplog.text)


def test_a_rig_of_colmap_that_moves_is_refused(tmp_path):
    rig = rig_of(3)
    images = several_times(rig, "{camera}/{time:06d}", 2.0)
    write_flat_images(tmp_path, images)
    write_colmap(tmp_path, opencv(images), binary=False)
    assert len(open_capture(tmp_path).cameras) == 9
    lines = [f"{n} 1 1 0 0 0 0 0 0 3 CAMERA 1 {n} CAMERA 2 {n + 1} CAMERA 3 {n + 2}" for n in (1, 4, 7)]
    (tmp_path / "sparse/0/frames.txt").write_text("# Frame list\n" + "\n".join(lines))
    with pytest.raises(
        CaptureError, match=r"got 3 frames of a rig, frames\.txt, .*write one model for each frame"
    ):
        open_capture(tmp_path)


@pytest.fixture
def lying(tmp_path):
    """A capture whose images are 40 x 32, with a folder to change."""
    folder = tmp_path / "lying"
    oblong = ring(3).cropped(0, 4, 48, 40)
    write_capture(BallCapture(oblong), folder, images="jpeg")
    return folder


@pytest.mark.parametrize("orientation", [1, 5, 6, 7, 8])
def test_masks_that_follow_exif_are_turned_back(lying, orientation):
    expected = open_capture(lying).read(0).mask
    undone = {5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_270}
    undone |= {7: Image.Transpose.TRANSVERSE, 8: Image.Transpose.ROTATE_90}
    for path in sorted(lying.glob("image/*/*.jpg")):
        image = Image.open(path)
        exif = Image.Exif()
        exif[0x0112] = orientation
        image.save(path, exif=exif, quality=95)
    for path in sorted(lying.glob("mask/*/*.png")) if orientation > 1 else ():
        Image.open(path).transpose(undone[orientation]).save(path)
    assert (open_capture(lying).read(0).mask == expected).all()


@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
def test_tiff_images_are_used_as_stored(lying, orientation):
    expected = open_capture(lying).read(0)
    for path in sorted(lying.glob("image/*/*.jpg")):
        tag = {274: orientation}
        Image.open(path).save(path.with_suffix(".tif"), tiffinfo=tag)
    text = (lying / "cameras.json").read_text()
    (lying / "cameras.json").write_text(text.replace(".jpg", ".tif"))
    found = open_capture(lying).read(0)
    assert (found.rgb == expected.rgb).all() and (found.mask == expected.mask).all()
    orientations = {exif_orientation(path) for path in lying.glob("image/*/*.tif")}
    assert orientations == {orientation_of(orientation)}


@pytest.mark.parametrize("orientation", range(1, 9))
def test_masks_that_follow_the_orientation_of_avif_are_turned_back(lying, orientation):
    """Writers of AVIF store EXIF's orientation as properties of the image."""
    avif = [path.with_suffix(".avif") for path in sorted(lying.glob("image/*/*.jpg"))]
    for path in avif:
        exif = Image.Exif()  # Pillow takes its orientation away
        exif[0x0112] = orientation
        Image.open(path.with_suffix(".jpg")).save(path, exif=exif)
    text = (lying / "cameras.json").read_text()
    (lying / "cameras.json").write_text(text.replace(".jpg", ".avif"))
    expected = open_capture(lying).read(0)
    assert {exif_orientation(path) for path in avif} == {orientation_of(orientation)}

    turned = orientation_of(orientation)
    for path in sorted(lying.glob("mask/*/*.png")) if turned is not None and turned.transposed else ():
        Image.fromarray(turned.apply(np.asarray(Image.open(path)))).save(path)
    found = open_capture(lying).read(0)
    assert (found.rgb == expected.rgb).all() and (found.mask == expected.mask).all()


@pytest.mark.parametrize("end", [11, 100, 180, 247, 252])
def test_a_truncated_avif_has_no_orientation(end):
    file = io.BytesIO()
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (40, 32)).save(file, "AVIF", exif=exif)
    data = file.getvalue()
    assert avif_orientation(data) == orientation_of(6)
    assert avif_orientation(data[:end]) is None


@pytest.mark.parametrize("end", [4, 9, 20])
def test_a_truncated_tiff_has_no_orientation(end):
    data = b"II*\0" + (8).to_bytes(4, "little") + (1).to_bytes(2, "little") + bytes(12)
    assert tiff_orientation(data[:end]) is None


def test_masks_with_exif_of_their_own_are_turned(lying):
    expected = open_capture(lying).read(0).mask
    for path in sorted(lying.glob("mask/*/*.png")):
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.open(path).transpose(Image.Transpose.ROTATE_90).save(path, exif=exif)
    assert (open_capture(lying).read(0).mask == expected).all()


def test_a_mask_that_is_turned_without_exif_is_named(lying):
    for path in sorted(lying.glob("mask/*/*.png")):
        Image.open(path).transpose(Image.Transpose.ROTATE_90).save(path)
    with pytest.raises(CaptureError, match="mask is turned by 90 degrees and the image is not"):
        open_capture(lying).read(0)


def test_cameras_that_see_all_of_the_subject_are_not_blamed_for_borders(tmp_path):
    cameras = ring(8)
    frame = BallCapture(cameras).read(0)
    assert frame.mask is not None
    for narrow in (4, 7):
        parts = [cameras[view].cropped(0, 0, 48, 26 if view < narrow else 48) for view in range(8)]
        mask = frame.mask.clone()
        mask[:narrow, 26:] = 0
        cut = replace(frame, cameras=concatenate_cameras(parts), mask=mask)
        assert [issue for issue in find_outlier_by_hull(cut, None) if issue.camera] == []
        hull = reconstruct(mask, cut.cameras)
        assert narrow == 7 or float(hull.bounds.size_m[1]) > 0.9
        found = find_cut_off_subject(cut)
        assert len(found) == (narrow == 7)
        assert all("cut off by the image border of all cameras but" in issue.text for issue in found)


def cut_off(frame, names):
    """The frame, with images of these cameras that begin and end inside the subject, on the left and below."""
    rgb = torch.zeros_like(frame.rgb)
    mask = torch.zeros_like(frame.mask)
    cameras = []
    for view, name in enumerate(frame.cameras.names):
        inside = frame.mask[view] > 127
        rows = inside.any(1).nonzero()[:, 0]
        columns = inside.any(0).nonzero()[:, 0]
        width, bottom = frame.cameras.size_px[view].tolist()
        left = 0
        if name in names:
            bottom = int(0.35 * rows[0] + 0.65 * rows[-1])
            left = int(0.75 * columns[0] + 0.25 * columns[-1])
        cameras.append(frame.cameras[[view]].cropped(left, 0, width - left, bottom))
        rgb[view, :, :bottom, : width - left] = frame.rgb[view, :, :bottom, left:]
        mask[view, :bottom, : width - left] = frame.mask[view, :bottom, left:]
    return replace(frame, cameras=concatenate_cameras(cameras), rgb=rgb, mask=mask)


def test_colours_are_not_blamed_where_only_a_cut_off_camera_sees_the_same_surface():
    studio = Studio(StudioConfig(seed=6, cameras=8, frames=1, size_px=128))
    frame = cut_off(studio.read(0).without(["cam07"]), ["cam01", "cam02", "cam04", "cam05"])
    assert find_odd_images(frame, studio.bounds) == ()
    for name in ("cam01", "cam03", "cam06"):
        rgb = frame.rgb.clone()
        rgb[frame.cameras.names.index(name)] ^= 255
        issues = find_odd_images(replace(frame, rgb=rgb), studio.bounds)
        assert [issue.odd_image for issue in issues] == [name]


@pytest.mark.parametrize(
    "offset", [(0.0, 0.0, 0.0), (412345.6, 4512345.6, 210.0), (-412345.6, -4512345.6, -210.0)]
)
def test_a_capture_far_from_the_origin_is_computed_near_it(plain, offset):
    before = open_capture(plain.path)
    near = read_any_calibration(plain.path)

    def move(content):
        for camera in content["cameras"]:
            camera["t"] = (np.array(camera["t"]) - np.array(camera["R"]) @ np.array(offset)).tolist()
        if content.get("bounds"):
            content["bounds"] = (np.array(content["bounds"]) + offset).tolist()

    plain.edit(move)
    moved = open_capture(plain.path)
    distances = [torch.cdist(c.cameras.centers, c.cameras.centers) for c in (before, moved)]
    torch.testing.assert_close(*distances, atol=1e-5, rtol=1e-5)
    assert float(moved.cameras.centers.abs().max()) < 1000
    write_capture(moved, plain.path.parent / "written", images="png")
    again = read_any_calibration(plain.path.parent / "written")
    for one, other in zip(near.cameras, again.cameras, strict=True):
        center = -other.R.T @ other.t_m + again.origin_m
        np.testing.assert_allclose(center, -one.R.T @ one.t_m + near.origin_m + np.array(offset), atol=1e-4)


@pytest.mark.parametrize("offset_m", [(4e5, 4.5e6, 200.0), (0.0, 5e3, 0.0)])
def test_cameras_too_far_for_32_bits_are_refused(offset_m):
    cameras = ring(4)
    pose = cameras.camera_from_world.double()
    pose[:, :3, 3] -= pose[:, :3, :3] @ torch.tensor(offset_m, dtype=torch.float64)
    far = replace(cameras, camera_from_world=pose.float())
    with pytest.raises(
        ValueError, match=r"near the world's origin, got a rig of .* subtract the rig's centre"
    ):
        far.check()
