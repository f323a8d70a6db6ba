"""Whatever a file holds, it is read or refused in one line, soon and in little memory.

Every parser is given its own kind of file with something changed: bytes, values of its JSON, words of its text. By
default a minute in all; VIEWMEND_FUZZ=100000 (inputs a parser) is the longer run.
"""

import copy
import functools
import json
import os
import resource
import struct
import time
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
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
from viewmend.live.protocol import Limits, parse, unpack
from viewmend.live.push import RigMessage, read_message
from viewmend.output_folder import OutputFolder
from viewmend.studio.bvh import read_bvh
from viewmend.studio.gltf import load_character

INPUTS = int(os.environ.get("VIEWMEND_FUZZ", "60"))
MOST_S, MOST_MB = 5.0, 600
FUZZED = settings(
    max_examples=INPUTS,
    deadline=None,
    database=None,
    derandomize=INPUTS < 1000,
    suppress_health_check=list(HealthCheck),
)
NUMBERS = (-1, 0, 1, 2, 0.5, 7, 2**31, 2**40, 10**400, 1e308, -1e308, 1e-300, float("nan"), float("inf"))
TEXTS = ("", "x", "\0", "../../etc/passwd", "/etc/passwd", "/dev/zero", "\ud800", "a" * 5000)
NASTY = st.sampled_from([None, True, *NUMBERS, *TEXTS, [], {}, [[]], {"a": {}}, [0] * 100, ["x"] * 3])
WORDS = ("", "nan", "1e308", "-1", "999999999", "{", "}", "ROOT", "CHANNELS", "w", "\0")
URIS = ("/etc/passwd", "../secret.bin", "%2e%2e/secret.bin", "/dev/zero", "link.bin", "folder")


@st.composite
def changed(draw, value):
    """JSON with one to three of its values replaced, removed, doubled or put where another was."""
    value = copy.deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        at, key = value, None
        while isinstance(at, dict | list) and at and (key is None or draw(st.integers(0, 3))):
            parent, key = at, draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
            at = parent[key]
        if key is None:
            return draw(NASTY)
        kind = draw(st.sampled_from(["nasty", "nasty", "remove", "double", "deep"]))
        if kind == "remove":
            del parent[key]
        elif kind == "double" and isinstance(parent, list):
            parent.extend([at] * draw(st.sampled_from([1, 3000])))
        else:
            parent[key] = draw(NASTY) if kind != "deep" else nested(draw(st.sampled_from([3, 900, 5000])))
    return value


def nested(depth):
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


def text_of(value) -> bytes:
    """JSON as bytes; of what is too deep for Python's own writer, brackets."""
    try:
        return json.dumps(value).encode(errors="replace")
    except RecursionError:
        return b"[" * 100_000


@st.composite
def spoilt(draw, data: bytes):
    """Bytes with a few of them changed, a piece cut out, doubled, or nothing after it."""
    data = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(data) - 1)))
        kind = draw(st.sampled_from(["flip", "flip", "cut", "end", "double", "number"]))
        if kind == "flip" and data:
            data[at] = draw(st.integers(0, 255))
        elif kind == "cut":
            del data[at : at + draw(st.integers(1, 40))]
        elif kind == "end":
            del data[at:]
        elif kind == "double":
            data[at:at] = data[at : at + 60]
        else:
            data[at : at + 4] = struct.pack("<I", draw(st.sampled_from([0, 1, 2**31, 2**32 - 1])))
    return bytes(data)


@st.composite
def reworded(draw, text: str):
    """Text with a few words replaced."""
    words = text.split(" ")
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(words) - 1))
        words[at] = draw(st.sampled_from(WORDS))
    return " ".join(words).encode()


def held(read: Callable[[], object], refusals: tuple[type[Exception], ...] = (ValueError,)) -> None:
    """Read or refuse, in one line, within the bounds."""
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        read()
    except refusals as error:
        assert len(str(error)) < 2000, str(error)[:3000]
        assert "Error:" not in str(error)[:20]
    assert time.monotonic() - began < MOST_S * 4, "too slow"  # on a machine that does other things as well
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MOST_MB * 1000, "too much memory"


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
    @given(spoilt(weights[:4000]).map(lambda head: head + weights[4000:]))
    def fuzz_weights(data):
        (model / "model.safetensors").write_bytes(data)
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
