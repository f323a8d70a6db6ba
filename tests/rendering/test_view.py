"""Rendered views of an analytic ball."""

from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, photograph, proxy, ring

from viewmend.geometry.cameras import concatenate_cameras
from viewmend.geometry.mesh import Mesh
from viewmend.rendering.view import RenderConfig, angles_to, render_depth, render_view

BALL = proxy()


def test_the_ball_is_rendered_correctly():
    target = camera_at(40, "t", 64, 0.4)
    truth = photograph(target)
    view, _ = render_view(photograph(ring(12, 96)), BALL, target, RenderConfig())
    right = (view.mask > 0) & (view.error == 0) & (truth.mask[0] > 0)
    assert right.sum() > 0.97 * (truth.mask > 0).sum()
    # The exact colour is a function of position; one source pixel is 1.5 cm, 3 % of the range, at the rim more.
    assert (view.rgb - truth.rgb[0] / 255)[:, right].abs().mean() < 0.004
    assert (view.mask - (truth.mask[0] > 0).float()).abs().mean() < 0.01


def test_the_fields_of_a_view_are_consistent():
    cameras = ring(12)[[0, 2, 3]]  # nothing sees the back
    view, _ = render_view(photograph(cameras, 7), BALL, camera_at(135, "t"), RenderConfig())
    missing, coloured = view.error == 1, (view.error == 0) & (view.mask == 1)
    assert missing.sum() > 50 and coloured.sum() > 50
    assert bool((view.mask[missing] == 1).all())
    assert view.rgb[:, missing].abs().max() == 0
    assert view.rgb[:, view.mask == 0].abs().max() == 0
    assert view.rgb[:, coloured].min() > 0.02
    torch.testing.assert_close(view.weights.sum(0), coloured.float())
    assert torch.equal(view.mask > 0, view.depth > 0)
    assert view.time == 7 and set(view.source_views) == set(cameras.names)


def test_excluded_cameras_are_not_used():
    frame, target = photograph(ring(6)), camera_at(60, "t")
    config = RenderConfig()
    marked = frame.rgb.clone()
    marked[1] = 255
    with_it, _ = render_view(replace(frame, rgb=marked), BALL, target, config)
    assert "c1" in with_it.source_views
    without, _ = render_view(replace(frame, rgb=marked), BALL, target, config, exclude=("c1",))
    alone, _ = render_view(frame.without(["c1"]), BALL, target, config)
    assert set(without.source_views) == set(alone.source_views)
    torch.testing.assert_close(without.rgb, alone.rgb)
    assert without.candidate_views == alone.candidate_views
    assert (
        without.silhouettes.cameras.names == alone.silhouettes.cameras.names == ("c0", "c2", "c3", "c4", "c5")
    )
    assert torch.equal(without.silhouettes.mask, alone.silhouettes.mask)
    with pytest.raises(ValueError, match="all of them excluded"):
        render_view(frame, BALL, target, config, exclude=frame.cameras.names)


def test_an_empty_proxy_gives_an_empty_view():
    empty = replace(
        BALL, mesh=Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32)), normals=torch.zeros(0, 3)
    )
    view, _ = render_view(photograph(ring(4)), empty, camera_at(5, "t"), RenderConfig())
    assert view.mask.sum() == 0 and view.error.sum() == 0 and view.rgb.sum() == 0
    assert view.source_views[0] == "c0"


# Selection of source cameras.


CENTER = torch.zeros(3)


def test_angles_are_measured_at_the_subject():
    # Distance does not count: the second camera is much nearer.
    cameras = concatenate_cameras(
        [camera_at(30, "a"), camera_at(100, "b", distance_m=0.8), camera_at(10.001, "c")]
    )
    degrees = torch.rad2deg(angles_to(camera_at(10, "t"), cameras, CENTER))
    torch.testing.assert_close(degrees, torch.tensor([20.0, 90.0, 0.001]), atol=2e-4, rtol=0)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_there_is_no_surface_where_depth_is_not_finite(value):
    frame, target = photograph(ring(6)), camera_at(40, "t")
    depth = BALL.depth(target)[0]
    depth[20:24, 20:24] = 0.0
    broken = depth.clone()
    broken[20:24, 20:24] = value

    def source_depth(names):
        return BALL.depth(frame.cameras.select(names))

    whole, _ = render_depth(frame, target, depth, source_depth, RenderConfig())
    view, _ = render_depth(frame, target, broken, source_depth, RenderConfig())
    for name in ("rgb", "mask", "error", "depth", "weights"):
        assert torch.equal(getattr(view, name), getattr(whole, name)), name
