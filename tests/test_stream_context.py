"""What an inpainter is given by a stream: cameras, their past, and nothing that is excluded."""

from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, photograph, ring

from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy
from viewmend.inpainting.protocol import State
from viewmend.observation import WINDOW, observe
from viewmend.stream import Stream, StreamConfig
from viewmend.views import CompletedView, MultiViewFrame

CONFIG = StreamConfig(hull=HullConfig(resolution=32))


SPARSE = ring(12)[[0, 1, 2, 4, 7, 9]]


class Asker:
    """An inpainter that paints holes white and asks for `wanted` (times back, cameras)."""

    def __init__(self, *wanted):
        self.wanted = wanted
        self.given = {}

    def initial_state(self):
        return State()

    def step(self, view, context, state):
        for back, names in self.wanted:
            self.given[back] = context(view.time - back, names)
        return CompletedView(view, torch.where(view.error > 0, torch.ones_like(view.rgb), view.rgb)), state


def test_a_view_is_rendered_and_mended():
    target = camera_at(140, "t")
    stream = Stream(Asker(), CONFIG)
    stream.push(photograph(SPARSE, 0))
    mended = stream.view(target)
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


def test_the_past_is_there_with_its_own_geometry_and_no_further_back_than_windows_reach():
    asker = Asker((0, ("c4",)), (2, ("c9", "c0")), (WINDOW, ("c1",)), (WINDOW + 1, ("c1",)), (-1, ("c1",)))
    stream = Stream(asker, replace(CONFIG, memory_mb=None))
    for time in (0, 1, WINDOW - 1, WINDOW + 1):
        stream.push(photograph(SPARSE, time))
    stream.view(camera_at(165, "t"))
    past = asker.given[2]
    assert past.frame.time == WINDOW - 1 and past.frame.cameras.names == ("c9", "c0")
    assert past.depth.shape == past.frame.rgb[:, 0].shape
    covered = (past.depth > 0) == (past.frame.mask > 127)
    assert covered.float().mean() > 0.97
    assert asker.given[0].frame.time == WINDOW + 1 and asker.given[WINDOW].frame.time == 1
    assert asker.given[WINDOW + 1] is None and asker.given[-1] is None
    assert stream.times == (1, WINDOW - 1, WINDOW + 1)


def test_a_camera_with_a_gap_is_left_out_of_the_context():
    asker = Asker((0, ("c4", "c7")), (1, ("c7",)))
    stream = Stream(asker, CONFIG)
    stream.push(photograph(SPARSE, 0).without(["c7"]))
    stream.push(photograph(SPARSE, 1))
    stream.view(camera_at(165, "t"))
    assert asker.given[0].frame.cameras.names == ("c4", "c7")
    assert asker.given[1] is None


def test_excluded_cameras_reach_neither_renderer_nor_inpainter():
    asker = Asker((0, ("c4", "c7")), (1, ("c4",)))
    stream = Stream(asker, CONFIG)
    stream.push(photograph(SPARSE))
    mended = stream.view(camera_at(120, "t"), exclude=("c4",))
    assert "c4" not in mended.completed.view.source_views + mended.completed.view.candidate_views
    assert asker.given[0].frame.cameras.names == ("c7",)
    assert asker.given[1] is None


def test_viewers_share_the_depth_of_the_cameras(monkeypatch):
    rendered = []
    depth = GeometryProxy.depth
    monkeypatch.setattr(
        GeometryProxy, "depth", lambda self, cameras: rendered.extend(cameras.names) or depth(self, cameras)
    )
    stream = Stream(Asker((0, ("c0", "c1", "c2"))), CONFIG)
    stream.push(photograph(SPARSE))
    for angle in (30, 32, 65):
        stream.view(camera_at(angle, "t"))
    assert sorted(rendered) == ["c0", "c1", "c2", "c4"]


def test_cameras_of_different_sizes_travel_in_one_stack():
    cameras = replace(SPARSE, size_px=torch.tensor([[48, 48], [40, 48], [48, 30], [48, 48], [48, 48], [48, 48]]))
    frame = MultiViewFrame(cameras, photograph(SPARSE).rgb, photograph(SPARSE).mask, 0)
    observation = observe(frame, None, CONFIG.hull)
    assert observation.depth(["c0", "c2"]).shape == (2, 48, 48)
    assert observation.depth(["c0", "c2"])[1, 30:].max() == 0
    for names in (["c2"], ["c1"], ["c1", "c2"]):
        seen = observation.context(names)
        assert seen.depth.shape[1:] == seen.frame.rgb.shape[2:] == seen.frame.mask.shape[1:]


def test_a_capture_without_masks_is_refused():
    with pytest.raises(ValueError, match="expected a capture with masks"):
        Stream(Asker(), CONFIG).push(replace(photograph(SPARSE), mask=None))


def test_all_cameras_of_a_frame_are_the_frame_itself():
    """Frames are megabytes, and are asked for without nobody at every time of a live rig."""
    frame = photograph(ring(3, 16))
    assert frame.select(frame.cameras.names) is frame and frame.without([]) is frame
    turned = frame.select(frame.cameras.names[::-1])
    assert turned.cameras.names == ("c2", "c1", "c0") and torch.equal(turned.rgb[0], frame.rgb[2])
