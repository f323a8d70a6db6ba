"""The whole system: what reaches whom, what is remembered, what is shared."""

from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, photograph, ring

from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy
from viewmend.inpainting.protocol import State
from viewmend.pipeline import PipelineConfig, StreamState, mend_view, observe
from viewmend.views import CompletedView

CONFIG = PipelineConfig(hull=HullConfig(resolution=32), history=3)
SPARSE = ring(12)[[0, 1, 2, 4, 7, 9]]


class Asker:
    """An inpainter that paints holes white and asks for `wanted` (times back, cameras)."""

    def __init__(self, *wanted):
        self.wanted = wanted
        self.given = {}

    def initial_state(self):
        return State()

    def step(self, view, source, state):
        for back, names in self.wanted:
            self.given[back] = source(view.time - back, names)
        return CompletedView(view, torch.where(view.error > 0, torch.ones_like(view.rgb), view.rgb)), state


def start(asker):
    return StreamState(asker.initial_state())


def stream(times, target, asker, config=CONFIG, exclude=()):
    """The last result of a stream that looks at these times."""
    state = start(asker)
    for time in times:
        mended = mend_view(observe(photograph(SPARSE, time), None, config), target, state, asker, config, exclude)
        state = mended.state
    return mended


def test_a_view_is_rendered_and_mended():
    target = camera_at(140, "t")
    mended = stream([0], target, Asker())
    truth = photograph(target)
    view, rgb = mended.completed.view, mended.completed.rgb
    assert view.source_views == ("c4", "c7", "c2")
    assert 50 < view.error.sum() < 0.7 * view.mask.sum()
    assert bool((rgb[:, view.error > 0] == 1).all()) and torch.equal(
        rgb[:, view.error == 0], view.rgb[:, view.error == 0]
    )
    right = (view.mask > 0) & (view.error == 0) & (truth.mask[0] > 0)
    # A hull from six cameras is off by centimetres, so colours are; another camera's would be off by 0.2.
    assert (rgb - truth.rgb[0] / 255)[:, right].abs().mean() < 0.05
    stages = mended.stage_ms
    assert min(stages.geometry, stages.rendering, stages.inpainting) > 0


def test_the_past_is_there_with_its_own_geometry_and_no_further_back_than_asked():
    asker = Asker((0, ("c4",)), (2, ("c9", "c0")), (3, ("c1",)), (4, ("c1",)), (-1, ("c1",)))
    mended = stream(range(6), camera_at(165, "t"), asker)
    past = asker.given[2]
    assert past.frame.time == 3 and past.frame.cameras.names == ("c9", "c0")
    assert past.depth.shape == past.frame.rgb[:, 0].shape
    covered = (past.depth > 0) == (past.frame.mask > 127)
    assert covered.float().mean() > 0.97
    assert asker.given[0].frame.time == 5 and asker.given[3].frame.time == 2
    assert asker.given[4] is None and asker.given[-1] is None
    assert [o.frame.time for o in mended.state.history] == [2, 3, 4, 5]


def test_a_camera_with_a_gap_is_left_out_of_the_context():
    asker = Asker((0, ("c4", "c7")), (1, ("c7",)))
    state, target = start(asker), camera_at(165, "t")
    for frame in (photograph(SPARSE, 0).without(["c7"]), photograph(SPARSE, 1)):
        state = mend_view(observe(frame, None, CONFIG), target, state, asker, CONFIG).state
    assert asker.given[0].frame.cameras.names == ("c4", "c7")
    assert asker.given[1] is None


def test_excluded_cameras_reach_neither_renderer_nor_inpainter():
    asker = Asker((0, ("c4", "c7")), (1, ("c4",)))
    observation = observe(photograph(SPARSE), None, CONFIG)
    mended = mend_view(observation, camera_at(120, "t"), start(asker), asker, CONFIG, exclude=("c4",))
    assert "c4" not in mended.completed.view.source_views
    assert asker.given[0].frame.cameras.names == ("c7",)
    assert asker.given[1] is None


def test_what_one_viewer_does_another_does_not_feel():
    a, b = camera_at(20, "a"), camera_at(200, "b")
    alone = [stream(range(3), target, Asker()).completed.rgb for target in (a, b)]
    asker = Asker()
    states = [start(asker), start(asker)]
    for time in range(3):
        shared = observe(photograph(SPARSE, time), None, CONFIG)
        together = [mend_view(shared, t, s, asker, CONFIG) for t, s in zip((a, b), states, strict=True)]
        states = [m.state for m in together]
    for one, two in zip(alone, together, strict=True):
        assert torch.equal(one, two.completed.rgb)


def test_viewers_share_the_depth_of_the_cameras(monkeypatch):
    rendered = []
    depth = GeometryProxy.depth
    monkeypatch.setattr(
        GeometryProxy, "depth", lambda self, cameras: rendered.extend(cameras.names) or depth(self, cameras)
    )
    observation = observe(photograph(SPARSE), None, CONFIG)
    asker = Asker((0, ("c0", "c1", "c2")))
    for angle in (30, 32, 65):
        mend_view(observation, camera_at(angle, "t"), start(asker), asker, CONFIG)
    assert sorted(rendered) == ["c0", "c1", "c2", "c4"]


def test_cameras_of_different_sizes_travel_in_one_stack():
    cameras = replace(SPARSE, size_px=torch.tensor([[48, 48], [40, 48], [48, 30], [48, 48], [48, 48], [48, 48]]))
    observation = observe(
        photograph(SPARSE).__class__(cameras, photograph(SPARSE).rgb, photograph(SPARSE).mask, 0), None, CONFIG
    )
    assert observation.depth(["c0", "c2"]).shape == (2, 48, 48)
    assert observation.depth(["c0", "c2"])[1, 30:].max() == 0
    for names in (["c2"], ["c1"], ["c1", "c2"]):
        seen = observation.context(names)
        assert seen.depth.shape[1:] == seen.frame.rgb.shape[2:] == seen.frame.mask.shape[1:]


def test_a_capture_without_masks_is_refused():
    with pytest.raises(ValueError, match="expected a capture with masks"):
        observe(replace(photograph(SPARSE), mask=None), None, CONFIG)
