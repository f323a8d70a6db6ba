"""The window of time, and what the cache keeps of it."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from inpainting.plates import NAMES, Rig, context, tiny, view

from viewmend.inpainting.config import paper
from viewmend.inpainting.context import ContextCache, window_times


def test_the_papers_window():
    assert window_times(100, paper()) == (100, 99, 98, 97, 90, 80, 70)
    assert window_times(12, paper()) == (12, 11, 10, 9, 2)
    assert window_times(0, paper()) == (0,)
    assert len(window_times(1000, paper())) == 7


def test_the_absolute_grid():
    config = replace(paper(), grid="absolute")
    assert window_times(100, config) == (100, 99, 98, 97, 90, 80, 70)
    assert window_times(104, config) == (104, 103, 102, 101, 100, 90, 80)
    assert window_times(102, config) == (102, 101, 100, 99, 90, 80, 70)
    assert window_times(3, config) == (3, 2, 1, 0)


@given(
    grid=st.sampled_from(["relative", "absolute"]),
    n_c=st.integers(0, 4),
    n_w=st.integers(0, 4),
    k_w=st.integers(1, 12),
    time=st.integers(0, 90),
)
def test_windows_are_causal_and_short(grid, n_c, n_w, k_w, time):
    config = replace(paper(), grid=grid, n_c=n_c, n_w=n_w, k_w=k_w)
    times = window_times(time, config)
    assert times[0] == time and min(times) >= 0
    assert list(times) == sorted(set(times), reverse=True)
    assert len(times) <= 1 + n_c + n_w


@given(
    grid=st.sampled_from(["relative", "absolute"]),
    n_c=st.integers(0, 4),
    n_w=st.integers(0, 4),
    k_w=st.integers(1, 12),
)
@settings(max_examples=30, deadline=None)
def test_nothing_is_dropped_that_a_later_step_wants(grid, n_c, n_w, k_w):
    """A stream that shows every time asks for every time once."""
    config = replace(paper(), grid=grid, n_c=n_c, n_w=n_w, k_w=k_w)
    frame = FRAME[0]
    cache = ContextCache()
    for time in range(60):
        missing = [t for t in window_times(time, config) if cache.missing(("left",), t)]
        assert missing == [time]
        cache = cache.add([replace(frame, time=time)], time, config)
        limit = max(k_w * n_w, n_c, 1) + 1 if grid == "relative" else 1 + n_c + n_w
        assert len(cache.frames) <= limit


FRAME = tiny().encode_context(context(0, ("left",)))


def test_only_what_is_missing_is_asked_for():
    net, rig = tiny(), Rig()
    _, state = net.step(view(8), rig, net.initial_state())
    assert rig.asked == [(t, NAMES) for t in window_times(8, net.config)]
    rig.asked.clear()
    other = replace(view(8), source_views=("left", "third"))
    _, state = net.step(other, rig, state)
    now, *past = rig.asked
    assert now == (8, ("third", "left")), "what is cached is asked for where rays are read"
    assert past == [(t, ("third",)) for t in window_times(8, net.config)[1:]]
    rig.asked.clear()
    net.step(view(9), rig, state)
    assert rig.asked == [(9, NAMES), (5, NAMES), (1, NAMES)]


def test_a_cache_is_a_value():
    cache = ContextCache()
    more = cache.add(FRAME, 0, paper())
    assert not cache.frames and len(more.frames) == 1
    with pytest.raises(TypeError):
        more.frames["left", 9] = FRAME[0]
