"""The window of time, and what is remembered of it."""

from dataclasses import replace

import torch
from hypothesis import given
from hypothesis import strategies as st
from inpainting.plates import NAMES, Rig, tiny, view
from reference.ball import camera_at

from viewmend.geometry.cameras import unproject
from viewmend.inpainting.config import paper
from viewmend.inpainting.context import ContextFrame, window_times
from viewmend.inpainting.protocol import REMEMBERED_TIMES, ContextProvider, RenderQuality


def test_the_papers_window():
    assert window_times(100, paper()) == (100, 99, 98, 97, 90, 80, 70)
    assert window_times(12, paper()) == (12, 11, 10, 9, 2)
    assert window_times(0, paper()) == (0,)
    assert len(window_times(1000, paper())) == 7


@given(
    n_c=st.integers(0, 4),
    n_w=st.integers(0, 4),
    k_w=st.integers(1, 12),
    time=st.integers(0, 90),
)
def test_windows_are_causal_and_short(n_c, n_w, k_w, time):
    config = replace(paper(), n_c=n_c, n_w=n_w, k_w=k_w)
    times = window_times(time, config)
    assert times[0] == time and min(times) >= 0
    assert list(times) == sorted(set(times), reverse=True)
    assert len(times) <= 1 + n_c + n_w


def test_only_what_is_missing_is_asked_for():
    net, rig = tiny(), Rig()
    context = rig
    _, state = net.step(view(8), context, net.initial_state())
    assert rig.asked == [(8, NAMES), *((t, NAMES) for t in window_times(8, net.config))], "for rays, then for patches"
    rig.asked.clear()
    other = replace(view(8), source_views=("left", "third"))
    _, state = net.step(other, context, state)
    assert rig.asked == [(8, ("left", "third")), *((t, ("third",)) for t in window_times(8, net.config))]
    rig.asked.clear()
    net.step(view(9), context, state)
    assert rig.asked == [(9, NAMES), (9, NAMES), (5, NAMES), (1, NAMES)]


def test_a_providers_own_memory_is_bounded_and_of_the_latest():
    context, encoded = Rig(), []

    def encode(many):
        encoded.extend(views.frame.time for views in many)
        return [[(name, views.frame.time) for name in views.frame.cameras.names] for views in many]

    for time in range(3 * REMEMBERED_TIMES):
        frames = context.encoded((time, time - 30) if time >= 30 else (time,), ("left",), encode)
        assert frames == [("left", t) for t in ((time, time - 30) if time >= 30 else (time,))]
    assert encoded == list(range(3 * REMEMBERED_TIMES)), "each was encoded once"
    context.encoded((0,), ("left",), encode)
    assert encoded[-1] == 0, "the oldest was forgotten"


def test_excluded_cameras_are_never_seen():
    rig = Rig()
    context = ContextProvider(rig, exclude=("left",))
    assert context(3, NAMES).frame.cameras.names == ("right",) and context(3, ("left",)) is None
    assert context.encoded((3,), NAMES, lambda many: [v.frame.cameras.names for v in many]) == ["right"]
    shared = {"left": "seen by another"}
    context = ContextProvider(rig, exclude=("left",), memory=lambda time: shared)
    assert context.encoded((3,), ("left",), lambda many: []) == []


def test_less_quality_looks_at_less_of_the_window():
    net = tiny()
    for count, times in ((None, window_times(8, net.config)), (2, (8, 7)), (1, (8,))):
        rig = Rig()
        net.step(view(8), ContextProvider(rig, RenderQuality(context_times=count)), net.initial_state())
        assert [time for time, _ in rig.asked[1:]] == list(times)
    rig = Rig()
    completed, _ = net.step(view(8), ContextProvider(rig, RenderQuality(context_times=0)), net.initial_state())
    assert [time for time, _ in rig.asked] == [8], "for rays alone"
    coarse, _ = net.coarse.step(view(8), Rig(), net.initial_state())
    assert torch.equal(completed.rgb, coarse.rgb)


def test_a_frame_carried_by_another_has_no_points_where_that_one_has_no_depth():
    places, uv = torch.tensor([[0, 0], [0, 1], [1, 0], [5, 5]]), torch.rand(4, 2) * 40
    nothing, tokens = torch.zeros(4, 3), torch.zeros(4, 8)
    valid = torch.ones(4, dtype=torch.bool)
    camera, memory = camera_at(10, "c"), torch.zeros(1, 2, 4, 8)
    older = ContextFrame(camera, 3, places, uv, nothing, valid, torch.ones(6, 6), tokens, memory)
    now = replace(older, time=4, depths=torch.tensor([[2.0, 0.0], [1.5, 3.0]]))
    points, lifted = older.lifted_by(now)
    assert lifted.tolist() == [True, False, True, False]
    expected = unproject(uv[None, [0, 2]], torch.tensor([[2.0, 1.5]]), camera)[0]
    torch.testing.assert_close(points[[0, 2]], expected)
