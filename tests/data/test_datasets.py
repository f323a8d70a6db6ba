"""Folders of published data sets: random rigs, frames and gaps round-trip, with pixels and masks."""

import json
import pickle
import tempfile
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import foreign_studios as studios
from reference.random_rigs import (
    COUNTS,
    SEEDS,
    TAKES,
    assert_same,
    assert_take,
    named,
    opencv,
    random_rig,
    random_take,
    write_images,
)

from viewmend.data.capture_folder import open_capture
from viewmend.data.containers import names_in, read_bytes
from viewmend.data.errors import CaptureError
from viewmend.data.formats import read_any_calibration
from viewmend.scenes.capture_scenes import capture_set

META = """{ // comments are allowed
 "type": "VCI", "version": "2.1.0",
 "dataset": {"frame_count": 2, "start_frame": 1, "path": "data", "to_world": [%s], "note": "a // b"},
 "volume": {"position": [0.0, 1.5, 0.0], "scale": 1.5} // metres
}"""


@contextmanager
def random_folder(seed, count, name, frame, distorted=5):
    """A new folder, a random rig whose cameras have such names, and frames and gaps of a take with such ids."""
    rig = named(random_rig(seed, count, distorted), name)
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder), rig, *random_take(seed, rig, frame)


def check_rig(folder, rig, frames, gaps, ids=None):
    capture = open_capture(folder)
    assert_same(capture, rig)
    assert_take(capture, rig, frames, gaps, ids)
    return capture


@TAKES
@given(SEEDS, COUNTS, st.booleans(), st.booleans(), st.sampled_from([2, 3, 4, 5]))
def test_zju_mocap_round_trip(seed, count, stamps, arrays, protocol):
    with random_folder(seed, count, "Camera_B{}", "{:06d}") as (folder, rig, frames, gaps):
        studios.write_zju(folder, opencv(rig), frames, gaps, stamps, arrays, protocol)
        ids = [f"{f}_2019-08-23_16-08-{int(f[-4:]):02d}.592" for f in frames] if stamps else frames
        check_rig(folder, rig, frames, gaps, ids if len(frames) > 1 else ["0"])


@TAKES
@given(SEEDS, COUNTS, st.sampled_from([2, 4, 5]))
def test_genebody_round_trip(seed, count, protocol):
    with random_folder(seed, count, "{:02d}", "{:04d}") as (folder, rig, frames, gaps):
        studios.write_genebody(folder, opencv(rig), frames, gaps, protocol)
        check_rig(folder, rig, frames, gaps)


@TAKES
@given(
    SEEDS, COUNTS, st.sampled_from([(120 / 65, (4096, 3000), (512, 375)), (2.5, (2448, 2048), (153, 128))])
)
def test_mvhumannet_round_trip(seed, count, sizes):
    scale, full, size = sizes
    with random_folder(seed, count, "CC32871A0{:02d}", "{:04d}", 0) as (folder, rig, frames, gaps):
        rig = [c | {"width": size[0], "height": size[1], "K": rig[0]["K"]} for c in rig]
        studios.write_mvhumannet(folder, rig, frames, gaps, scale, full)
        check_rig(folder, rig, frames, gaps)


@TAKES
@given(SEEDS, COUNTS, st.sampled_from(["1x", "4x"]), st.booleans())
def test_actorshq_round_trip(seed, count, scale, inside):
    boxes = np.sort(np.random.default_rng(seed).uniform(-2, 2, (3, 2, 3)), 1)
    with random_folder(seed, count, "Cam{:03d}", "{:06d}", 0) as (folder, rig, frames, gaps):
        studios.write_actorshq(folder, rig, frames, gaps, scale, boxes.reshape(3, 6))
        capture = check_rig(folder / scale if inside else folder, rig, frames, gaps)
        np.testing.assert_allclose(capture.bounds.low, boxes[:, 0].min(0), rtol=1e-6)
        np.testing.assert_allclose(capture.bounds.high, boxes[:, 1].max(0), rtol=1e-6)


@TAKES
@given(SEEDS, COUNTS, st.sampled_from([("hd", "00_{:02d}", 29.97), ("vga", "01_{:02d}", 25.0)]))
def test_panoptic_round_trip(seed, count, type_):
    kind, pattern, fps = type_
    with random_folder(seed, count, pattern, "{:08d}") as (folder, rig, frames, gaps):
        studios.write_panoptic(folder, opencv(rig), frames, gaps, kind)
        assert check_rig(folder, rig, frames, gaps).fps == fps


