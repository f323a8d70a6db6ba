"""Published data sets' folders, there and back: random rigs, ids and gaps; pixels and masks, too."""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference.foreign_studios import (
    write_actorshq,
    write_easyvolcap,
    write_genebody,
    write_mvhumannet,
    write_panoptic,
    write_zju,
)
from reference.random_rigs import COUNTS, SEEDS, TAKES, assert_same, assert_take, named, opencv, random_rig, random_take

from viewmend.capture.errors import CaptureError
from viewmend.capture.formats.recognition import read_any_calibration
from viewmend.capture.plain import open_capture


@TAKES
@given(SEEDS, COUNTS, st.booleans(), st.booleans(), st.sampled_from([2, 3, 4, 5]))
def test_zju_mocap_there_and_back(seed, count, stamps, arrays, protocol):
    rig = named(random_rig(seed, count), "Camera_B{}")
    frames, gaps = random_take(seed, rig, "{:06d}")
    with tempfile.TemporaryDirectory() as name:
        write_zju(Path(name), opencv(rig), frames, gaps, stamps, arrays, protocol)
        capture = open_capture(name)
        assert_same(capture, rig)
        ids = [f"{f}_2019-08-23_16-08-{int(f[-4:]):02d}.592" for f in frames] if stamps else frames
        ids = ids if len(frames) > 1 else ["0"]
        assert_take(capture, rig, frames, gaps, ids)


@TAKES
@given(SEEDS, COUNTS, st.sampled_from([2, 4, 5]))
def test_genebody_there_and_back(seed, count, protocol):
    rig = named(random_rig(seed, count), "{:02d}")
    frames, gaps = random_take(seed, rig, "{:04d}")
    with tempfile.TemporaryDirectory() as name:
        write_genebody(Path(name), opencv(rig), frames, gaps, protocol)
        capture = open_capture(name)
        assert_same(capture, rig)
        assert_take(capture, rig, frames, gaps)


@TAKES
@given(SEEDS, COUNTS, st.sampled_from([(120 / 65, (4096, 3000), (512, 375)), (2.5, (2448, 2048), (153, 128))]))
def test_mvhumannet_there_and_back(seed, count, sizes):
    scale, full, size = sizes
    rig = named(random_rig(seed, count, 0), "CC32871A0{:02d}")
    rig = [c | {"width": size[0], "height": size[1], "K": rig[0]["K"]} for c in rig]
    frames, gaps = random_take(seed, rig, "{:04d}")
    with tempfile.TemporaryDirectory() as name:
        write_mvhumannet(Path(name), rig, frames, gaps, scale, full)
        capture = open_capture(name)
        assert_same(capture, rig)
        assert_take(capture, rig, frames, gaps)


@TAKES
@given(SEEDS, COUNTS, st.sampled_from(["1x", "4x"]), st.booleans())
def test_actorshq_there_and_back(seed, count, scale, inside):
    rig = named(random_rig(seed, count, 0), "Cam{:03d}")
    frames, gaps = random_take(seed, rig, "{:06d}")
    boxes = np.sort(np.random.default_rng(seed).uniform(-2, 2, (3, 2, 3)), 1)
    with tempfile.TemporaryDirectory() as name:
        write_actorshq(Path(name), rig, frames, gaps, scale, boxes.reshape(3, 6))
        capture = open_capture(Path(name) / scale if inside else name)
        assert_same(capture, rig)
        assert_take(capture, rig, frames, gaps)
        assert capture.bounds is not None
        np.testing.assert_allclose(capture.bounds.low, boxes[:, 0].min(0), rtol=1e-6)
        np.testing.assert_allclose(capture.bounds.high, boxes[:, 1].max(0), rtol=1e-6)


@TAKES
@given(SEEDS, COUNTS, st.sampled_from(["hd", "vga"]))
def test_panoptic_there_and_back(seed, count, kind):
    rig = named(random_rig(seed, count), "00_{:02d}" if kind == "hd" else "01_{:02d}")
    frames, gaps = random_take(seed, rig, "{:08d}")
    with tempfile.TemporaryDirectory() as name:
        write_panoptic(Path(name), opencv(rig), frames, gaps, kind)
        capture = open_capture(name)
        assert_same(capture, rig)
        assert_take(capture, rig, frames, gaps)
        assert capture.fps == (29.97 if kind == "hd" else 25.0)


@TAKES
@given(SEEDS, COUNTS, st.booleans())
def test_easyvolcap_there_and_back(seed, count, quoted):
    rig = named(random_rig(seed, count), "{:02d}")
    frames, gaps = random_take(seed, rig, "{:06d}")
    bounds = [[-1.0, -2.0, 0.0], [1.0, 2.0, 3.5]]
    with tempfile.TemporaryDirectory() as name:
        write_easyvolcap(Path(name), opencv(rig), frames, gaps, bounds, quoted)
        capture = open_capture(name)
        assert_same(capture, rig)
        assert_take(capture, rig, frames, gaps)
        assert capture.bounds is not None and capture.bounds.high.tolist() == bounds[1]


def test_only_cameras_with_footage_are_taken(tmp_path):
    rig = named(random_rig(3, 4), "00_{:02d}")
    write_panoptic(tmp_path, rig[:3], ["00000000"])
    file = tmp_path / "calibration_160422_ultimatum1.json"
    told = json.loads(file.read_text())
    told["cameras"].insert(1, told["cameras"][0] | {"name": "00_99"})
    file.write_text(json.dumps(told))
    assert open_capture(tmp_path).cameras.names == tuple(camera["name"] for camera in rig[:3])


