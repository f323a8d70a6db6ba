"""Frames are shared without copies: one process reads and carves, others render. Here in one process, but pickled."""

import math
import pickle
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from live.live_servers import CAMERAS, PIPELINE, WAIT_S, FakeClock, wait_until
from reference.ball import BallCapture, photograph

from viewmend.contrib.ray import shared_frame
from viewmend.contrib.ray.ingest import Ingest
from viewmend.contrib.ray.shared_frame import SharedFrame
from viewmend.contrib.ray.shared_source import SharedSource
from viewmend.frame_cache import cache_frame
from viewmend.live.frame_source import RecordedSource
from viewmend.live.poses import view_camera
from viewmend.live.protocol import Camera
from viewmend.live.push import PushSource
from viewmend.live.renderer import Renderer, RenderRequest
from viewmend.models.base import ContextProvider, RenderQuality
from viewmend.models.registry import make_method
from viewmend.models.smooth_fill import SmoothFill

FRAMES = 5
INGESTS: list[Ingest] = []
"""The ingests of the test that runs; their threads wait until the process ends."""
MAX_PICKLE_BYTES = 20_000
"""For names, shapes and the like; the arrays have some hundred thousand bytes."""


def send(shared):
    """The frame in another process, the read-only buffers of its arrays, and the rest of the pickle."""
    out_of_band = []
    content = pickle.dumps(shared, protocol=5, buffer_callback=out_of_band.append)
    buffers = [memoryview(bytes(buffer.raw())) for buffer in out_of_band]
    return pickle.loads(content, buffers=buffers), buffers, content


def ball_frame(inpainter=None):
    return SharedFrame.prepare(photograph(CAMERAS, 3), None, PIPELINE.hull, inpainter or SmoothFill())


def tensors_of(shared):
    frame, cached = shared.frame, shared.cached
    pyramids = [level for made in cached.encoded.values() for level in made.levels]
    return [frame.rgb, frame.mask, cached.proxy.mesh.vertices, *cached.depths.values(), *pyramids]


def test_arrays_are_not_copied():
    shared = ball_frame(make_method("views"))
    got, buffers, content = send(shared)
    assert len(content) < MAX_PICKLE_BYTES < shared.size_bytes
    places = {np.frombuffer(buffer, np.uint8).ctypes.data for buffer in buffers}
    for before, after in zip(tensors_of(shared), tensors_of(got), strict=True):
        assert torch.equal(before, after) and after.data_ptr() in places
    assert (
        got.frame.time == 3
        and got.frame.cameras.names == CAMERAS.names
        and got.size_bytes == shared.size_bytes
    )


def test_a_stream_has_nothing_left_to_compute():
    model = make_method("views")
    own = cache_frame(photograph(CAMERAS, 3), None, PIPELINE.hull)
    got = send(ball_frame(model))[0].cached
    assert torch.equal(own.proxy.mesh.vertices, got.proxy.mesh.vertices)
    assert torch.equal(own.depth(CAMERAS.names), torch.stack([got.depths[name] for name in CAMERAS.names]))
    model.encode_cameras(
        own.context(CAMERAS.names), ContextProvider(lambda *_: None, memory=lambda _: own.encoded)
    )
    assert own.encoded.keys() == got.encoded.keys() and len(got.encoded) == 2 * len(CAMERAS)


def test_a_frame_without_a_hull():
    frame = photograph(CAMERAS[:1], 0)
    got, *_ = send(SharedFrame.prepare(frame, None, PIPELINE.hull, SmoothFill()))
    assert got.cached is None and torch.equal(got.frame.rgb, frame.rgb)
    frame = photograph(CAMERAS, 0)
    empty = replace(frame, mask=0 * frame.mask)
    got, *_ = send(SharedFrame.prepare(empty, None, PIPELINE.hull, SmoothFill()))
    assert len(got.cached.proxy.mesh.vertices) == 0


class Link:
    """A connection to an ingest that may end and be replaced; records the requests."""

    def __init__(self, ingest):
        self.ingest, self.requests = ingest, []

    def state(self, known, wait_s, watched):
        self._check()
        return self.ingest.state(known, min(wait_s, 0.05), watched)

    def frame(self, index, wait_s):
        self._check()
        self.requests.append(index)
        found = self.ingest.frame(index, WAIT_S)  # however busy the machine is
        return None if found is None else (found[0], send(found[1])[0])

    def _check(self):
        if self.ingest is None:
            raise ConnectionError("it has ended")


