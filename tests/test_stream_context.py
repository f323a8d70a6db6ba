"""The context that a stream gives an inpainter: cameras, past frames, and no excluded camera."""

from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, photograph, ring

from viewmend.frame_cache import WINDOW, cache_frame
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy
from viewmend.models.base import Inpainter
from viewmend.stream import Stream, StreamConfig
from viewmend.types import CompletedView, MultiViewFrame

CONFIG = StreamConfig(hull=HullConfig(resolution=32))


SPARSE = ring(12)[[0, 1, 2, 4, 7, 9]]


class Requester(Inpainter):
    """An inpainter that paints E white and requests `wanted`: (frames back, camera names)."""

    def __init__(self, *wanted):
        self.wanted = wanted
        self.given = {}

    def step(self, view, context, state):
        for back, names in self.wanted:
            self.given[back] = context(view.time - back, names)
        return CompletedView(view, torch.where(view.error > 0, torch.ones_like(view.rgb), view.rgb)), state


def test_a_view_is_rendered_and_completed():
    target = camera_at(140, "t")
    stream = Stream(Requester(), CONFIG)
    stream.add_frame(photograph(SPARSE, 0))
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


def test_past_frames_are_kept_as_far_back_as_windows_reach():
    requester = Requester((0, ("c4",)), (2, ("c9", "c0")), (WINDOW, ("c1",)), (WINDOW + 1, ("c1",)), (-1, ("c1",)))
    stream = Stream(requester, replace(CONFIG, memory_mb=None))
    for time in (0, 1, WINDOW - 1, WINDOW + 1):
        stream.add_frame(photograph(SPARSE, time))
    stream.view(camera_at(165, "t"))
    past = requester.given[2]
    assert past.frame.time == WINDOW - 1 and past.frame.cameras.names == ("c9", "c0")
    assert past.depth.shape == past.frame.rgb[:, 0].shape
    covered = (past.depth > 0) == (past.frame.mask > 127)
    assert covered.float().mean() > 0.97
    assert requester.given[0].frame.time == WINDOW + 1 and requester.given[WINDOW].frame.time == 1
    assert requester.given[WINDOW + 1] is None and requester.given[-1] is None
    assert stream.times == (1, WINDOW - 1, WINDOW + 1)


def test_a_camera_without_an_image_is_not_in_the_context():
    requester = Requester((0, ("c4", "c7")), (1, ("c7",)))
    stream = Stream(requester, CONFIG)
    stream.add_frame(photograph(SPARSE, 0).without(["c7"]))
    stream.add_frame(photograph(SPARSE, 1))
    stream.view(camera_at(165, "t"))
    assert requester.given[0].frame.cameras.names == ("c4", "c7")
    assert requester.given[1] is None


def test_excluded_cameras_reach_neither_renderer_nor_inpainter():
    requester = Requester((0, ("c4", "c7")), (1, ("c4",)))
    stream = Stream(requester, CONFIG)
    stream.add_frame(photograph(SPARSE))
    mended = stream.view(camera_at(120, "t"), exclude=("c4",))
    assert "c4" not in mended.completed.view.source_views + mended.completed.view.candidate_views
    assert requester.given[0].frame.cameras.names == ("c7",)
    assert requester.given[1] is None


def test_viewers_share_the_depth_of_the_cameras(monkeypatch):
    rendered = []
    depth = GeometryProxy.depth
    monkeypatch.setattr(
        GeometryProxy, "depth", lambda self, cameras: rendered.extend(cameras.names) or depth(self, cameras)
    )
    stream = Stream(Requester((0, ("c0", "c1", "c2"))), CONFIG)
    stream.add_frame(photograph(SPARSE))
    for angle in (30, 32, 65):
        stream.view(camera_at(angle, "t"))
    assert sorted(rendered) == ["c0", "c1", "c2", "c4"]


def test_cameras_of_different_sizes_share_one_stack():
    cameras = replace(SPARSE, size_px=torch.tensor([[48, 48], [40, 48], [48, 30], [48, 48], [48, 48], [48, 48]]))
    frame = MultiViewFrame(cameras, photograph(SPARSE).rgb, photograph(SPARSE).mask, 0)
    observation = cache_frame(frame, None, CONFIG.hull)
    assert observation.depth(["c0", "c2"]).shape == (2, 48, 48)
    assert observation.depth(["c0", "c2"])[1, 30:].max() == 0
    for names in (["c2"], ["c1"], ["c1", "c2"]):
        seen = observation.context(names)
        assert seen.depth.shape[1:] == seen.frame.rgb.shape[2:] == seen.frame.mask.shape[1:]


def test_a_capture_without_masks_is_refused():
    with pytest.raises(ValueError, match="expected a capture with masks"):
        Stream(Requester(), CONFIG).add_frame(replace(photograph(SPARSE), mask=None))