@TAKES
@given(SEEDS, COUNTS, st.booleans())
def test_easyvolcap_round_trip(seed, count, quoted):
    bounds = [[-1.0, -2.0, 0.0], [1.0, 2.0, 3.5]]
    with random_folder(seed, count, "{:02d}", "{:06d}") as (folder, rig, frames, gaps):
        studios.write_easyvolcap(folder, opencv(rig), frames, gaps, bounds, quoted)
        assert check_rig(folder, rig, frames, gaps).bounds.high.tolist() == bounds[1]


@TAKES
@given(SEEDS, COUNTS, st.booleans(), st.booleans())
def test_dna_rendering_round_trip(seed, count, apart, opened_as_file):
    with random_folder(seed, count, "{:02d}", "{}") as (folder, rig, frames, gaps):
        main = studios.write_dna(folder, opencv(rig), frames, gaps, apart)
        check_rig(main if opened_as_file else folder, rig, frames, gaps)


@TAKES
@given(SEEDS, COUNTS)
def test_riftcast_round_trip(seed, count):
    with random_folder(seed, count, "{}", "{:05d}", 0) as (folder, rig, frames, gaps):
        studios.write_riftcast(folder, rig, frames, gaps)
        check_rig(folder, rig, frames, gaps)


def test_only_cameras_with_footage_are_used(tmp_path):
    rig = named(random_rig(3, 4), "00_{:02d}")
    studios.write_panoptic(tmp_path, rig[:3], ["00000000"])
    file = tmp_path / "calibration_160422_ultimatum1.json"
    content = json.loads(file.read_text())
    content["cameras"].insert(1, content["cameras"][0] | {"name": "00_99"})
    file.write_text(json.dumps(content))
    assert open_capture(tmp_path).cameras.names == tuple(camera["name"] for camera in rig[:3])


def test_label_masks_are_background_only_at_0(tmp_path):
    rig = named([camera | {"dist": np.zeros(5)} for camera in random_rig(3, 2)], "Camera_B{}")
    studios.write_zju(tmp_path, rig, ["000000"])
    assert sorted(open_capture(tmp_path).read(0).mask.unique().tolist()) == [0, 255]


def test_a_real_rig_of_mvhumannet(shared, tmp_path):
    """Its 48 cameras are on a ring of about 2 m."""
    rigs = shared / "rigs"
    poses = json.loads((rigs / "mvhumannet_camera_extrinsics.json").read_text())
    names = [key.rpartition("_")[2].rpartition(".")[0] for key in poses]
    write_images(tmp_path, [{"name": name, "width": 512, "height": 375} for name in names], "0005")
    (tmp_path / "masks").rename(tmp_path / "fmask")
    for part in ("extrinsics", "intrinsics"):
        (tmp_path / f"camera_{part}.json").write_text((rigs / f"mvhumannet_camera_{part}.json").read_text())
    (tmp_path / "camera_scale.pkl").write_bytes(pickle.dumps(120 / 65))
    cameras = open_capture(tmp_path).cameras
    centers = np.array([pose["camera_pos"] for pose in poses.values()]) * (120 / 65 / 1000)
    np.testing.assert_allclose(cameras.centers, centers, atol=2e-4)
    assert cameras.K[0, :2, 2].tolist() == [256.0, 187.5]


def test_a_real_rig_of_genebody(shared, tmp_path):
    """Its 40 cameras look inwards from about 3 m."""
    content = json.loads((shared / "rigs/genebody_style_rig.json").read_text())
    rig = [{"name": name, "width": 64, "height": 48} for name in content]
    studios.write_take(tmp_path, rig, ["0001"], (), "image/{c}/{f}.jpg", "mask/{c}/mask{f}.png")
    cams = {name: {key: np.array(value) for key, value in cam.items()} for name, cam in content.items()}
    studios.save_object(tmp_path / "annots.npy", {"cams": cams}, 2)
    cameras = open_capture(tmp_path).cameras
    forward, inwards = cameras.world_from_camera[:, :3, 2], cameras.centers.mean(0) - cameras.centers
    distance = inwards.norm(dim=-1)
    assert len(cameras) == 40 and bool((distance > 2).all())
    assert bool(((forward * inwards).sum(-1) / distance > 0.8).all())


