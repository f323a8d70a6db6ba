"""The temporal window, and what a context provider requests and remembers."""

from dataclasses import replace

import pytest
from models.plates import NAMES, Rig

from viewmend.models.base import REMEMBERED_FRAMES, ContextProvider
from viewmend.models.paper.config import paper
from viewmend.models.paper.context import window_times


def test_the_papers_window():
    assert window_times(100, paper()) == (100, 99, 98, 97, 90, 80, 70)
    assert window_times(12, paper()) == (12, 11, 10, 9, 2)
    assert window_times(0, paper()) == (0,)
    assert window_times(9, replace(paper(), n_c=4, n_w=2, k_w=2)) == (9, 8, 7, 6, 5), "each frame once"


def test_a_providers_own_memory_is_bounded():
    context, encoded = Rig(), []

    def encode(many):
        encoded.extend(views.frame.time for views in many)
        return [[(name, views.frame.time) for name in views.frame.cameras.names] for views in many]

    for time in range(3 * REMEMBERED_FRAMES):
        times = (time, time - 30) if time >= 30 else (time,)
        assert context.encoded(times, ("left",), encode) == [("left", t) for t in times]
    assert encoded == list(range(3 * REMEMBERED_FRAMES)), "each frame is encoded once"
    context.encoded((0,), ("left",), encode)
    assert encoded[-1] == 0, "the oldest frame was evicted"


def test_excluded_cameras_are_never_provided():
    rig = Rig()
    context = ContextProvider(rig, exclude=("left",))
    assert context(3, NAMES).frame.cameras.names == ("right",) and context(3, ("left",)) is None
    assert context.encoded((3,), NAMES, lambda many: [v.frame.cameras.names for v in many]) == ["right"]
    shared = {"left": "encoded for another viewer"}
    context = ContextProvider(rig, exclude=("left",), memory=lambda time: shared)
    assert context.encoded((3,), ("left",), lambda many: []) == []


def test_a_string_is_not_taken_for_a_list_of_names():
    with pytest.raises(
        ValueError, match=r"exclude as a list of names, got the string 'left'; write \['left'\]"
    ):
        ContextProvider(Rig(), exclude="left")
