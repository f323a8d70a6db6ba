"""Frames at hand: read ahead, made ahead, bounded, pushed."""

import threading
from time import sleep

import pytest
from live_servers import CAMERAS, wait_until
from reference.ball import BallCapture

from viewmend.live.frames import FrameCache, ReadAhead


class Slow(BallCapture):
    """Reads a frame when it is allowed to."""

    def __init__(self, frames=20):
        super().__init__(CAMERAS, frames)
        self.turns, self.order = threading.Semaphore(0), []

    def read(self, time):
        self.turns.acquire()
        self.order.append(time)
        return super().read(time % 9)


@pytest.fixture
def reading():
    supplies = []

    def start(source, **options):
        supply = ReadAhead(lambda: source, **options)
        supplies.append((supply, source))
        supply.start()
        return supply

    yield start
    for supply, source in supplies:
        source.turns.release(1000)
        supply.stop()


def read(source, supply, count):
    done = len(source.order) + count
    source.turns.release(count)
    wait_until(lambda: len(source.order) >= done)


def test_what_is_wanted_is_read_first_with_what_follows(reading):
    source = Slow()
    supply = reading(source)
    wait_until(lambda: supply.span.end == 20)
    read(source, supply, 2)
    assert supply.read(11) is None
    source.turns.release(1000)
    wait_until(lambda: {11, 12, 13, 14} <= set(source.order))
    assert source.order[:2] == [0, 1] and 11 in source.order[2:4] and 4 not in source.order


def test_what_is_made_can_be_asked_for_as_far_as_it_is(reading):
    source = Slow(5)
    supply = reading(source, generated=True, fps=7.0)
    wait_until(lambda: supply.rig is not None)
    assert supply.span.end == 0 and supply.status.state == "loading"
    read(source, supply, 3)
    wait_until(lambda: supply.span.end == 3)
    assert supply.span.total == 5 and supply.span.fps == 7 and not supply.span.complete
    read(source, supply, 2)
    wait_until(lambda: supply.span.complete)
    assert source.order == [0, 1, 2, 3, 4] and supply.status.state == "ready"


def test_memory_is_bounded_and_what_was_dropped_is_read_again(reading):
    source = Slow(9)
    supply = reading(source, memory_mb=0.3)
    source.turns.release(1000)
    for time in (*range(9), 0, 5):
        wait_until(lambda time=time: supply.read(time) is not None)
        assert supply.read(time).time == time
    assert source.order.count(0) >= 2


def test_where_few_frames_have_room_reading_ahead_comes_to_rest(reading):
    source = Slow(9)
    supply = reading(source, memory_mb=0.12)  # two frames of six images
    source.turns.release(1000)
    wait_until(lambda: supply.read(0) is not None)
    sleep(0.5)
    assert source.order == [0, 1] and supply.read(0) is not None


def test_failures_are_said_and_tried_again(caplog):
    tries = []

    def opens():
        tries.append(1)
        if len(tries) < 3:
            raise ValueError("no such rig")
        return BallCapture(CAMERAS, 1)

    supply = ReadAhead(opens)
    supply.start()
    wait_until(lambda: supply.status.state == "failing")
    assert supply.status.error == "ValueError: no such rig"
    wait_until(lambda: supply.status.state == "ready")
    assert supply.status.error is None and supply.span.fps == 0
    assert caplog.messages == ["while reading: ValueError: no such rig"], "once, in the terminal"
    supply.stop()


@pytest.mark.parametrize(("by_last_use", "left"), [(True, [0, 3, 4]), (False, [2, 3, 4])])
def test_what_was_used_last_is_dropped_last(by_last_use, left):
    frame = BallCapture(CAMERAS, 1).read(0)
    cache = FrameCache(3.5e-6 * (frame.rgb.numel() + frame.mask.numel()), by_last_use)
    for time in range(5):
        cache.put(time, frame)
        assert cache.get(0) is not None or not by_last_use
    assert [time for time in range(5) if time in cache] == left
