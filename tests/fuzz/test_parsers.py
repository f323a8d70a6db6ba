"""Whatever a file holds, it is read or refused in one line, soon and in little memory.

Every parser is given its own kind of file with something changed: bytes, values of its JSON, words of its text. By
default a minute in all; VIEWMEND_FUZZ=100000 (inputs a parser) is the longer run.
"""

import functools
import json
import struct

import cv2
import numpy as np
import pytest
from fuzz.inputs import FUZZED, changed, held, reworded, spoilt, text_of
from hypothesis import given
from hypothesis import strategies as st
from inpainting.plates import tiny
from reference.ball import BallCapture, ring
from reference.foreign_formats import write_colmap, write_easymocap, write_transforms
from reference.foreign_images import write_agisoft, write_middlebury
from reference.foreign_rigs import write_opencv, write_qualisys, write_toml
from studio.tiny_performer import write_character, write_motion

from viewmend.capture.camera_path import read_path
from viewmend.capture.images import read_mask, read_rgb
from viewmend.capture.plain import open_capture
from viewmend.capture.plain_writer import write_capture
from viewmend.inpainting.checkpoint import load_network, save_inpainter
from viewmend.live import riftcast_messages
from viewmend.live.protocol import Limits, parse, unpack
from viewmend.live.push import RigMessage, read_message
from viewmend.output_folder import OutputFolder
from viewmend.studio.bvh import read_bvh
from viewmend.studio.gltf import load_character

URIS = ("/etc/passwd", "../secret.bin", "%2e%2e/secret.bin", "/dev/zero", "link.bin", "folder")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz") / "ball"
    write_capture(BallCapture(ring(4)), folder, images="png")
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz") / "model"
    save_inpainter(tiny(), folder, "# A card")
    return folder


@pytest.fixture(scope="module")
def character(tmp_path_factory):
    return write_character(tmp_path_factory.mktemp("fuzz") / "a.glb")


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    return write_motion(tmp_path_factory.mktemp("fuzz") / "a.bvh")


def test_cameras_json(capture):
    file = capture / "cameras.json"
    good = file.read_bytes()

    @FUZZED
    @given(changed(json.loads(good)).map(text_of) | spoilt(good))
    def fuzz(data):
        file.write_bytes(data)
        held(lambda: open_capture(capture))

    try:
        fuzz()
    finally:
        file.write_bytes(good)


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


@pytest.mark.parametrize("kind", WRITERS)
def test_calibrations_of_others(kind, tmp_path):
    cameras = []
    for name in ("cam1", "cam2"):
        (tmp_path / "images" / name).mkdir(parents=True)
        for image in (f"images/{name}.png", f"images/{name}/0.png"):
            cv2.imwrite(str(tmp_path / image), np.zeros((20, 30, 3), np.uint8))
        camera = {"name": name, "width": 30, "height": 20, "K": np.diag([40.0, 40.0, 1.0]), "dist": np.zeros(5)}
        camera |= {"R": np.eye(3), "t": np.zeros(3), "image": f"images/{name}.png", "mask": None}
        cameras.append(camera)
    WRITERS[kind](tmp_path, cameras)
    places = (tmp_path / "sparse" / "0", tmp_path / "cam1", tmp_path)
    files = sorted(path for place in places for path in place.glob("*.*") if path.is_file())
    assert files and len(open_capture(tmp_path).cameras) == 2

    def fuzz_file(file):
        good = file.read_bytes()
        others = changed(json.loads(good)).map(text_of) if file.suffix == ".json" else spoilt(good)
        if kind != "colmap binary":
            others |= reworded(good.decode())

        @FUZZED
        @given(others | spoilt(good))
        def fuzz(data):
            file.write_bytes(data)
            held(lambda: open_capture(tmp_path))

        fuzz()
        file.write_bytes(good)

    for file in files:
        fuzz_file(file)


def test_camera_paths(capture, tmp_path):
    cameras = open_capture(capture).cameras
    good = {"world_from_camera": [np.eye(4).tolist()] * 3, "K": np.eye(3).tolist(), "width": 40, "height": 20}

    @FUZZED
    @given(changed(good).map(text_of))
    def fuzz(data):
        (tmp_path / "path.json").write_bytes(data)
        held(lambda: read_path(tmp_path / "path.json", cameras))

    fuzz()


