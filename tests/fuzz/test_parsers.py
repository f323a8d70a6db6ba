"""Every parser reads or rejects mutated inputs in one short message, in limited time and memory.

This takes about a minute; VIEWMEND_FUZZ=100000 (inputs per parser) runs longer.
"""

import functools
import json
import math
import struct

import cv2
import numpy as np
import pytest
from fuzz.inputs import fuzz, fuzz_file, mutated_bytes, mutated_json, mutated_words, to_json
from models.plates import tiny
from reference import foreign_studios
from reference.ball import BallCapture, ring
from reference.foreign_formats import write_colmap, write_easymocap, write_transforms
from reference.foreign_images import write_agisoft, write_middlebury
from reference.foreign_rigs import write_opencv, write_qualisys, write_toml
from reference.random_rigs import named, random_rig
from studio.tiny_performer import write_character, write_motion

from viewmend.data.camera_path import read_camera_path
from viewmend.data.capture_folder import open_capture
from viewmend.data.images import read_mask, read_rgb
from viewmend.data.native_writer import write_capture
from viewmend.live.protocol import Limits, Look, parse, unpack
from viewmend.live.push import RigMessage, read_message
from viewmend.models.checkpoint import load_network, save_inpainter
from viewmend.studio.bvh import read_bvh
from viewmend.studio.gltf import load_character
from viewmend.utils.output_folder import OutputFolder


def test_cameras_json(tmp_path):
    write_capture(BallCapture(ring(4)), tmp_path / "ball", images="png")
    fuzz_file(tmp_path / "ball/cameras.json", lambda: open_capture(tmp_path / "ball"))


WRITERS = {
    "transforms": write_transforms,
    "colmap text": functools.partial(write_colmap, binary=False),
    "colmap binary": write_colmap,
    "easymocap": write_easymocap,
    "pose2sim": lambda folder, cameras: write_toml(folder / "Calib.toml", cameras),
    "agisoft": lambda folder, cameras: write_agisoft(folder / "a.xml", cameras),
    "middlebury": lambda folder, cameras: write_middlebury(folder / "a_par.txt", cameras),
    "opencv": write_opencv,
    "qualisys": lambda folder, cameras: write_qualisys(folder / "a.qca.txt", cameras),
}


def fuzz_calibration(file, folder, words, read_frame=False):
    good = file.read_bytes()
    inputs = mutated_words(good.decode().replace(",", " , ")) | mutated_bytes(good) if words else None
    fuzz_file(file, lambda: open_capture(folder).read(0) if read_frame else open_capture(folder), inputs)


@pytest.mark.parametrize("name", WRITERS)
def test_calibrations_of_other_tools(name, tmp_path):
    cameras = []
    for camera in ("cam1", "cam2"):
        (tmp_path / "images" / camera).mkdir(parents=True)
        for image in (f"images/{camera}.png", f"images/{camera}/0.png"):
            cv2.imwrite(str(tmp_path / image), np.zeros((20, 30, 3), np.uint8))
        entry = {
            "name": camera,
            "width": 30,
            "height": 20,
            "K": np.diag([40.0, 40.0, 1.0]),
            "dist": np.zeros(5),
        }
        entry |= {
            "R": np.eye(3),
            "t": np.full(3, float(camera[3:])),
            "image": f"images/{camera}.png",
            "mask": None,
        }
        cameras.append(entry)
    WRITERS[name](tmp_path, cameras)
    places = (tmp_path / "sparse" / "0", tmp_path / "cam1", tmp_path)
    files = sorted(path for place in places for path in place.glob("*.*") if path.is_file())
    assert files and len(open_capture(tmp_path).cameras) == 2
    for file in files:
        fuzz_calibration(file, tmp_path, name not in ("colmap binary", "transforms"))


META = '{"type": "VCI", "version": "2.0", "dataset": {"frame_count": 9}, "volume": {"position": [0, 1, 0], "scale": 1}}'
DATA_SETS = {
    "dna": (foreign_studios.write_dna, "{:02d}", "*.smc"),
    "riftcast": (functools.partial(foreign_studios.write_riftcast, gaps=(), meta=META), "{}", "*.json"),
    "riftcast masks": (foreign_studios.write_riftcast, "{}", "frame_00001/mask/*.bin"),
    "zju": (foreign_studios.write_zju, "Camera_B{}", "annots.npy"),
    "genebody": (foreign_studios.write_genebody, "{:02d}", "annots.npy"),
    "mvhumannet": (foreign_studios.write_mvhumannet, "CC32871A0{:02d}", "camera_*.*"),
    "actorshq": (
        functools.partial(foreign_studios.write_actorshq, boxes=[[0, 0, 0, 1, 1, 1]]),
        "Cam{:03d}",
        "**/*.csv",
    ),
    "panoptic": (foreign_studios.write_panoptic, "00_{:02d}", "*.json"),
    "easyvolcap": (foreign_studios.write_easyvolcap, "{:02d}", "*.yml"),
}