def recording(frames=FRAMES, fps=None):
    return RecordedSource(lambda: BallCapture(CAMERAS, frames), fps, memory_mb=50.0)


def ingest_of(source, memory_mb=50.0, **options):
    ingest = Ingest(source, SmoothFill(), PIPELINE.hull, memory_mb, **options)
    INGESTS.append(ingest)
    return ingest


@pytest.fixture(autouse=True)
def _idle_ingests():
    """No frame is prepared after its test: a kernel that runs while Python ends would abort the process."""
    yield
    for ingest in INGESTS:
        ingest._watched_at = -math.inf
    INGESTS.clear()


@pytest.fixture
def link():
    """A link to a recording whose edge stays at 0."""
    source = recording()
    source.recording.playing = False
    yield Link(ingest_of(source))
    source.stop()


@pytest.fixture
def follow():
    """Starts sources that follow a link, and stops them."""
    started = []

    def start(link, memory_mb=50.0, **options):
        source = SharedSource(link, memory_mb, **options)
        source.start()
        started.append(source)
        wait_until(lambda: source.rig is not None)
        return source

    yield start
    for source in started:
        source.stop()


@pytest.fixture
def carved(monkeypatch):
    """The frames whose hulls were carved."""
    frames, carve = [], shared_frame.cache_frame
    monkeypatch.setattr(
        shared_frame, "cache_frame", lambda *given: frames.append(given[0].time) or carve(*given)
    )
    return frames


def fetch(source, index):
    wait_until(lambda: source.read(index) is not None)
    return source.read(index)


def test_all_followers_get_what_was_carved_once(link, follow, carved):
    one, other = follow(link), follow(link)
    assert torch.equal(fetch(one, 2).rgb, fetch(other, 2).rgb)
    assert one.span == other.span and one.span.end == FRAMES and one.rig.name == other.rig.name
    wait_until(lambda: 3 in one._kept and 3 in other._kept)
    assert sorted(carved) == [2, 3], "each once, and one ahead"
    cached = one.read_cached(2)
    assert cached.depths.keys() == set(CAMERAS.names) and len(cached.proxy.mesh.vertices) > 100


def test_a_rendering_process_renders_the_same_pixels(link, follow):
    alone = recording()
    alone.start()
    results = []
    for source in (alone, follow(link)):
        fetch(source, 1)
        renderer = Renderer(source, SmoothFill(), PIPELINE)
        assert renderer.prepare(1)
        camera = view_camera(Camera(azimuth=33.0), renderer.home, (64, 64))
        fetch(source, 2)
        result = renderer.render(RenderRequest(2, (camera,), RenderQuality()), None)
        results.append((result.completed[0].rgb, result.times.geometry, renderer.rig_json))
    alone.stop()
    (rgb, geometry_ms, rig), (shared_rgb, shared_ms, shared_rig) = results
    assert torch.equal(rgb, shared_rgb) and rgb.any()
    assert rig | {"assets": shared_rig["assets"]} == shared_rig, "a version of each process"
    assert shared_ms == 0 < geometry_ms, "the ingest has carved the hull"


def test_an_ingest_that_ends_is_reported_and_its_successor_followed(link, follow):
    source = follow(link)
    fetch(source, 2)
    first, link.ingest = source.rig, None
    wait_until(lambda: source.status.state == "failing")
    assert "is being restarted" in source.status.error
    assert source.read(2) is not None, "frames in memory can still be shown"
    restarted = recording()
    link.ingest = ingest_of(restarted)
    wait_until(lambda: source.rig is not first)
    assert source.rig.number == first.number, "but its frames are others"
    fetch(source, 2)
    wait_until(lambda: source.status.state == "ready")
    restarted.stop()


def pushing(follow, **options):
    """A pushed rig with one frame, a link to its ingest, and a follower."""
    pushed = PushSource()
    link = Link(ingest_of(pushed))
    pushed.begin("one", 15.0, None, None)
    frame = BallCapture(CAMERAS, 1).read(0)
    pushed.add(frame)
    return pushed, frame, link, follow(link, **options)


def test_the_cameras_that_a_rig_has_found_with_its_first_frame_are_followed(follow):
    """A rig that reads its cameras knows their alignment only then."""
    pushed = PushSource()
    pushed.begin("one", 15.0, None, None)
    source = follow(Link(ingest_of(pushed)))
    assert source.rig.cameras is None
    pushed.rig = replace(pushed.rig, cameras=CAMERAS)
    pushed.add(BallCapture(CAMERAS, 1).read(0))
    wait_until(lambda: source.span.end == 1)
    assert source.rig.cameras is not None and source.rig.cameras.names == CAMERAS.names