def test_labels_are_foreground_but_for_0(tmp_path):
    rig = named([camera | {"dist": np.zeros(5)} for camera in random_rig(3, 2)], "Camera_B{}")
    write_zju(tmp_path, rig, ["000000"])
    mask = open_capture(tmp_path).read(0).mask
    assert mask is not None and sorted(mask.unique().tolist()) == [0, 255]


def test_mvhumannets_real_rig(shared, tmp_path):
    """Its 48 cameras stand on a ring of about 2 m, and look at its middle."""
    from reference.random_rigs import write_images

    rigs = shared / "rigs"
    poses = json.loads((rigs / "mvhumannet_camera_extrinsics.json").read_text())
    names = [key.rpartition("_")[2].rpartition(".")[0] for key in poses]
    write_images(tmp_path, [{"name": name, "width": 512, "height": 375} for name in names], "0005")
    (tmp_path / "masks").rename(tmp_path / "fmask")
    for part in ("extrinsics", "intrinsics"):
        text = (rigs / f"mvhumannet_camera_{part}.json").read_text()
        (tmp_path / f"camera_{part}.json").write_text(text)
    import pickle

    (tmp_path / "camera_scale.pkl").write_bytes(pickle.dumps(120 / 65))
    cameras = open_capture(tmp_path).cameras
    told = np.array([pose["camera_pos"] for pose in poses.values()]) * (120 / 65 / 1000)
    np.testing.assert_allclose(cameras.centers, told, atol=2e-4)
    assert cameras.K[0, :2, 2].tolist() == [256.0, 187.5]


def test_genebodys_real_rig(shared, tmp_path):
    """Forty cameras, whose annotations came from a real file: they look inwards, from about 3 m."""
    from reference.foreign_studios import save_object, write_take

    told = json.loads((shared / "rigs/genebody_style_rig.json").read_text())
    rig = [{"name": name, "width": 64, "height": 48} for name in told]
    write_take(
        tmp_path,
        rig,
        ["0001"],
        (),
        lambda c, f: f"image/{c['name']}/{f}.jpg",
        lambda c, f: f"mask/{c['name']}/mask{f}.png",
    )
    cams = {name: {key: np.array(value) for key, value in cam.items()} for name, cam in told.items()}
    save_object(tmp_path / "annots.npy", {"cams": cams}, 2)
    cameras = open_capture(tmp_path).cameras
    middle = cameras.centers.mean(0)
    forward = cameras.world_from_camera[:, :3, 2]
    towards = middle - cameras.centers
    assert len(cameras) == 40 and bool((towards.norm(dim=-1) > 2).all())
    assert bool(((forward * towards).sum(-1) / towards.norm(dim=-1) > 0.8).all())


@pytest.mark.parametrize(
    ("kind", "file", "old", "new", "message"),
    [
        ("zju", "annots.npy", b"cams", b"camz", "expected lists K, D, R and T of 'cams'"),
        ("zju", "annots.npy", b"numpy\ndtype", b"posix\nsystem", "got posix.system; is it the right file"),
        ("genebody", "annots.npy", b"c2w", b"c2x", "expected 16 numbers, got NoneType"),
        ("mvhumannet", "camera_scale.pkl", b"G", b"Z", "expected numbers, texts, lists, dicts and arrays"),
        ("mvhumannet", "camera_extrinsics.json", b"translation", b"shift", "translation"),
        ("actorshq", "4x/calibration.csv", b",fx,", b",gx,", "expected columns name,w,h,rx"),
        ("actorshq", "4x/calibration.csv", b"Cam", b"../Cam", "expected rows of cameras or times"),
        ("panoptic", "calibration_160422_ultimatum1.json", b'"hd"', b'"dome"', "type: expected another value"),
        (
            "panoptic",
            "calibration_160422_ultimatum1.json",
            b'"t": [[',
            b'"t": [[{}, ',
            "t.0.: expected a list of length",
        ),
        ("easyvolcap", "intri.yml", b"K_", b"L_", "expected cameras with names"),
    ],
)
def test_wrong_files_are_refused(tmp_path, kind, file, old, new, message):
    pattern = {"mvhumannet": "CC32871A0{:02d}", "actorshq": "Cam{:03d}"}.get(kind, "00_{:02d}")
    rig = named([c | {"width": 512, "height": 375} for c in random_rig(3, 3)], pattern)
    options = {"zju": {"protocol": 2}, "genebody": {"protocol": 2}}.get(kind, {})
    WRITERS[kind](tmp_path, rig, ["000000"], **options)
    open_capture(tmp_path)
    data = (tmp_path / file).read_bytes()
    assert old in data
    (tmp_path / file).write_bytes(data.replace(old, new))
    with pytest.raises(CaptureError, match=message):
        open_capture(tmp_path)


def test_moving_cameras_and_several_scales_are_refused(tmp_path):
    rig = named(random_rig(3, 2, 0), "Cam{:03d}")
    for scale in ("1x", "2x"):
        write_actorshq(tmp_path, rig, ["000000"], scale=scale)
    with pytest.raises(CaptureError, match="expected a folder of one scale, got 1x, 2x in it"):
        open_capture(tmp_path)
    write_easyvolcap(tmp_path / "b" / "cameras" / "00", rig, ["000000"])
    with pytest.raises(CaptureError, match="expected cameras that stand still"):
        read_any_calibration(tmp_path / "b")


WRITERS = {
    "zju": write_zju,
    "genebody": write_genebody,
    "mvhumannet": write_mvhumannet,
    "actorshq": write_actorshq,
    "panoptic": write_panoptic,
    "easyvolcap": write_easyvolcap,
}
