"""Which cameras colour a view."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.ball import camera_at, ring

from viewmend.geometry.cameras import concatenate_cameras
from viewmend.rendering.selection import angles_to, select_closest, select_covering

CENTER = torch.zeros(3)


def test_angles_are_those_at_the_subject():
    # Distance does not count: the second camera is much nearer.
    cameras = concatenate_cameras([camera_at(30, "a"), camera_at(100, "b", distance_m=0.8), camera_at(10.001, "c")])
    degrees = torch.rad2deg(angles_to(camera_at(10, "t"), cameras, CENTER))
    torch.testing.assert_close(degrees, torch.tensor([20.0, 90.0, 0.001]), atol=2e-4, rtol=0)


def test_the_closest_come_nearest_first():
    assert select_closest(camera_at(100, "t"), ring(12), CENTER) == ("c3", "c4", "c2")
    assert select_closest(camera_at(100, "t"), ring(12), CENTER, exclude=["c3"]) == ("c4", "c2", "c5")
    assert select_closest(camera_at(0, "t"), ring(2), CENTER, k=3) == ("c0", "c1")


names = st.lists(st.sampled_from([f"c{i}" for i in range(8)]), max_size=8)


CAMERAS = ring(8)


@settings(max_examples=40, deadline=None)
@given(st.floats(0, 360), st.integers(1, 5), names, names)
def test_nothing_bypasses_the_exclusion(angle, k, exclude, previous):
    cameras = CAMERAS
    closest = select_closest(camera_at(angle, "t"), cameras, CENTER, 8, exclude)
    assert not set(closest) & set(exclude)
    # Excluded cameras see everything, and were chosen before: neither greed nor hysteresis may take them.
    evidence = torch.tensor([[1.0 if name in exclude else 0.5] for name in cameras.names]).expand(8, 20)
    chosen = select_covering(evidence, cameras.names, closest, k, previous, keep_share=0.0)
    assert not set(chosen) & set(exclude)
    assert len(chosen) == len(set(chosen)) == min(k, 8 - len(set(exclude)))


def test_covering_takes_what_adds_most():
    evidence = torch.zeros(4, 10)
    evidence[0, :5] = 1  # most
    evidence[1, 1:5] = 1  # nothing new beside the first
    evidence[2, 5:8] = 0.5
    evidence[3, 5:9] = 0.4
    names = ("a", "b", "c", "d")
    assert select_covering(evidence, names, names, 2) == ("a", "d")
    assert select_covering(evidence, names, ("b", "c", "d"), 2) == ("b", "d")


def test_covering_fills_up_with_the_closest():
    evidence = torch.zeros(5, 10)
    evidence[4] = 1
    names = tuple("abcde")
    assert select_covering(evidence, names, ("d", "c", "e", "b", "a"), 3) == ("e", "d", "c")


@pytest.mark.parametrize(("seen", "kept"), [(8, False), (9, True)])
def test_covering_keeps_the_last_cameras_while_they_see_enough(seen, kept):
    evidence = torch.zeros(3, 10)
    evidence[0, :seen] = 0.5
    evidence[1] = 1
    chosen = select_covering(evidence, ("a", "b", "c"), ("a", "b", "c"), 1, previous=("a",))
    assert chosen == (("a",) if kept else ("b",))