def test_a_new_rig_replaces_the_earlier_one(follow):
    pushed, frame, _, source = pushing(follow)
    assert fetch(source, 0) is not None and source.span.live
    before = source.rig
    pushed.begin("two", 15.0, None, None)
    pushed.add(frame)
    wait_until(lambda: source.rig.name == "two")
    assert source.rig is not before and source.read(0) is None
    assert fetch(source, 1).time == 1
    wait_until(lambda: source.span.end == 2)
    same = source.rig
    pushed.add(frame)
    wait_until(lambda: source.span.end == 3)
    assert source.rig is same, "a new frame is not a new rig"


def test_all_followers_of_the_edge_get_the_same_frames_however_slow_carving_is(follow, carved):
    clock = FakeClock()
    source = recording(1000, fps=30.0)
    link = Link(ingest_of(source, now=clock))
    followers = [follow(link, now=clock) for _ in range(2)]
    shown = [[], []]
    for _ in range(8):
        for follower, frames in zip(followers, shown, strict=True):
            wait_until(lambda f=follower: f.read(int(f.edge)) is not None and int(f.edge) == link.ingest._led)
            frames.append(int(follower.edge))
        clock.advance(0.2)  # six frames
        led = link.ingest._led
        wait_until(
            lambda led=led: link.ingest._led > led or any(f.read(int(f.edge)) is None for f in followers)
        )
        wait_until(lambda led=led: link.ingest._led > led)
    source.stop()
    assert shown[0] == shown[1], "both show the frames that were prepared"
    assert shown[0][-1] - shown[0][0] >= 6 * 7 - 1, "and the edge moves at its own speed"
    # A frame that is no longer the edge when it arrives is followed by the next one.
    led = {*shown[0], link.ingest._led}
    assert all(index in led or index - 1 in led for index in carved), "frames between them are not carved"


def test_nothing_is_prepared_while_the_edge_is_not_watched(follow):
    clock = FakeClock()
    source = recording()
    link = Link(ingest_of(source, now=clock))
    follower = follow(link, now=clock)
    clock.advance(0.25)
    wait_until(lambda: follower.recording.position > 0)
    assert link.requests == [] and not link.ingest._kept
    source.stop()


def test_frames_of_a_live_rig_appear_once_they_are_prepared(follow, monkeypatch):
    clock = FakeClock()
    pushed, frame, link, source = pushing(follow, now=clock)
    fetch(source, 0)
    wait_until(lambda: link.ingest._led == 0)
    is_carving, may_carve, carve = threading.Event(), threading.Event(), shared_frame.cache_frame

    def carve_later(*given):
        is_carving.set()
        may_carve.wait()
        return carve(*given)

    monkeypatch.setattr(shared_frame, "cache_frame", carve_later)
    pushed.add(frame)
    assert is_carving.wait(WAIT_S)
    version = link.ingest._version
    wait_until(lambda: link.ingest.state(version - 1, 0.0, True).version == version)
    assert source.read(0) is not None and source.span.newest == 0
    may_carve.set()
    wait_until(lambda: source.read(source.span.newest) is not None and source.span.newest == 1)


def test_memory_is_bounded(follow):
    source = recording()
    ingest = ingest_of(source, memory_mb=0.001)
    follower = follow(Link(ingest), memory_mb=0.001)
    for index in range(FRAMES):
        fetch(follower, index)
        assert len(follower._kept) <= 2
        wait_until(lambda: len(ingest._kept) == 1)
    source.stop()


def test_a_request_for_a_missing_frame_does_not_delay_others(link, monkeypatch):
    wait_until(lambda: link.ingest.frame(0, 1.0) is not None)
    source, missing, is_released = link.ingest._source, FRAMES + 7, threading.Event()
    is_asked, read = threading.Event(), source.read

    def read_later(index):
        if index != missing:
            return read(index)
        is_asked.set()
        return read(0) if is_released.is_set() else None

    monkeypatch.setattr(source, "read", read_later)
    waiting = threading.Thread(target=link.ingest.frame, args=(missing, 600.0))
    waiting.start()
    assert is_asked.wait(WAIT_S)
    assert link.ingest.frame(0, 1.0) is not None and waiting.is_alive()
    is_released.set()
    link.ingest._notify()
    waiting.join()