def test_images(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    good = [cv2.imencode(suffix, image)[1].tobytes() for suffix in (".png", ".jpg")]

    @FUZZED
    @given(st.sampled_from(good).flatmap(spoilt))
    def fuzz(data):
        (tmp_path / "image").write_bytes(data)
        held(lambda: read_rgb(tmp_path / "image", "image"))
        held(lambda: read_mask(tmp_path / "image", "image"))

    fuzz()


def test_models(model):
    config, weights = (model / "config.json").read_bytes(), (model / "model.safetensors").read_bytes()

    @FUZZED
    @given(changed(json.loads(config)).map(text_of) | spoilt(config))
    def fuzz_config(data):
        (model / "config.json").write_bytes(data)
        held(lambda: load_network(model))

    @FUZZED
    @given(spoilt(weights[:4000]))  # the head alone: hypothesis keeps what it draws
    def fuzz_weights(head):
        (model / "model.safetensors").write_bytes(head + weights[4000:])
        held(lambda: load_network(model))

    try:
        fuzz_config()
        (model / "config.json").write_bytes(config)
        fuzz_weights()
    finally:
        (model / "config.json").write_bytes(config)
        (model / "model.safetensors").write_bytes(weights)


def test_gltf(character, tmp_path):
    good = character.read_bytes()
    size = struct.unpack_from("<I", good, 12)[0]
    document, rest = json.loads(good[20 : 20 + size]), good[20 + size :]

    def packed(value):
        text = text_of(value)
        text += b" " * (-len(text) % 4)
        return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest

    @FUZZED
    @given(changed(document).map(packed) | spoilt(good))
    def fuzz(data):
        (tmp_path / "a.glb").write_bytes(data)
        held(lambda: load_character(tmp_path / "a.glb"))

    fuzz()


@pytest.mark.parametrize("uri", URIS)
def test_gltf_reads_no_file_of_others(uri, tmp_path):
    (tmp_path / "secret.bin").write_bytes(b"\0" * 100)
    (tmp_path / "in" / "folder").mkdir(parents=True)
    (tmp_path / "in" / "link.bin").symlink_to(tmp_path / "secret.bin")
    file = tmp_path / "in" / "a.gltf"
    file.write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": uri, "byteLength": 100}]}))
    with pytest.raises(ValueError, match=r"expected files in its own folder|expected a file of at most"):
        load_character(file)


def test_bvh(motion, tmp_path):
    good = motion.read_text()

    @FUZZED
    @given(reworded(good) | spoilt(good.encode()))
    def fuzz(data):
        (tmp_path / "a.bvh").write_bytes(data)
        held(lambda: read_bvh(tmp_path / "a.bvh"))

    fuzz()


def test_a_bvh_of_nothing_for_ever_is_refused(tmp_path):
    (tmp_path / "a.bvh").write_text("HIERARCHY ROOT a { CHANNELS 0 } MOTION\nFrames: 999999999999\nFrame Time: 0.1\n")
    with pytest.raises(ValueError, match="expected 999999999999 frames of 0 finite numbers"):
        read_bvh(tmp_path / "a.bvh")


def test_messages():
    look = {"type": "look", "id": 1, "camera": {"azimuth": 3, "target": [1, 2, 3], "R": [1.0] * 9}, "modes": ["mended"]}
    camera = {"name": "a", "width": 48, "height": 48, "K": [50, 0, 24, 0, 50, 24, 0, 0, 1]}
    camera |= {"R": [1, 0, 0, 0, 1, 0, 0, 0, 1], "T": [0, 0, 1]}
    rig = {"type": "rig", "version": 1, "cameras": [camera], "up": [0, 1, 0]}
    header = text_of({"images": [{"camera": "a", "kind": "rgb", "bytes": 3}]})
    binary = b"VMF1" + struct.pack("<I", len(header)) + header + b"abc"

    @FUZZED
    @given(changed(look).map(text_of), changed(rig).map(text_of), spoilt(binary))
    def fuzz(asked, begun, pushed):
        held(lambda: parse(asked.decode(errors="replace"), Limits()))
        held(lambda: read_message(begun, RigMessage))
        held(lambda: unpack(pushed, "images"))

    fuzz()


def test_messages_of_riftcasts_clients():
    matrices = [np.eye(4), np.array([[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, -1, -0.02], [0, 0, -1, 0]])]
    body = b"".join(struct.pack(">I", 64) + np.asarray(m, "<f4").T.tobytes() for m in matrices)
    good = struct.pack("<HHi", 1, 3, 3) + struct.pack(">II", 48, 48) + body
    assert isinstance(riftcast_messages.parse(good), riftcast_messages.ImageRequest)

    @FUZZED
    @given(spoilt(good))
    def fuzz(message):
        held(lambda: riftcast_messages.parse(message))

    fuzz()


def test_manifests(tmp_path):
    with OutputFolder(tmp_path) as folder:
        (tmp_path / "a").write_text("a")
        folder.made("a")
    file = tmp_path / ".viewmend" / "files.json"
    good = file.read_bytes()

    def begin():
        with OutputFolder(tmp_path) as folder:
            folder.demand_own("a")

    @FUZZED
    @given(changed(json.loads(good)).map(text_of) | spoilt(good))
    def fuzz(data):
        file.write_bytes(data)
        held(begin)

    fuzz()
