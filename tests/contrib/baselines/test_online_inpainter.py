"""Baselines behind the protocol of all inpainters: what they see, what they keep, what they change."""

from dataclasses import replace

import pytest
import torch
from models.plates import HEIGHT, WIDTH, Rig, camera, context, look
from models.plates import view as plate

from viewmend.contrib.baselines.framing import Window, aim, camera_windows, foreground
from viewmend.contrib.baselines.online import OnlineConfig, OnlineInpainter, Sampling
from viewmend.models.base import Inpainter
from viewmend.types import ContextViews, MultiViewFrame

SIZE = (48, 48)
FRAMINGS = ("def", "win", "mul")


class Recorder:
    """A network that writes down what it is shown, and fills everything with a pattern of its own."""

    def __init__(self):
        self.clips = []

    def check_size(self, height, width):
        pass

    def complete_clip(self, clip):
        self.clips.append(clip)
        return torch.linspace(-3, 3, 3 * 48 * 48).view(3, *SIZE)


def config(**options):
    return OnlineConfig(**({"size_px": SIZE} | options))


def times_view(time, hole=(20, 40, 30, 55)):
    """A view whose colour says its time."""
    view = plate(0, hole)
    return replace(view, time=time, rgb=torch.full_like(view.rgb, time / 100) * (1 - view.error))


def stream(inpainter, views, source=None):
    state = inpainter.initial_state()
    for view in views:
        completed, state = inpainter.step(view, source or Rig(), state)
        yield completed, state


def times_in(frames):
    """Which times these frames are of."""
    return [round(50 * (float(f[0, 0, 0]) + 1)) for f in frames]


@pytest.mark.parametrize("framing", FRAMINGS)
def test_every_hole_pixel_is_filled_and_nothing_else_changes(framing):
    network = Recorder()
    inpainter = OnlineInpainter(network, config(framing=framing))
    assert isinstance(inpainter, Inpainter)
    holes = ((20, 40, 30, 55), (18, 20, 20, 70), (35, 74, 44, 46), None, (37, 38, 45, 46))
    views = [plate(time, hole) for time, hole in enumerate(holes)]
    for completed, _ in stream(inpainter, views):
        view, rgb = completed.view, completed.rgb
        untouched = view.error == 0
        assert torch.equal(rgb[:, untouched], view.rgb[:, untouched])
        assert bool((rgb >= 0).all()) and bool((rgb <= 1).all())
        whole = view.error == 1
        assert bool((rgb[:, whole].abs().sum(0) > 0).all()), "the pattern is nowhere black"
    calls = len(network.clips)
    assert calls >= 4 and (framing != "def" or calls == 4), "a view without holes costs nothing"


@pytest.mark.parametrize("framing", FRAMINGS)
def test_a_hole_keeps_the_share_of_the_render_that_e_says(framing):
    view = plate(0)
    [(completed, _)] = stream(OnlineInpainter(Recorder(), config(framing=framing)), [view])
    [(black, _)] = stream(
        OnlineInpainter(Recorder(), config(framing=framing)), [replace(view, rgb=0 * view.rgb)]
    )
    soft = view.error == 0.5
    assert bool(soft.any())
    assert torch.allclose((completed.rgb - black.rgb)[:, soft], 0.5 * view.rgb[:, soft], atol=1e-6)


def test_a_view_sees_three_neighbours_and_three_references_of_the_absolute_grid():
    network = Recorder()
    list(stream(OnlineInpainter(network, config()), [times_view(t) for t in range(58)]))
    clip = network.clips[57]
    assert times_in(clip.now) == [57]
    assert [times_in(f)[0] for f in clip.neighbours] == [56, 55, 54]
    assert [times_in(f)[0] for f in clip.references] == [50, 40, 30]
    assert [times_in(f)[0] for f in network.clips[1].neighbours] == [0] and network.clips[1].references == ()
    assert [times_in(f)[0] for f in network.clips[13].references] == [0]
    assert [times_in(f)[0] for f in network.clips[14].references] == [10, 0]


def test_the_relative_grid_is_the_other_papers():
    network = Recorder()
    list(
        stream(
            OnlineInpainter(network, config(sampling=Sampling(grid="relative"))), map(times_view, range(36))
        )
    )
    clip = network.clips[35]
    assert [times_in(f)[0] for f in clip.neighbours] == [34, 33, 32]
    assert [times_in(f)[0] for f in clip.references] == [25, 15, 5]


@pytest.mark.parametrize("grid", ["absolute", "relative"])
def test_the_kept_past_is_bounded(grid):
    inpainter = OnlineInpainter(Recorder(), config(sampling=Sampling(grid=grid)))
    most = max(len(state.frames) for _, state in stream(inpainter, map(times_view, range(75))))
    # 3 neighbours, 3 references and those that will be; or every frame of the last 30, this one too.
    assert most <= {"absolute": 7, "relative": 30}[grid]


