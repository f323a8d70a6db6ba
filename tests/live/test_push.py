"""A rig pushes its frames."""

import json
import struct
import zlib
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from live.live_servers import (
    CAMERAS,
    PIPELINE,
    WAIT_S,
    close_code,
    get,
    open_websocket,
    running,
    true_image,
    wait_until,
)
from reference.ball import photograph
from websockets.exceptions import ConnectionClosed

from viewmend.geometry.bounds import Bounds
from viewmend.live import push
from viewmend.live.client import Client, Publisher
from viewmend.live.poses import cameras_json, home_view
from viewmend.live.protocol import Limits, ProtocolError, pack
from viewmend.live.push import PushSource
from viewmend.live.registry import SessionRegistry
from viewmend.live.render_jobs import PathJob, RenderError, parse_path
from viewmend.live.renderer import Renderer
from viewmend.live.responses import metrics_text
from viewmend.live.service import RenderService
from viewmend.live.sessions import PlaybackState
from viewmend.models.smooth_fill import SmoothFill
from viewmend.stream import Stream

BOUNDS = Bounds(torch.full((3,), -0.6), torch.full((3,), 0.6))
UP = torch.tensor([0.0, 1.0, 0.0])


def publisher(server, cameras=CAMERAS, **options):
    return Publisher(cameras, server.ws, fps=10.0, name="pushed ball", up=UP, bounds=BOUNDS, **options)


def test_pushed_frames_are_shown_at_the_edge_and_can_be_sought():
    with running(PushSource(), ready=False) as server:
        assert json.loads(get(f"{server.url}/health")[2])["status"] == "loading"
        with Client(server.ws) as viewer, publisher(server) as rig:
            assert [rig.push(photograph(CAMERAS)) for _ in range(3)] == [0, 1, 2]
            assert viewer.wait_for("rig")["name"] == "pushed ball"
            look = viewer.look(camera={"azimuth": 200.0}, width=48, height=48, quality=95)
            shown = viewer.frame(look)
            right = true_image(server.service.renderer.home, (48, 48), azimuth=200.0)
            assert (
                shown.header["time"] == 2
                and np.abs(shown.images[0, "completed"] - right.astype(float)).mean() < 14
            )
            rig.push(photograph(CAMERAS).without(["c7"]))
            assert viewer.frame().header["time"] == 3
            viewer.send("clock", seek=1, playing=False)
            wait_until(lambda: viewer.wait_for("state")["time"] == 1)
            state = viewer.messages["state"]
            assert state["kind"] == "live" and state["behind"] == 2 and not state["loops"]


def test_a_rig_disconnects_and_another_one_connects():
    with running(PushSource(), ready=False) as server, Client(server.ws) as viewer:
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


def test_a_rig_changes_its_cameras():
    with running(PushSource(), ready=False) as server, Client(server.ws) as viewer, publisher(server) as rig:
        rig.push(photograph(CAMERAS))
        viewer.frame(viewer.look(width=32, height=32))
        others = CAMERAS[[0, 2, 3, 5]]
        rig.change(others)
        rig.push(photograph(others))
        wait_until(lambda: len(viewer.wait_for("rig")["cameras"]) == 4)
        assert server.service.source.span.first == 1 and server.service.source.rig.number == 2


def test_a_recording_accepts_no_rig(ball):
    with pytest.raises(ConnectionError, match="viewmend serve live"):
        publisher(ball)


def rig_message(**changes):
    rig = {"type": "rig", "version": 1, "name": "x", "cameras": cameras_json(CAMERAS)}
    return json.dumps(rig | changes)


