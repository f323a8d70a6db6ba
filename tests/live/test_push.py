"""A rig that pushes its frames."""

import json
import struct
import zlib
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from live_servers import CAMERAS, running, wait_until
from reference.ball import photograph
from test_faults import SOON, closing, still_serves
from test_server import get, truth
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from viewmend.geometry.bounds import Bounds
from viewmend.live import push
from viewmend.live.client import Client
from viewmend.live.door import Visitor
from viewmend.live.poses import cameras_json
from viewmend.live.protocol import ProtocolError, pack, unpack
from viewmend.live.publisher import Publisher
from viewmend.live.pushed import PushedFrames

BOUNDS = Bounds(torch.full((3,), -0.6), torch.full((3,), 0.6))
UP = torch.tensor([0.0, 1.0, 0.0])


def publisher(server, cameras=CAMERAS, **options):
    return Publisher(cameras, server.ws, fps=10.0, name="pushed ball", up=UP, bounds=BOUNDS, **options)


def test_what_is_pushed_is_seen_at_the_edge_and_can_be_sought():
    with running(PushedFrames(), ready=False) as server:
        assert json.loads(get(f"{server.url}/health")[2])["status"] == "loading"
        with Client(server.ws) as viewer, publisher(server) as rig:
            assert [rig.push(photograph(CAMERAS)) for _ in range(3)] == [0, 1, 2]
            assert viewer.wait_for("rig")["name"] == "pushed ball"
            look = viewer.look(camera={"azimuth": 200.0}, width=48, height=48, quality=95)
            shown = viewer.frame(look)
            right = truth(server.service.renderer.frame, (48, 48), azimuth=200.0)
            assert shown.header["time"] == 2 and np.abs(shown.images[0, "mended"] - right.astype(float)).mean() < 14
            rig.push(photograph(CAMERAS).without(["c7"]))
            assert viewer.frame().header["time"] == 3
            viewer.send("clock", seek=1, playing=False)
            wait_until(lambda: viewer.wait_for("state")["time"] == 1)
            state = viewer.messages["state"]
            assert state["kind"] == "live" and state["behind"] == 2 and not state["loops"]


def test_a_rig_that_goes_is_missed_and_another_one_may_come():
    with running(PushedFrames(), ready=False) as server, Client(server.ws) as viewer:
        with publisher(server) as rig:
            rig.push(photograph(CAMERAS))
            viewer.frame(viewer.look(width=32, height=32))
        wait_until(lambda: viewer.wait_for("state")["source"] == "failing")
        assert get(f"{server.url}/health")[0] == 503
        others = CAMERAS[[0, 2, 3, 5]]
        with publisher(server, others) as rig:
            rig.push(photograph(others))
            wait_until(lambda: len(viewer.wait_for("rig")["cameras"]) == 4)
            shown = viewer.frame(viewer.look(width=32, height=32))
            assert shown.header["time"] == 1 and set(shown.header["source_views"]) <= set(others.names)
            with pytest.raises(ConnectionError, match="another rig is pushing"):
                publisher(server)
            assert get(f"{server.url}/health")[0] == 200


def test_a_rig_changes_its_cameras_while_it_pushes():
    with running(PushedFrames(), ready=False) as server, Client(server.ws) as viewer, publisher(server) as rig:
        rig.push(photograph(CAMERAS))
        viewer.frame(viewer.look(width=32, height=32))
        others = CAMERAS[[0, 2, 3, 5]]
        rig.change(others)
        rig.push(photograph(others))
        wait_until(lambda: len(viewer.wait_for("rig")["cameras"]) == 4)
        assert server.service.supply.span.first == 1 and server.service.supply.rig.number == 2


def test_recordings_take_no_pushes(ball):
    with pytest.raises(ConnectionError, match="viewmend serve live"):
        publisher(ball)


def rig_message(**changes):
    rig = {"type": "rig", "version": 1, "name": "x", "cameras": cameras_json(CAMERAS)}
    return json.dumps(rig | changes)


@pytest.mark.parametrize(
    "message",
    [
        "nonsense",
        rig_message(version=2),
        rig_message(cameras=[]),
        rig_message(cameras=cameras_json(CAMERAS[[0, 0]])),
        rig_message(cameras=[cameras_json(CAMERAS)[0] | {"width": 16000, "height": 16000}]),
        rig_message(up=[0, 0, 0]),
        rig_message(cameras=[cameras_json(CAMERAS)[0] | {"R": [-1, 0, 0, 0, 1, 0, 0, 0, 1]}]),
        rig_message(cameras=[cameras_json(CAMERAS)[0] | {"K": [-50, 0, 24, 0, 50, 24, 0, 0, 1]}]),
        rig_message(cameras=[cameras_json(CAMERAS)[0] | {"K": [0] * 9}]),
        rig_message(bounds={"low": [0, 0, 0], "high": [0, 1, 1]}),
    ],
)
def test_rigs_that_cannot_be_are_refused(message):
    with running(PushedFrames(), ready=False) as server, connect(f"{server.ws}/push", **SOON) as bad:
        bad.send(message)
        answer = json.loads(bad.recv(timeout=10))
        assert answer["type"] == "error" and "expected" in answer["message"] and closing(bad) == 4400


def frame_message(name="c0", kind="rgb", data=None, size=48):
    image = cv2.imencode(".png", np.zeros((size, size), np.uint8))[1].tobytes() if data is None else data
    return pack({"images": [{"camera": name, "kind": kind, "bytes": len(image)}]}, [image])


CHUNK = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
HUGE_PNG = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + CHUNK + struct.pack(">I", zlib.crc32(CHUNK))