@pytest.mark.parametrize("framing", FRAMINGS)
def test_a_view_that_nobody_wants_filled_leaves_the_state_that_filling_leaves(framing):
    network = Recorder()
    inpainter = OnlineInpainter(network, config(framing=framing))
    filled = passed = inpainter.initial_state()
    for time in range(25):
        view = times_view(time)
        _, filled = inpainter.step(view, Rig(), filled)
        calls = len(network.clips)
        passed = inpainter.advance_state(view, passed)
        assert len(network.clips) == calls and passed.frames.keys() == filled.frames.keys()
        assert all(torch.equal(passed.frames[t], filled.frames[t]) for t in filled.frames)
        assert passed.canvas_px == filled.canvas_px
    assert sorted(filled.frames) == [0, 10, 20, 22, 23, 24]


def test_another_size_starts_a_new_stream_and_going_back_in_time_forgets_the_future():
    network = Recorder()
    inpainter = OnlineInpainter(network, config(framing="win"))
    views = [plate(5), plate(6), plate(5), plate(6, width=130)]
    assert [len(network.clips[-1].neighbours) for _ in stream(inpainter, views)] == [0, 1, 0, 0]
    again = [plate(5), plate(6), plate(5), plate(7)]
    past = [len(network.clips[-1].neighbours) for _ in stream(inpainter, again)]
    assert past == [0, 1, 0, 1], "6 was seen by another look"


def test_only_mul_asks_for_cameras_and_never_for_the_future():
    for framing in FRAMINGS:
        rig, network = Rig(), Recorder()
        inpainter = OnlineInpainter(network, config(framing=framing))
        list(stream(inpainter, [plate(t) for t in range(3)], rig))
        if framing != "mul":
            assert rig.asked == []
            continue
        assert all(len(clip.now) == 3 for clip in network.clips), (
            "the view and the two cameras that coloured it"
        )
        assert {names for _, names in rig.asked} == {("left", "right")}
        assert max(time for time, _ in rig.asked) == 2
        assert sorted(time for time, _ in rig.asked[-3:]) == [0, 1, 2]


def test_mul_does_with_the_cameras_that_are_there():
    network = Recorder()
    rig = Rig(start=1, silent=frozenset({("left", 1)}))
    list(stream(OnlineInpainter(network, config(framing="mul")), [plate(t) for t in range(3)], rig))
    last = network.clips[-1]
    assert [len(f) for f in (last.now, *last.neighbours)] == [3, 2, 1]


def test_a_camera_shows_what_a_window_looks_at_in_the_views_scale():
    """The plate faces all cameras at one distance: each sees the window's part of it as the view does."""
    rendered, window = plate(0, None), Window(14, 21)
    views = context(0)
    seen = camera_windows(foreground(views), views, aim(rendered, window, SIZE), SIZE)
    own = window.of(2 * rendered.rgb - 1, SIZE)
    inside = window.of(rendered.mask, SIZE) > 0
    inside[:, :8] = inside[:, -8:] = False  # half of what the other camera sees beyond its image
    # Half a pixel off at most: the disparity of these cameras is no whole number.
    assert float((seen - own).abs()[:, :, inside].mean()) < 0.05
    shifted = camera_windows(foreground(views), views, aim(rendered, Window(14, 25), SIZE), SIZE)
    assert float((shifted - own).abs()[:, :, inside].mean()) > 0.15


@pytest.mark.parametrize("times", [1, 2])
def test_a_camera_of_a_longer_lens_shows_the_same_part_of_the_subject(times):
    """Its image grows by a 255th a pixel, so the differences between a window's pixels say how far apart they are."""
    cameras = camera("left").resized(times * WIDTH, times * HEIGHT)
    rgb = torch.arange(times * WIDTH, dtype=torch.uint8).expand(1, 3, times * HEIGHT, -1).contiguous()
    frame = MultiViewFrame(cameras, rgb, torch.full_like(rgb[:, 0], 255), 0)
    views = ContextViews(frame, torch.full(rgb[:, 0].shape, 2.0))
    seen = camera_windows(foreground(views), views, aim(plate(0, None), Window(14, 21), SIZE), SIZE)
    apart = 255 / 2 * seen[0, 0, 24].diff()
    assert float(apart.median()) == pytest.approx(times, abs=1e-3)


def test_a_window_without_depth_looks_where_the_view_does_and_a_blind_view_shows_whole_images():
    rendered, views = plate(0, None), context(0)
    empty = replace(rendered, depth=torch.zeros_like(rendered.depth))
    assert aim(empty, Window(0, 0), SIZE) is None
    whole = camera_windows(foreground(views), views, None, SIZE)
    assert whole.shape == (2, 3, *SIZE) and bool(whole.isfinite().all())
    corner = replace(rendered, depth=rendered.depth * (torch.arange(WIDTH) > 60))
    at = aim(corner, Window(0, 0), SIZE)
    assert at is not None and float(at.point[0, 2]) == pytest.approx(2.0)
    assert look(camera("novel"), 0)[0].shape == (3, HEIGHT, WIDTH)