CAMERA = cameras_json(CAMERAS)[0]
# Four cameras have a million pixels, but need a tensor of a billion.
ODD = [
    CAMERA | {"name": str(n), "width": (16, 16_000)[n % 2], "height": (16_000, 16)[n % 2]} for n in range(4)
]


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ("nonsense", "expected"),
        (rig_message(version=2), "expected version 1, got 2"),
        (rig_message(cameras=[]), "expected a list that is not empty"),
        (rig_message(cameras=[CAMERA] * 2), "expected unique camera names"),
        (rig_message(cameras=[CAMERA | {"width": 16000, "height": 16000}]), "cameras x widest x highest"),
        (rig_message(cameras=ODD), "cameras x widest x highest"),
        (rig_message(up=[0, 0, 0]), "expected 'up' as a direction"),
        (rig_message(cameras=[CAMERA | {"R": [-1, 0, 0, 0, 1, 0, 0, 0, 1]}]), "expected 'R' as a rotation"),
        (rig_message(cameras=[CAMERA | {"K": [-50, 0, 24, 0, 50, 24, 0, 0, 1]}]), "expected 'K' as"),
        (rig_message(cameras=[CAMERA | {"K": [0] * 9}]), "expected 'K' as"),
        (rig_message(bounds={"low": [0, 0, 0], "high": [0, 1, 1]}), "expected low < high"),
    ],
)
def test_invalid_rigs_are_refused(message, words):
    with running(PushSource(), ready=False) as server, open_websocket(server, "/push") as bad:
        bad.send(message)
        answer = json.loads(bad.recv(timeout=WAIT_S))
        assert answer["type"] == "error" and words in answer["message"] and close_code(bad) == 4400


def png(*shape, value=0):
    return cv2.imencode(".png", np.full(shape or (48, 48), value, np.uint8))[1].tobytes()


def frame_message(*images):
    """The message of a frame with these images: camera, kind and content of each."""
    listed = [{"camera": name, "kind": kind, "bytes": len(data)} for name, kind, data in images]
    return pack({"images": listed}, [data for *_, data in images])


CHUNK = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
HUGE_PNG = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + CHUNK + struct.pack(">I", zlib.crc32(CHUNK))


@pytest.mark.parametrize(
    "message",
    [
        b"garbage",
        "text",
        frame_message(("c0", "rgb", png())),
        frame_message(("c99", "rgb", png())),
        frame_message(("c0", "depth", png())),
        frame_message(("c0", "rgb", png(47, 47))),
        *(frame_message(("c0", "rgb", data)) for data in (b"GIF89a", b"\x89PNG and nothing more", HUGE_PNG)),
        pack({"images": [3]}, [b""]),
    ],
)
def test_an_invalid_frame_disconnects_its_rig_only(message):
    with running(PushSource(), ready=False) as server:
        with open_websocket(server, "/push") as bad:
            bad.send(rig_message())
            assert json.loads(bad.recv(timeout=WAIT_S))["type"] == "taken"
            bad.send(message)
            answer = json.loads(bad.recv(timeout=WAIT_S))
            assert answer["type"] == "error" and "expected" in answer["message"]
        with publisher(server) as rig:
            rig.push(photograph(CAMERAS))
            assert server.is_serving()


def test_an_empty_frame_shows_the_background():
    with running(PushSource(), ready=False) as server, Client(server.ws) as viewer:
        frame = photograph(CAMERAS)
        with publisher(server) as rig:
            rig.push(frame)
            viewer.frame(viewer.look(width=32, height=32))
            for time, mask in enumerate((torch.zeros_like(frame.mask), frame.mask), 1):
                rig.push(replace(frame, mask=mask))
                while (shown := viewer.frame()).header["time"] < time:
                    pass
                assert (shown.images[0, "completed"].max() > 50) == bool(mask.any())


def test_the_client_refuses_frames_without_masks():
    frame = replace(photograph(CAMERAS), mask=None)
    with (
        running(PushSource(), ready=False) as server,
        publisher(server) as rig,
        pytest.raises(ValueError, match="expected a frame with masks"),
    ):
        rig.push(frame)


def test_memory_of_a_live_rig_is_bounded():
    source = PushSource(memory_mb=0.3)
    source.begin("x", 10.0, None, None)
    for _ in range(20):
        source.add(photograph(CAMERAS))
    assert source.span.end == 20 and 15 <= source.span.first < 20
    assert source.read(source.span.first) is not None and source.read(source.span.first - 1) is None


def test_the_metrics_count_the_frames_that_can_be_requested():
    source = PushSource(memory_mb=0.3)
    source.begin("x", 10.0, None, None)
    for _ in range(20):
        source.add(photograph(CAMERAS))
    service = RenderService(Renderer(source, SmoothFill()), source)
    text = metrics_text(SessionRegistry(service, Limits(), None, {}))
    assert f"viewmend_source_frames {20 - source.span.first}\n" in text


def test_a_rig_has_the_cameras_of_its_message():
    """Its first frame may lack some of them."""
    source = PushSource()
    cameras = push._begin_rig(rig_message(), source)
    assert source.rig is not None and source.rig.cameras is cameras


