"""Meshes and completed virtual cameras that are made while no viewer waits: which, when, and how pages get them."""

import contextlib
import json
import math

import numpy as np
import pytest
import torch
from live.live_servers import (
    CAMERAS,
    PIPELINE,
    WAIT_S,
    SmallerFill,
    get,
    open_websocket,
    running,
    say_hello,
    wait_until,
)
from live.test_assets import read_image, read_shape
from live.test_comparison import Ball
from reference.ball import BallCapture
from reference.other_device import other_device

from viewmend.live.assets import Asset, CompletedImage
from viewmend.live.completed_ahead import MAX_DRAWN, RETRY_S, CompletedAhead
from viewmend.live.frame_source import RecordedSource
from viewmend.live.poses import home_view
from viewmend.live.renderer import Renderer
from viewmend.live.sessions import ShownFrame
from viewmend.models.smooth_fill import SmoothFill
from viewmend.utils.cancellation import stop_if_cancelled

COUNT = 6
IMAGE_BYTES = 1000


class RingRenderer(Renderer):
    """Makes empty images for a ring of virtual cameras."""

    def __init__(self):
        super().__init__(
            RecordedSource(lambda: BallCapture(CAMERAS, 3)), SmoothFill(), completed_cameras=COUNT
        )
        self.virtual_cameras = CAMERAS
        self.assets_version = "a"
        self.home = home_view(CAMERAS, torch.zeros(3), None)

    def complete_virtual_camera(self, index, without, number):
        if index == 13:
            raise RuntimeError("bad luck")
        return CompletedImage({"number": 100 + number}, Asset(bytes(IMAGE_BYTES), "image/jpeg"))


class FusingRenderer(RingRenderer):
    """Makes empty meshes, too."""

    makes_meshes_ahead = True

    def fuse_mesh(self, index, without):
        return Asset(b"mesh", "application/octet-stream")


def shown(time: int, eye=None, interval_s=math.inf, without=()) -> ShownFrame:
    return ShownFrame(time, without, eye, interval_s)


@pytest.fixture
def ahead() -> CompletedAhead:
    return CompletedAhead(RingRenderer(), memory_mb=COUNT * IMAGE_BYTES / 1e6)


def make_all(ahead: CompletedAhead, *frames: ShownFrame) -> list[int]:
    """Make everything that is due; the numbers of the virtual cameras in this order."""
    numbers = []
    while task := ahead.choose(frames):
        ahead.make(task)
        numbers.append(task.camera)
    return numbers


def test_only_frames_that_a_page_draws_are_completed(ahead):
    assert ahead.choose([shown(0)]) is None
    ahead.note_drawn((0, ()))
    assert ahead.choose([shown(1)]) is None and ahead.choose([shown(0, without=("c1",))]) is None
    assert make_all(ahead, shown(0)) == list(range(COUNT))
    assert ahead.counts() == {(0, ()): COUNT} and ahead.num_made == COUNT
    assert ahead.image((0, ()), 103) is not None and ahead.image((0, ()), 3) is None


def test_the_mesh_comes_before_the_views():
    ahead = CompletedAhead(FusingRenderer())
    ahead.note_drawn((0, ()))
    assert make_all(ahead, shown(0)) == [None, *range(COUNT)]
    assert ahead.counts() == {(0, ()): 1 + COUNT} and ahead.num_made == 1 + COUNT
    mesh = ahead.mesh((0, ()))
    assert mesh is not None and mesh.content == b"mesh" and ahead.mesh((1, ())) is None


def slow_down(ahead: CompletedAhead, method: str, monkeypatch) -> list[float]:
    """Let a method of the renderer take half a second of a clock that stands still otherwise; returns the clock."""
    now = [1000.0]
    monkeypatch.setattr("viewmend.live.completed_ahead.time.monotonic", lambda: now[0])
    make = getattr(ahead._renderer, method)

    def slow(*arguments):
        now[0] += 0.5
        return make(*arguments)

    monkeypatch.setattr(ahead._renderer, method, slow)
    return now


def test_a_mesh_that_takes_longer_than_a_frame_does_not_keep_views_from_playing_frames(monkeypatch):
    ahead = CompletedAhead(FusingRenderer())
    slow_down(ahead, "fuse_mesh", monkeypatch)
    ahead.note_drawn((0, ()))
    ahead.note_drawn((1, ()))
    ahead.make(ahead.choose([shown(0, interval_s=0.1)]))
    task = ahead.choose([shown(1, interval_s=0.1)])
    assert task is not None and task.camera is not None
    assert ahead.choose([shown(1, interval_s=0.6)]).camera is None


