"""Pictures put together by when they were taken."""

import numpy as np
import pytest

from viewmend.contrib.live_rig.aligner import EXTRA_GROUPS, Aligner, TimedImages
from viewmend.data.camera_images import CameraImages

IMAGES = CameraImages(np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.uint8), None)
FRAME_S = 0.1


def aligner(names="abc", tolerance_s=FRAME_S / 2, wait_s=0.2):
    return Aligner(tuple(names), FRAME_S, tolerance_s, wait_s)


def put(rig, names, taken_s, now_s=None):
    """A picture of each of these cameras, by default at once."""
    for name in names:
        rig.put(name, TimedImages(taken_s, IMAGES), taken_s if now_s is None else now_s)


def times(group):
    return {name: round(timed.taken_s, 6) for name, timed in group.by_camera.items()}


def test_cameras_that_run_apart_come_group():
    rig, phase = aligner(), {"a": 0.0, "b": 0.03, "c": -0.02}
    for n in range(20):
        for name, phase_s in phase.items():
            put(rig, name, 5 + n * FRAME_S + phase_s, 5.01 + n * FRAME_S + 0.03)
        [group] = rig.take(5.05 + n * FRAME_S)
        assert times(group) == {name: round(5 + n * FRAME_S + p, 6) for name, p in phase.items()}
        assert group.spread_s == pytest.approx(0.05)
    assert all(counts == {"used": 20} for counts in rig.counts.values())


def test_cameras_of_different_delays_come_group():
    """One place a camera would never do here: when the slow one's picture comes, the fast one is two further."""
    rig, seen = aligner("ab", wait_s=0.5), []
    events = [
        (n * FRAME_S + delay_s, name, n * FRAME_S)
        for n in range(20)
        for name, delay_s in (("a", 0), ("b", 0.25))
    ]
    for now_s, name, taken_s in sorted(events):
        put(rig, name, taken_s, now_s)
        seen += [times(group) for group in rig.take(now_s)]
    # While the slow one was not heard yet nobody waits for it: its first pictures are late.
    assert seen[0].keys() == {"a"} and rig.counts["b"]["late"] == 3
    assert seen[3:] == [{"a": round(n * FRAME_S, 6), "b": round(n * FRAME_S, 6)} for n in range(3, 20)]


def test_a_lost_picture_is_waited_for_only_so_long():
    rig = aligner()
    put(rig, "abc", 1.0)
    assert len(rig.take(1.0)) == 1
    put(rig, "ab", 1.1)
    assert rig.take(1.29) == []
    [group] = rig.take(1.31)
    assert set(group.by_camera) == {"a", "b"} and rig.counts["c"]["missing"] == 1
    put(rig, "c", 1.1, 1.32)
    assert rig.take(1.4) == [] and rig.counts["c"]["late"] == 1


def test_whoever_is_past_a_time_does_not_hold_it_up():
    rig = aligner("ab")
    put(rig, "ab", 1.0)
    rig.take(1.0)
    put(rig, "a", 1.1)
    put(rig, "b", 1.2)
    [group] = rig.take(1.2)
    assert times(group) == {"a": 1.1}


def test_cameras_that_are_away_are_not_waited_for():
    rig = aligner()
    put(rig, "abc", 1.0)
    rig.take(1.0)
    put(rig, "ab", 1.6)
    assert len(rig.take(1.6)) == 1 and rig.counts["c"] == {"used": 1}


def test_a_clock_that_jumps_takes_nobody_along():
    rig = aligner("ab")
    for n in range(10):
        now_s = 1 + n * FRAME_S
        put(rig, "a", now_s)
        put(rig, "b", now_s + (1000 if n % 2 else 0), now_s)
        rig.take(now_s + 0.3)
    assert rig.counts["a"]["used"] == 10 and rig.counts["b"] == {"used": 5, "misaligned": 5, "missing": 5}