POSES = json.dumps({"poses": [{"azimuth": 20.0}] * 3, "width": 32, "height": 32})


def path_of(source, **changes):
    """A path job, and a function that returns its next request."""
    job = PathJob(parse_path(json.dumps(json.loads(POSES) | changes).encode(), Limits()))
    home = home_view(CAMERAS, torch.zeros(3), UP)
    return job, lambda: job.next_request(0.0, PlaybackState(source.span, source.edge, home, source.read, 1))


def test_the_frozen_edge_of_a_live_rig_stays_until_its_video_is_finished():
    source = PushSource(memory_mb=0.1)
    source.begin("x", 10.0, BOUNDS, UP)
    source.add(photograph(CAMERAS))
    renderer = Renderer(source, SmoothFill(), PIPELINE)
    assert renderer.prepare(0)
    job, next_request = path_of(source)
    views = []
    for _ in range(2):
        request = next_request()
        assert request is not None and request.time == 0
        result = renderer.render(request, None)
        job.encode(result)
        views.append(result.completed[0].rgb)
        for _ in range(9):
            source.add(replace(photograph(CAMERAS), rgb=photograph(CAMERAS).rgb // 2))
        renderer._stream = Stream(SmoothFill(), PIPELINE, BOUNDS)  # has dropped the frame, too
    assert source.read(0) is None and torch.equal(*views)


def test_a_video_of_frames_that_a_live_rig_has_dropped_is_an_error():
    source = PushSource(memory_mb=0.1)
    source.begin("x", 10.0, BOUNDS, UP)
    source.add(photograph(CAMERAS))
    job, next_request = path_of(source, times=[0, 1, 99])
    request = next_request()
    assert request is not None and request.time == 0
    job._count = 1
    for _ in range(9):
        source.add(photograph(CAMERAS))
    with pytest.raises(RenderError, match="frame 1 is no longer in memory"):
        next_request()
    job._count = 2
    request = next_request()
    assert request is not None and request.time == source.span.newest, "the nearest frame"


def test_the_size_of_an_image_is_checked_before_decoding(monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(ProtocolError, match="expected rgb of 48 x 48 pixels, got 100000 x 100000"):
        push._decode_image(HUGE_PNG, "c0", "rgb", CAMERAS)
    jpeg = cv2.imencode(".jpg", np.zeros((40, 64), np.uint8))[1].tobytes()
    with pytest.raises(ProtocolError, match="got 64 x 40"):
        push._decode_image(jpeg, "c0", "mask", CAMERAS)


def test_a_frame_of_a_rig_that_has_disconnected_is_not_decoded(monkeypatch):
    monkeypatch.setattr(push, "_decode_image", lambda *_: pytest.fail("decoded"))
    assert push._decode_frame(frame_message(("c0", "rgb", png())), CAMERAS, lambda: True) is None


def test_a_repeated_image_is_refused():
    with pytest.raises(ProtocolError, match="one image of each camera and kind"):
        push._decode_frame(frame_message(*[("c0", "mask", png())] * 100), CAMERAS, lambda: False)


def test_a_frame_needs_two_complete_cameras():
    images = {"rgb": png(48, 48, 3, value=9), "mask": png(value=9)}

    def decode(*names):
        message = frame_message(*((name, kind, data) for name in names for kind, data in images.items()))
        return push._decode_frame(message, CAMERAS, lambda: False)

    with pytest.raises(ProtocolError, match="image and mask of two cameras or more, got 1"):
        decode("c0")
    frame = decode("c4", "c1")
    assert (
        frame.cameras.names == ("c1", "c4") and bool((frame.rgb == 9).all()) and bool((frame.mask == 9).all())
    )


def test_a_message_that_is_too_large_for_the_rig_is_not_read():
    """Six cameras of 48 x 48 pixels and the headers have a megabyte and a half."""
    size = 8 + 1_000_000 + 6 * (4 * 48 * 48 + 65_536)
    with running(PushSource(), ready=False) as server:
        for extra, codes in ((0, (4400,)), (3_000_000, (1009, None))):
            with suppress(ConnectionClosed), open_websocket(server, "/push") as rig:
                rig.send(rig_message())
                assert json.loads(rig.recv(timeout=WAIT_S))["type"] == "taken"
                rig.send(bytes(size + extra))
                assert close_code(rig) in codes