@pytest.mark.parametrize("name", DATA_SETS)
def test_files_of_data_sets(name, tmp_path):
    write, pattern, files = DATA_SETS[name]
    size = {"width": 512, "height": 375} if name == "mvhumannet" else {"width": 32, "height": 24}
    frame = {"dna": "1", "riftcast": "00001", "riftcast masks": "00001"}.get(name, "000001")
    write(tmp_path, named([camera | size for camera in random_rig(3, 2)], pattern), [frame])
    assert len(open_capture(tmp_path).cameras) == 2
    found = sorted(tmp_path.glob(files))
    assert found
    for file in found:
        fuzz_calibration(file, tmp_path, file.suffix in (".csv", ".yml"), read_frame=True)


def test_camera_paths(tmp_path):
    file, content = tmp_path / "path.json", {"world_from_camera": [np.eye(4).tolist()] * 3}
    file.write_text(json.dumps(content | {"K": np.eye(3).tolist(), "width": 40, "height": 20}))
    fuzz_file(file, lambda: read_camera_path(file, ring(2)))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_images(suffix, tmp_path):
    file = tmp_path / f"image{suffix}"
    cv2.imwrite(str(file), np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8))
    for read in (read_rgb, read_mask):
        fuzz_file(file, lambda read=read: read(file, "image"))


def test_models(tmp_path):
    save_inpainter(tiny(), tmp_path, "# A card")
    fuzz_file(tmp_path / "config.json", lambda: load_network(tmp_path))
    weights = (tmp_path / "model.safetensors").read_bytes()
    heads = mutated_bytes(weights[:4000]).map(
        lambda head: head + weights[4000:]
    )  # hypothesis keeps what it draws
    fuzz_file(tmp_path / "model.safetensors", lambda: load_network(tmp_path), heads)


def test_gltf(tmp_path):
    file = write_character(tmp_path / "a.glb")
    good = file.read_bytes()
    size = struct.unpack_from("<I", good, 12)[0]
    document, rest = json.loads(good[20 : 20 + size]), good[20 + size :]

    def pack(value):
        text = to_json(value)
        text += b" " * (-len(text) % 4)
        return (
            struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
            + text
            + rest
        )

    fuzz_file(file, lambda: load_character(file), mutated_json(document).map(pack) | mutated_bytes(good))


@pytest.mark.parametrize(
    "uri", ["/etc/passwd", "../secret", "%2e%2e/secret", "/dev/zero", "link.bin", "folder"]
)
def test_gltf_reads_only_its_own_folder(uri, tmp_path):
    (tmp_path / "secret").write_bytes(b"\0" * 100)
    (tmp_path / "in" / "folder").mkdir(parents=True)
    (tmp_path / "in" / "link.bin").symlink_to(tmp_path / "secret")
    file = tmp_path / "in" / "a.gltf"
    file.write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": uri, "byteLength": 100}]}))
    with pytest.raises(ValueError, match=r"expected files in its own folder|expected a file of at most"):
        load_character(file)


def test_bvh(tmp_path):
    file = write_motion(tmp_path / "a.bvh")
    fuzz_file(
        file, lambda: read_bvh(file), mutated_words(file.read_text()) | mutated_bytes(file.read_bytes())
    )
    file.write_text("HIERARCHY ROOT a { CHANNELS 0 } MOTION\nFrames: 999999999999\nFrame Time: 0.1\n")
    with pytest.raises(ValueError, match="expected 999999999999 frames of 0 finite numbers"):
        read_bvh(file)


def test_live_messages():
    look = {
        "type": "look",
        "id": 1,
        "camera": {"azimuth": 3, "target": [1, 2, 3], "R": [1.0] * 9},
        "modes": ["completed"],
    }
    camera = {"name": "a", "width": 48, "height": 48, "K": [50, 0, 24, 0, 50, 24, 0, 0, 1]}
    camera |= {"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "T": [0, 0, 1]}
    rig = {"type": "rig", "version": 1, "cameras": [camera], "up": [0, 1, 0]}
    header = to_json({"images": [{"camera": "a", "kind": "rgb", "bytes": 3}]})
    binary = b"VMF1" + struct.pack("<I", len(header)) + header + b"abc"

    def parse_look(data):
        understood = parse(data.decode(errors="replace"), Limits())
        if isinstance(understood, Look):
            assert understood.width * understood.height <= Limits().max_pixels and len(
                understood.cameras
            ) in (1, 2)
            assert all(math.isfinite(v) for eye in understood.cameras for v in (eye.azimuth, *(eye.R or ())))

    fuzz(mutated_json(look).map(to_json), parse_look)
    fuzz(mutated_json(rig).map(to_json), lambda data: read_message(data, RigMessage))
    fuzz(mutated_bytes(binary), lambda data: unpack(data, "images"))


def test_manifests(tmp_path):
    with OutputFolder(tmp_path) as folder:
        (tmp_path / "a").write_text("a")
        folder.record("a")

    def begin():
        with OutputFolder(tmp_path) as folder:
            folder.check_own_files("a")

    fuzz_file(tmp_path / ".viewmend" / "files.json", begin)