def test_a_fast_camera_with_a_wrong_clock_does_not_set_the_first_tick():
    rig = Aligner(("a", "b", "c"), 2 * FRAME_S, tolerance_s=0.01, wait_s=0.2)
    assert rig.wants(1000.13, FRAME_S)
    put(rig, "c", 1000.13, 1.0)
    put(rig, "ab", 1.0)
    [group] = rig.take(1.3)
    assert times(group) == {"a": 1.0, "b": 1.0} and rig.counts["c"]["misaligned"] == 1


def test_a_camera_whose_clock_is_in_the_future_is_not_waited_for():
    rig = aligner()
    put(rig, "ab", 1.0)
    rig.put("c", TimedImages(9.0, IMAGES), 1.0)
    [group] = rig.take(1.0)
    assert times(group) == {"a": 1.0, "b": 1.0} and rig.counts["c"] == {"misaligned": 1}


def test_pictures_far_from_their_time_are_left_out():
    rig = aligner("ab", tolerance_s=0.01)
    put(rig, "a", 1.0)
    put(rig, "b", 1.02)
    [group] = rig.take(1.3)
    assert times(group) == {"a": 1.0} and rig.counts["b"]["misaligned"] == 1


def test_of_two_pictures_the_nearer_one_is_taken():
    rig = aligner("ab")
    put(rig, "a", 1.0, 1.1)
    for taken_s in (1.04, 1.01, 0.97):
        put(rig, "b", taken_s, 1.1)
    [group] = rig.take(1.1)
    assert times(group)["b"] == 1.01 and rig.counts["b"]["surplus"] == 2


def test_what_nobody_takes_is_bounded_and_the_newest_wins():
    rig = aligner("ab", wait_s=0.3)
    for n in range(100):
        put(rig, "ab", n * FRAME_S)
    out = rig.take(99 * FRAME_S)
    assert [round(group.by_camera["a"].taken_s / FRAME_S) for group in out] == list(
        range(100 - EXTRA_GROUPS - 3, 100)
    )
    assert rig.counts["a"] == {"used": EXTRA_GROUPS + 3, "replaced": 100 - EXTRA_GROUPS - 3}


def test_the_line_follows_cameras_of_another_rate():
    """Cameras of 9.9 pictures a second in a rig of 10: a tick a picture, for minutes."""
    rig, out = aligner("ab", tolerance_s=0.03), 0
    for n in range(3000):
        put(rig, "ab", n / 9.9)
        out += len(rig.take(n / 9.9))
    assert out == 3000 and all(counts == {"used": 3000} for counts in rig.counts.values())


def test_a_slower_rig_takes_each_cameras_picture_at_its_ticks():
    rig = Aligner(("a", "b"), 2 * FRAME_S, FRAME_S, 0.2)
    put(rig, "a", 0.0)
    for phase_s in (0.0, 0.02):
        assert [n for n in range(40) if rig.wants(n * FRAME_S + phase_s, FRAME_S)] == list(range(0, 40, 2))
    assert all(rig.wants(n * 0.2 + 0.05, 2 * FRAME_S) for n in range(40))


@pytest.mark.parametrize(
    ("interval_s", "period_s"),
    [
        (0.2, 0.1),
        (0.5, 0.1),
        (0.5, 0.5),
        (1.0, 0.1),
        (1.0, 1.0),
        (2.0, 0.1),
        (2.0, 1.0),
        (2.0, 2.0),
        (10.0, 0.1),
    ],
)
def test_a_slow_rig_waits_for_its_cameras(interval_s, period_s):
    """Its images come one after the other, 20 ms apart; a worker does not know periods of a second or more."""
    rig, seen = Aligner(("a", "b", "c"), interval_s, interval_s / 2, wait_s=0.2), []
    known_s = period_s if period_s < 1 else 0.0
    arrivals = [
        (n * period_s + delay_s, name, n * period_s)
        for n in range(round(5 * interval_s / period_s) + 1)
        for name, delay_s in (("a", 0.02), ("b", 0.04), ("c", 0.06))
    ]
    for now_s, name, taken_s in sorted(arrivals):
        if rig.wants(taken_s, known_s):
            rig.put(name, TimedImages(taken_s, IMAGES), now_s)
            seen += rig.take(now_s)
    assert len(seen) >= 5
    assert all(len(group.by_camera) == 3 for group in seen[1:])