def test_views_near_the_viewer_come_first(ahead):
    ahead.note_drawn((0, ()))
    numbers = make_all(ahead, shown(0, CAMERAS[[3]]))
    angles = (CAMERAS.centers[numbers] @ CAMERAS.centers[3]).tolist()
    assert numbers[0] == 3 and angles == sorted(angles, reverse=True)


def test_the_frames_used_last_are_kept(ahead):
    for time in (0, 1):
        ahead.note_drawn((time, ()))
        make_all(ahead, shown(time))
    assert ahead.counts() == {(1, ()): COUNT}, "memory for one frame"


def test_another_rig_starts_again(ahead):
    ahead.note_drawn((0, ()))
    make_all(ahead, shown(0))
    ahead._renderer.assets_version = "b"
    assert not ahead.counts() and ahead.choose([shown(0)]) is None


def test_a_failure_ends_the_views_of_its_frame(ahead, caplog):
    ahead.note_drawn((13, ()))
    task = ahead.choose([shown(13)])
    with pytest.raises(RuntimeError) as failure:
        ahead.make(task)
    ahead.note_failure(task, failure.value)
    assert ahead.choose([shown(13)]) is None and "bad luck" in caplog.text


def test_failures_are_logged_once_and_tried_rarely_and_old_ones_forgotten(ahead, caplog, monkeypatch):
    def fail(*_):
        raise RuntimeError("bad luck")

    monkeypatch.setattr(ahead._renderer, "complete_virtual_camera", fail)
    now = slow_down(ahead, "complete_virtual_camera", monkeypatch)
    tried_s = []
    for time in range(2 * MAX_DRAWN):
        now[0] += 1.0
        ahead.note_drawn((time, ()))
        task = ahead.choose([shown(time, interval_s=10.0)])
        if task is not None:
            tried_s.append(now[0])
            with pytest.raises(RuntimeError) as failure:
                ahead.make(task)
            ahead.note_failure(task, failure.value)
    assert len(tried_s) > 2 and min(np.diff(tried_s)) > RETRY_S and caplog.text.count("bad luck") == 1
    assert len(ahead._drawn) == MAX_DRAWN, "also of those that failed"


def test_playing_frames_are_completed_only_if_a_view_takes_less_than_a_frame(ahead, monkeypatch):
    now = slow_down(ahead, "complete_virtual_camera", monkeypatch)
    ahead.note_drawn((0, ()))
    ahead.make(ahead.choose([shown(0, interval_s=0.1)]))
    assert ahead.choose([shown(0, interval_s=0.1)]) is None, "the last view took half a second"
    assert ahead.choose([shown(0, interval_s=0.6)]) and ahead.choose([shown(0)])
    now[0] += RETRY_S
    assert ahead.choose([shown(0, interval_s=0.1)]), "tried again"


@contextlib.contextmanager
def page_of(server, **look):
    """A viewer like a page at rest: it has asked for the first frame's assets, and for a completed view."""
    with open_websocket(server) as websocket:
        say_hello(websocket)
        websocket.send(json.dumps({"type": "clock", "seek": 0, "playing": False}))
        version = server.service.renderer.assets_version
        without = ",".join(look.get("without", ()))
        assert get(f"{server.url}/assets/0?v={version}&without={without}")[0] == 200
        asked = {"type": "look", "id": 1, "full": True, "width": 32, "height": 32, "modes": ["completed"]}
        websocket.send(json.dumps(asked | look))
        yield websocket


def hear_completed(websocket, count: int) -> dict:
    """The message that names this many completed views; frames are acknowledged."""
    while True:
        message = websocket.recv(timeout=WAIT_S)
        if isinstance(message, bytes):
            websocket.send(json.dumps({"type": "ack", "frame": 0}))
            continue
        heard = json.loads(message)
        if heard["type"] == "completed" and len(heard["cameras"]) == count:
            return heard


