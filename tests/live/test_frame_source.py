"""Recordings are read ahead within a memory limit; playback clocks follow the edge, or leave it."""

import threading

import pytest
from live.live_servers import CAMERAS, wait_until
from reference.ball import BallCapture

from viewmend.data.prepare import PreparedCapture
from viewmend.live import frame_source
from viewmend.live.frame_source import Clock, FrameCache, RecordedSource, Span
from viewmend.live.protocol import ClockChange
from viewmend.live.push import LiveSource


class Stepped(BallCapture):
    """Reads a frame whenever a test permits it."""

    def __init__(self, frames=20):
        super().__init__(CAMERAS, frames)
        self.permits, self.order = threading.Semaphore(0), []

    def read(self, time):
        self.permits.acquire()
        self.order.append(time)
        return super().read(time % 9)


@pytest.fixture
def reading():
    sources = []

    def start(capture, **options):
        source = RecordedSource(lambda: capture, **options)
        sources.append((source, capture))
        source.start()
        return source

    yield start
    for source, capture in sources:
        capture.permits.release(1000)
        source.stop()


def read(capture, count):
    expected = len(capture.order) + count
    capture.permits.release(count)
    wait_until(lambda: len(capture.order) >= expected)


def test_the_requested_frame_is_read_first_and_then_the_following_ones(reading):
    capture = Stepped()
    source = reading(capture)
    wait_until(lambda: source.span.end == 20)
    read(capture, 2)
    assert source.read(11) is None
    capture.permits.release(1000)
    wait_until(lambda: {11, 12, 13, 14} <= set(capture.order))
    assert capture.order[:2] == [0, 1] and 11 in capture.order[2:4] and 4 not in capture.order


def test_generated_frames_can_be_requested_once_they_exist(reading):
    capture = Stepped(5)
    source = reading(capture, generated=True, fps=7.0)
    wait_until(lambda: source.rig is not None)
    assert source.span.end == 0 and source.status.state == "loading"
    read(capture, 3)
    wait_until(lambda: source.span.end == 3)
    assert source.span.total == 5 and source.span.fps == 7 and not source.span.complete
    read(capture, 2)
    wait_until(lambda: source.span.complete)
    assert capture.order == [0, 1, 2, 3, 4] and source.status.state == "ready"


def test_a_recording_has_all_cameras_that_its_frames_may_have():
    prepared = PreparedCapture(BallCapture(CAMERAS), left_out=CAMERAS.names[2:3])
    for capture, names in (
        (prepared.source, CAMERAS.names),
        (prepared, CAMERAS.names[:2] + CAMERAS.names[3:]),
    ):
        source = RecordedSource(lambda capture=capture: capture)
        source._open()
        assert source.rig is not None and source.rig.cameras.names == names


def test_dropped_frames_are_read_again(reading):
    capture = Stepped(9)
    source = reading(capture, memory_mb=0.3)
    capture.permits.release(1000)
    for index in (*range(9), 0, 5):
        wait_until(lambda index=index: source.read(index) is not None)
        assert source.read(index).time == index
    assert capture.order.count(0) >= 2


def test_reading_ahead_ends_when_the_memory_is_full(reading):
    capture = Stepped(9)
    source = reading(capture, memory_mb=0.12)  # two frames of six images
    read(capture, 2)
    capture.permits.release(1000)
    wait_until(lambda: source._next_index() is None)
    assert capture.order == [0, 1] and source.read(0) is not None


def test_failures_are_reported_once_and_tried_again(caplog, monkeypatch):
    monkeypatch.setattr(frame_source, "RETRY_S", 0.05)
    attempts = []

    def open_capture():
        attempts.append(1)
        if len(attempts) < 3:
            raise ValueError("no such rig")
        return BallCapture(CAMERAS, 1)

    source, statuses = RecordedSource(open_capture), []
    source.changed = lambda: statuses.append((source.status.state, source.status.error))
    source.start()
    wait_until(lambda: source.status.state == "ready")
    source.stop()
    assert statuses[:2] == 2 * [("failing", "ValueError: no such rig")] and statuses[2] == ("ready", None)
    assert source.span.fps == 0 and caplog.messages == ["while reading: ValueError: no such rig"]


@pytest.mark.parametrize(("by_last_use", "left"), [(True, [0, 3, 4]), (False, [2, 3, 4])])
def test_the_oldest_or_the_least_recently_used_frames_are_dropped(by_last_use, left):
    frame = BallCapture(CAMERAS, 1).read(0)
    cache = FrameCache(3.5e-6 * (frame.rgb.numel() + frame.mask.numel()), by_last_use)
    for index in range(5):
        cache.put(index, frame)
        assert cache.get(0) is not None or not by_last_use
    assert [index for index in range(5) if index in cache] == left


RECORDING = Span(0, 30, 30, 10.0)
LIVE = Span(5, 50, None, 10.0, live=True)


def changed(**change) -> Clock:
    clock = Clock()
    clock.change(ClockChange(**change), RECORDING)
    return clock


def test_a_recording_starts_again_at_its_end():
    clock = changed(seek=0)
    frames = []
    for _ in range(70):
        clock.advance(0.05, RECORDING, 3.0)
        frames.append(clock.frame(RECORDING))
    assert frames[:4] == [0, 1, 1, 2] and max(frames) == 29 and frames[-1] == 5


def test_playback_waits_at_the_end_of_a_recording_that_is_still_generated():
    clock, growing = changed(seek=0), Span(0, 3, 30, 10.0)
    clock.advance(5.0, growing)
    assert clock.frame(growing) == 2 and not growing.complete
    clock.advance(0.1, Span(0, 10, 30, 10.0))
    assert clock.frame(Span(0, 10, 30, 10.0)) == 3


def test_a_clock_follows_the_edge_until_it_is_changed():
    clock = Clock()
    clock.advance(0.1, RECORDING, 17.3)
    assert clock.frame(RECORDING) == 17
    clock.change(ClockChange(playing=False), RECORDING)
    clock.advance(9.0, RECORDING, 25.0)
    assert clock.frame(RECORDING) == 17 and not clock.live
    clock.change(ClockChange(playing=True), RECORDING)
    clock.advance(0.2, RECORDING, 25.0)
    assert clock.frame(RECORDING) == 19
    clock.change(ClockChange(live=True), RECORDING)
    clock.advance(0.2, RECORDING, 25.0)
    assert clock.frame(RECORDING) == 25


def test_speed_and_seek():
    clock = changed(speed=2.0)
    assert not clock.live
    clock.advance(1.0, RECORDING, 3.0)
    assert clock.frame(RECORDING) == 20
    assert changed(speed=1.0).live
    assert changed(seek=999).frame(RECORDING) == 29 and changed(seek=-5).frame(RECORDING) == 0


def test_the_clock_of_a_live_rig_stays_within_its_frames():
    source, clock = LiveSource(), Clock()
    source.span = LIVE
    assert source.edge == 49.0
    clock.change(ClockChange(seek=0), LIVE)
    assert clock.frame(LIVE) == 5
    clock.advance(100.0, LIVE, 49.0)
    assert clock.frame(LIVE) == 49


def test_spans_without_frames_or_with_one():
    clock = Clock()
    clock.advance(1.0, Span(), 0.0)
    assert clock.frame(Span()) == -1
    single = Span(0, 1, 1, 0.0)
    clock.change(ClockChange(seek=0), single)
    clock.advance(100.0, single)
    assert clock.frame(single) == 0