WRITERS = {
    "zju": (studios.write_zju, "00_{:02d}"),
    "genebody": (studios.write_genebody, "00_{:02d}"),
    "mvhumannet": (studios.write_mvhumannet, "CC32871A0{:02d}"),
    "actorshq": (studios.write_actorshq, "Cam{:03d}"),
    "panoptic": (studios.write_panoptic, "00_{:02d}"),
    "easyvolcap": (studios.write_easyvolcap, "00_{:02d}"),
}
PANOPTIC = "calibration_160422_ultimatum1.json"


@pytest.mark.parametrize(
    ("name", "file", "old", "new", "message"),
    [
        ("zju", "annots.npy", b"cams", b"camz", "expected lists K, D, R and T in 'cams'"),
        ("zju", "annots.npy", b"numpy\ndtype", b"posix\nsystem", "got posix.system; is it the right file"),
        ("genebody", "annots.npy", b"c2w", b"c2x", "expected 16 numbers, got NoneType"),
        ("mvhumannet", "camera_scale.pkl", b"G", b"Z", "expected numbers, strings, lists, dicts and arrays"),
        ("mvhumannet", "camera_extrinsics.json", b"translation", b"shift", "translation"),
        ("actorshq", "4x/calibration.csv", b",fx,", b",gx,", "expected columns name,w,h,rx"),
        ("actorshq", "4x/calibration.csv", b"Cam", b"../Cam", "expected rows of cameras or frames"),
        ("panoptic", PANOPTIC, b'"hd"', b'"dome"', "type: expected another value"),
        ("panoptic", PANOPTIC, b'"t": [[', b'"t": [[{}, ', "t.0.: expected a list of length"),
        ("easyvolcap", "intri.yml", b"K_", b"L_", "expected cameras whose names are valid folder names"),
    ],
)
def test_invalid_files_are_rejected(tmp_path, name, file, old, new, message):
    write, pattern = WRITERS[name]
    rig = named([c | {"width": 512, "height": 375} for c in random_rig(3, 3)], pattern)
    write(tmp_path, rig, ["000000"], **({"protocol": 2} if name in ("zju", "genebody") else {}))
    open_capture(tmp_path)
    data = (tmp_path / file).read_bytes()
    assert old in data
    (tmp_path / file).write_bytes(data.replace(old, new))
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


def test_moving_cameras_and_several_scales_are_rejected(tmp_path):
    rig = named(random_rig(3, 2, 0), "Cam{:03d}")
    for scale in ("1x", "2x"):
        studios.write_actorshq(tmp_path, rig, ["000000"], scale=scale)
    with pytest.raises(CaptureError, match="expected a folder with one scale, got 1x, 2x"):
        open_capture(tmp_path)
    studios.write_easyvolcap(tmp_path / "b" / "cameras" / "00", rig, ["000000"])
    with pytest.raises(CaptureError, match="expected static cameras"):
        read_any_calibration(tmp_path / "b")


# DNA-Rendering and HDF5 files.


def test_dna_rendering_has_colour_corrections(tmp_path):
    """A value x becomes a x^2 + b x + c, clipped to 0..255; coefficients are in the order blue, green, red."""
    rig = named([camera | {"dist": np.zeros(5)} for camera in random_rig(3, 2)], "{:02d}")
    blue, green, red = [0.001, 0.5, 3.0], [0.0, 1.0, 0.0], [0.0, 9.0, 0.0]
    studios.write_dna(tmp_path, rig, ["0"], colours=[np.array([blue, green, red])] * 2)
    rgb = open_capture(tmp_path).read(0).rgb[0, :, 0, 0].tolist()
    assert rgb == [255, 60, round(0.001 * 3600 + 30 + 3)]


def test_one_of_several_sequences_is_opened_by_its_file(tmp_path):
    rig = named(random_rig(3, 3), "{:02d}")
    for name in ("0012_11", "0013_01"):
        main = studios.write_dna(tmp_path, rig, ["0", "1"], apart=True, name=name)
    with pytest.raises(
        CaptureError, match=r"expected one sequence, got 2 in .*; open one of them, e.g. 0012_11.smc"
    ):
        open_capture(tmp_path)
    capture = open_capture(main)
    assert capture.name == "0013_01" and len(capture_set(main, frames=1)) == 3
    annotations = tmp_path / "part1_annotations/0013_01_annots.smc"
    assert open_capture(annotations).cameras.names == capture.cameras.names
    annotations.unlink()
    with pytest.raises(
        CaptureError, match=r"expected 0013_01_annots\.smc next to it or in the folder of annotations"
    ):
        open_capture(main)