@pytest.mark.parametrize(
    "message",
    [
        b"garbage",
        "text",
        frame_message(),
        frame_message(name="c99"),
        frame_message(kind="depth"),
        frame_message(size=47),
        frame_message(data=b"GIF89a"),
        frame_message(data=b"\x89PNG and nothing more"),
        frame_message(data=HUGE_PNG),
        pack({"images": [3]}, [b""]),
    ],
)
def test_frames_that_cannot_be_end_the_rig_and_nothing_else(message):
    with running(PushedFrames(), ready=False) as server:
        with connect(f"{server.ws}/push", **SOON) as bad:
            bad.send(rig_message())
            assert json.loads(bad.recv(timeout=10))["type"] == "taken"
            bad.send(message)
            answer = json.loads(bad.recv(timeout=10))
            assert answer["type"] == "error" and "expected" in answer["message"]
        with publisher(server) as rig:
            rig.push(photograph(CAMERAS))
            assert still_serves(server)


def test_an_empty_stage_is_said_and_passes():
    with running(PushedFrames(), ready=False) as server, Client(server.ws) as viewer:
        frame = photograph(CAMERAS)
        with publisher(server) as rig:
            rig.push(frame)
            viewer.frame(viewer.look(width=32, height=32))
            rig.push(replace(frame, mask=torch.zeros_like(frame.mask)))
            assert "no" in viewer.wait_for("error")["message"]
            rig.push(frame)
            assert viewer.frame().header["time"] == 2


def test_frames_without_masks_are_refused_where_they_are_pushed():
    frame = replace(photograph(CAMERAS), mask=None)
    with (
        running(PushedFrames(), ready=False) as server,
        publisher(server) as rig,
        pytest.raises(ValueError, match="expected a frame with masks"),
    ):
        rig.push(frame)


def test_memory_of_a_live_rig_is_bounded():
    supply = PushedFrames(memory_mb=0.3)
    supply.begin("x", 10.0, None, None)
    for _ in range(20):
        supply.push(photograph(CAMERAS))
    assert supply.span.end == 20 and 15 <= supply.span.first < 20
    assert supply.read(supply.span.first) is not None and supply.read(supply.span.first - 1) is None


def test_cameras_of_odd_shapes_are_counted_as_they_are_kept():
    """Four of 16 x 16,000 and of 16,000 x 16 pixels have a million pixels, and would lie in a tensor of a billion."""
    shapes = [(16, 16_000), (16_000, 16)] * 2
    odd = [c | {"width": w, "height": h} for c, (w, h) in zip(cameras_json(CAMERAS), shapes, strict=False)]
    with running(PushedFrames(), ready=False) as server, connect(f"{server.ws}/push", **SOON) as bad:
        bad.send(rig_message(cameras=odd))
        assert "cameras x widest x highest" in json.loads(bad.recv(timeout=10))["message"] and closing(bad) == 4400


def test_an_image_is_judged_by_its_head(monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(ProtocolError, match="expected rgb of 48 x 48 pixels, got 100000 x 100000"):
        push._decoded(HUGE_PNG, "c0", "rgb", CAMERAS)
    jpeg = cv2.imencode(".jpg", np.zeros((40, 64), np.uint8))[1].tobytes()
    with pytest.raises(ProtocolError, match="got 64 x 40"):
        push._decoded(jpeg, "c0", "mask", CAMERAS)


class Present(Visitor):
    gone = False


class Departed(Visitor):
    gone = True


def test_work_of_a_rig_that_is_gone_is_dropped(monkeypatch):
    gone = Departed()
    monkeypatch.setattr(push, "_decoded", lambda *_: pytest.fail("decoded"))
    assert push._frame(frame_message(), CAMERAS, gone) is None


def test_an_image_comes_once():
    image = cv2.imencode(".png", np.zeros((48, 48), np.uint8))[1].tobytes()
    entry = {"camera": "c0", "kind": "mask", "bytes": len(image)}
    with pytest.raises(ProtocolError, match="one image of each camera and kind"):
        push._frame(pack({"images": [entry] * 100}, [image] * 100), CAMERAS, Present())


def whole_frame(names, size=48):
    """Image and mask of these cameras."""
    rgb, mask = (cv2.imencode(".png", np.full((size, size, *k), 9, np.uint8))[1].tobytes() for k in ((3,), ()))
    images = [(name, kind, data) for name in names for kind, data in (("rgb", rgb), ("mask", mask))]
    listed = [{"camera": name, "kind": kind, "bytes": len(data)} for name, kind, data in images]
    return pack({"images": listed}, [data for *_, data in images])


def test_one_camera_is_no_frame_two_are():
    with pytest.raises(ProtocolError, match="image and mask of two cameras or more, got 1"):
        push._frame(whole_frame(["c0"]), CAMERAS, Present())
    frame = push._frame(whole_frame(["c4", "c1"]), CAMERAS, Present())
    assert frame.cameras.names == ("c1", "c4") and bool((frame.rgb == 9).all()) and bool((frame.mask == 9).all())


def test_what_no_frame_of_the_rig_can_be_is_not_read():
    """Six cameras of 48 x 48 and their heads are a megabyte and a half; before the rig is known, less is taken."""
    most = 8 + 1_000_000 + 6 * (4 * 48 * 48 + 65_536)
    with running(PushedFrames(), ready=False) as server:
        for size, codes in ((most, (4400,)), (most + 1, (1009, None))):
            with suppress(ConnectionClosed), connect(f"{server.ws}/push", **SOON) as rig:
                rig.send(rig_message())
                assert json.loads(rig.recv(timeout=10))["type"] == "taken"
                rig.send(bytes(size))
                assert closing(rig) in codes


def test_a_header_is_small():
    with pytest.raises(ProtocolError, match="at most 1000000 bytes, got one of 1000001"):
        unpack(b"VMF1" + struct.pack("<I", 1_000_001) + b" " * 1_000_001, "images")