@pytest.mark.parametrize("without", [(), ("c9", "c1")])
def test_a_page_gets_completed_views_as_further_source_images(without):
    with running(completed_cameras=4) as server, page_of(server, without=without) as page:
        heard = hear_completed(page, 4)
        assert heard["time"] == 0 and heard["without"] == sorted(without)
        real = len(CAMERAS) - len(without)
        assert sorted(camera["number"] for camera in heard["cameras"]) == [real + n for n in range(4)]
        version = server.service.renderer.assets_version
        for camera in heard["cameras"]:
            assert camera["completed"] is True
            address = f"{server.url}/assets/0/{camera['number']}?v={version}&without={','.join(without)}"
            status, headers, content = get(address)
            assert status == 200 and "immutable" in headers["Cache-Control"]
            rgb, mask = read_image(content, camera)
            assert rgb.shape[:2] == mask.shape == (camera["height"], camera["width"]) and mask.max() > 200
        assert get(f"{server.url}/assets/0/{real + 4}?v={version}")[0] == 404


def volume_m3(about, arrays) -> float:
    """The volume within a closed mesh: the sum of signed tetrahedra between its faces and the origin."""
    positions = np.array(about["positions"]["low"]) + about["positions"]["step"] * arrays["positions"]
    a, b, c = positions[arrays["faces"].reshape(-1, 3)].swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum()) / 6


def test_a_page_gets_a_mesh_fused_from_predicted_depth():
    with running(inpainter=SmallerFill(), completed_cameras=2) as server, page_of(server) as page:
        version = server.service.renderer.assets_version
        assert hear_completed(page, 2)["mesh"] is True
        _, about, hull = read_shape(get(f"{server.url}/assets/0?v={version}")[2])
        status, headers, content = get(f"{server.url}/assets/0/mesh?v={version}")
        assert status == 200 and "immutable" in headers["Cache-Control"]
        header, small, fused = read_shape(content)
        assert header["time"] == 0 and "cameras" not in header and header["blend"]

        assert 0.1 * volume_m3(about, hull) < volume_m3(small, fused) < 0.8 * volume_m3(about, hull)
        assert get(f"{server.url}/assets/1/mesh?v={version}")[0] == 404, "this frame was not shown"


@pytest.mark.slow
def test_a_mesh_is_fused_on_another_device(monkeypatch):
    def fused(device):
        renderer = Renderer(Ball(), SmallerFill(), PIPELINE, completed_cameras=2)
        renderer._device = device
        assert renderer.prepare(0)
        renderer.fuse_mesh(0, ())
        _, about, arrays = read_shape(renderer.fuse_mesh(1, ()).content)
        return volume_m3(about, arrays)

    expected = fused("cpu")
    with other_device(monkeypatch) as device:
        assert fused(device) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("without", [(), ("c1",)])
def test_views_are_completed_behind_the_fused_mesh_of_their_frame(without):
    renderer = Renderer(Ball(), SmallerFill(), PIPELINE, completed_cameras=2)
    assert renderer.prepare(0)

    def shown_px(index: int) -> int:
        image = renderer.complete_virtual_camera(index, without, 0)
        return int((read_image(image.asset.content, image.camera)[1] > 127).sum())

    behind_hull = shown_px(0)
    renderer.fuse_mesh(0, without)
    assert 0.1 * behind_hull < shown_px(0) < 0.8 * behind_hull
    assert shown_px(1) == pytest.approx(behind_hull, rel=0.1), "frame 1 has no fused mesh"


def test_without_a_page_that_draws_nothing_is_completed_ahead():
    with running(completed_cameras=4) as server, open_websocket(server) as viewer:
        say_hello(viewer)
        viewer.send(json.dumps({"type": "look", "id": 1, "width": 32, "height": 32}))
        wait_until(lambda: server.service.counts["frames"] >= 1)
        assert not server.service.make_ahead() and server.service.ahead.num_made == 0


@pytest.mark.parametrize("news", [{"type": "look", "id": 2, "full": True}, {"type": "clock", "seek": 1}])
def test_a_view_that_a_viewer_asks_for_comes_first_and_an_old_frame_is_dropped(news):
    begun = []

    def complete_for_ever(*arguments):
        begun.append(arguments)
        while True:
            stop_if_cancelled()

    with running(completed_cameras=4) as server:
        server.service.renderer.complete_virtual_camera = complete_for_ever
        with page_of(server) as page:
            while not isinstance(page.recv(timeout=WAIT_S), bytes):
                pass
            page.send(json.dumps({"type": "ack", "frame": 0}))
            wait_until(lambda: begun)
            page.send(json.dumps(news))
            while not isinstance(page.recv(timeout=WAIT_S), bytes):
                pass
        assert server.service.ahead.num_made == 0