@pytest.mark.parametrize("how", ["link", "external"])
def test_hdf5_files_do_not_lead_to_other_files(tmp_path, how):
    rig = named(random_rig(3, 2), "{:02d}")
    main = studios.write_dna(tmp_path, rig, ["0", "1"])
    (tmp_path / "secret").write_bytes(b"secret" * 100)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["image"] = np.zeros(10, np.uint8)
    number = int(rig[0]["name"])
    with h5py.File(main, "a") as file:
        color = file[f"{'Camera_5mp' if number < 48 else 'Camera_12mp'}/{number}/color"]
        del color["1"]
        if how == "link":
            color["1"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "image")
        else:
            color.create_dataset("1", (600,), np.uint8, external=[(str(tmp_path / "secret"), 0, 600)])
    with pytest.raises(
        CaptureError, match=r"expected a readable file, got: (no|its data are stored in another file)"
    ):
        open_capture(tmp_path).read(1)


def test_hdf5_members_that_are_not_images_are_ignored_or_rejected(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file[b"\x82"], file["7"] = np.zeros(3, np.uint8), np.zeros(3, np.uint8)
        file["a.png"] = np.dtype("uint8")
    assert names_in(tmp_path / "a.h5") == {"7", "a.png"}
    with pytest.raises(ValueError, match="expected the bytes of an image"):
        read_bytes(tmp_path / "a.h5" / "a.png")


def test_plain_captures_may_have_images_in_hdf5_files(tmp_path):
    rig = named([camera | {"dist": np.zeros(5)} for camera in random_rig(3, 2)], "{:02d}")
    main = studios.write_dna(tmp_path, rig, ["0"])
    cameras = []
    for camera in rig:
        number = int(camera["name"])
        path = f"{main.name}/{'Camera_5mp' if number < 48 else 'Camera_12mp'}/{number}/color/{{frame}}"
        entry = {key: np.asarray(camera[key]).tolist() for key in ("K", "R", "t")}
        cameras.append(entry | {key: camera[key] for key in ("name", "width", "height")} | {"image": path})
    content = {"format": "plain-capture/1", "frames": ["0"], "cameras": cameras}
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    assert int(open_capture(tmp_path).read(0).rgb[1, 0, 0, 0]) == 80


# RIFTCast's meta file.


def test_the_meta_file_of_riftcast_has_bounds_up_and_frames(tmp_path):
    rig = named(random_rig(3, 3, 0), "{}")
    to_world = np.eye(4)
    to_world[:3, 3] = 1, 2, 3
    text = META % ", ".join(map(str, to_world.ravel().tolist()))
    studios.write_riftcast(tmp_path / "data", rig, [f"{n:05d}" for n in range(4)], (), text)
    (tmp_path / "start.json").write_text(text)
    for path in (tmp_path / "data", tmp_path / "data/meta.json", tmp_path / "start.json"):
        capture = open_capture(path)
        assert capture.frame_ids == ("00001", "00002") and capture.up.tolist() == [0, -1, 0]
        # The corners of the cube, (-1.5, 0, -1.5) and (1.5, 3, 1.5), moved by to_world, then with y and z negated.
        assert capture.bounds.low.tolist() == [-0.5, -5, -4.5] and capture.bounds.high.tolist() == [
            2.5,
            -2,
            -1.5,
        ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"path": "data"', '"flip_masks": false', "expected flip_images and flip_masks"),
        ("2.1.0", "3.0.0", "expected version 2 of RIFTCast's meta file, got '3.0.0'"),
    ],
)
def test_unsupported_meta_files_of_riftcast_are_rejected(tmp_path, old, new, message):
    text = META % ", ".join("1" if n % 5 == 0 else "0" for n in range(16))
    studios.write_riftcast(tmp_path, named(random_rig(3, 2, 0), "{}"), ["00001"], (), text.replace(old, new))
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)
