"""Streams whose geometry is fused from predicted depth."""

from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, photograph, photograph_at, ring
from reference.forged import forged

from viewmend.frame_cache import all_masks, cache_frame
from viewmend.fused_geometry import FusedFrame, fuse_geometry
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.fusion import FusionConfig
from viewmend.geometry.hull import HullConfig, visual_hull
from viewmend.geometry.rasterize import rasterize
from viewmend.models.base import DepthMap, Inpainter
from viewmend.models.checkpoint import load_inpainter
from viewmend.models.classical import Telea
from viewmend.models.registry import error_model_for
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig

SMALL = FusionConfig(resolution=96, max_views=12, view_px=96)
FUSED = StreamConfig(geometry="fused", fusion=SMALL)


class Moved(Inpainter):
    """Predicts the proxy's depth, moved away by a distance, with full confidence."""

    predicts_depth = True

    def __init__(self, metres: float) -> None:
        self.metres = metres
        self.sizes: list[tuple[int, int]] = []

    def predict_depth(self, view, context):
        self.sizes.append(tuple(view.depth.shape))
        inside = (view.depth > 0).float()
        return DepthMap((view.depth + self.metres) * inside, inside)


class Noisy(Inpainter):
    """Predicts the proxy's depth with noise of 3 cm, new in each view."""

    predicts_depth = True

    def __init__(self) -> None:
        self.rng = torch.Generator().manual_seed(5)

    def predict_depth(self, view, context):
        inside = (view.depth > 0).float()
        noise = 0.03 * torch.randn(view.depth.shape, generator=self.rng)
        return DepthMap((view.depth + noise) * inside, 0.5 * inside)


def sequence(centers, share, times=None):
    """A ball's fused proxies, frame by frame, from noisy depth."""
    fusion = FusionConfig(resolution=48, max_views=6, view_px=64, last_share=share)
    config = replace(FUSED, fusion=fusion)
    stream = Stream(Noisy(), config, Bounds(torch.full((3,), -1.0), torch.full((3,), 1.0)))
    cameras = ring(6, 96)
    times = range(len(centers)) if times is None else times
    return [
        stream.add_frame(photograph_at(center, cameras, time)).proxy
        for center, time in zip(centers, times, strict=True)
    ]


@pytest.fixture(scope="module")
def views():
    return load_inpainter("views")


def depth_error_m(proxy, target, truth) -> float:
    """The mean error of the proxy's depth where it and the truth have a surface, up to 10 cm a pixel."""
    found = proxy.depth(target)
    both = (found > 0) & (truth > 0)
    return float((found - truth)[both].abs().clamp(max=0.1).mean())


def test_the_surface_of_a_person_gets_closer_to_the_truth(views):
    studio = Studio(StudioConfig(seed=3, cameras=6, frames=1, size_px=(160, 160)))
    frame = studio.read(0)
    target = orbit([0.5], (200, 200), elevation_rad=0.3)
    truth = rasterize(studio.scene(0).mesh, target).depth
    hull = Stream(Telea(), bounds=studio.bounds).add_frame(frame)
    fused = Stream(Telea(), FUSED, studio.bounds, error_model=views).add_frame(frame)
    assert depth_error_m(fused.proxy, target, truth) < 0.9 * depth_error_m(hull.proxy, target, truth)
    assert fused.geometry_ms > hull.geometry_ms


def test_the_hull_follows_the_depth_that_is_predicted():
    frame = photograph(ring(6, 96))
    cached = cache_frame(frame, None, HullConfig())
    target = camera_at(77, "novel", 96)

    def depth_m(model) -> float:
        fused = fuse_geometry(cached, all_masks(frame), model, RenderConfig(), SMALL, HullConfig())
        return float(fused.cached.proxy.depth(target)[0, 48, 48])

    # Views from the side move the surface that faces the target by less than the full distance.
    still_m = depth_m(Moved(0.0))
    assert 0.008 < depth_m(Moved(0.02)) - still_m < 0.02
    assert 0.016 < depth_m(Moved(0.04)) - still_m < 0.04


def test_views_are_no_larger_than_asked_for_and_no_more():
    model = Moved(0.0)
    Stream(model, StreamConfig(geometry="fused", fusion=FusionConfig(max_views=9, view_px=40))).add_frame(
        photograph(ring(6, 200))
    )
    assert len(model.sizes) == 9
    assert all(height <= 96 and width <= 96 for height, width in model.sizes)


def test_without_a_model_that_predicts_depth_it_is_refused():
    with pytest.raises(ValueError, match=r"predicts depth for the geometry 'fused', got Telea alone"):
        Stream(Telea(), FUSED)
    with pytest.raises(ValueError, match="'hull' or 'fused', got 'mesh'"):
        forged(StreamConfig(), geometry="mesh").__post_init__()


def test_the_shipped_model_predicts_depth_for_those_that_do_not(views):
    assert error_model_for(views) is None
    assert error_model_for(Telea()).predicts_depth


def test_a_frame_without_a_subject_shows_the_background(views):
    frame = photograph(ring(4))
    frame.mask.zero_()
    stream = Stream(views, FUSED)
    assert not len(stream.add_frame(frame).proxy.mesh.vertices)
    assert not stream.view(camera_at(20, "novel")).completed.rgb.any()


def test_completed_views_are_the_same_with_one_model_or_two(views):
    frame = photograph(ring(6, 64))
    target = camera_at(77, "novel", 64)
    one = Stream(views, FUSED)
    two = Stream(views, FUSED, error_model=views)
    one.add_frame(frame)
    two.add_frame(frame)
    assert torch.equal(one.view(target).completed.rgb, two.view(target).completed.rgb)


def test_the_hull_that_is_fused_has_the_streams_parameters(monkeypatch):
    used = []

    def carve(mask, cameras, bounds, config):
        used.append(config)
        return visual_hull(mask, cameras, bounds, config)

    monkeypatch.setattr("viewmend.geometry.fusion.visual_hull", carve)
    config = replace(FUSED, hull=HullConfig(pixels_per_voxel=4.0))
    Stream(Moved(0.0), config).add_frame(photograph(ring(6, 96)))
    assert used == [HullConfig(pixels_per_voxel=4.0, resolution=SMALL.resolution)]


def test_a_still_surface_flickers_less_than_its_depth():
    target = camera_at(77, "novel", 96)

    def flicker_m(share: float) -> float:
        depth = torch.cat([proxy.depth(target) for proxy in sequence([(0.0, 0.0, 0.0)] * 4, share)])
        shown = (depth > 0).all(0)
        return float((depth[1:] - depth[:-1])[:, shown].abs().mean())

    assert flicker_m(0.8) < 0.5 * flicker_m(0.0)


def test_a_moving_surface_is_that_of_its_own_frame():
    path = [(0.1 * step, 0.0, 0.0) for step in range(3)]
    followed = sequence(path, 0.8)[-1].mesh.vertices
    own = sequence(path, 0.0)[-1].mesh.vertices
    center = torch.tensor(path[-1])
    distance = (followed - center).norm(dim=1)
    assert float(distance.max()) < float((own - center).norm(dim=1).max()) + 0.005, "a trail"
    assert len(followed) == pytest.approx(len(own), rel=0.02)
    assert float(distance.std()) == pytest.approx(float((own - center).norm(dim=1).std()), rel=0.1)


@pytest.mark.parametrize("times", [(5, 4), (0, 4)])
def test_only_a_frame_shortly_before_counts(times):
    center = (0.0, 0.0, 0.0)
    _, with_last = sequence([center, center], 0.8, times)
    _, alone = sequence([center, center], 0.0, times)
    assert torch.equal(with_last.mesh.vertices, alone.mesh.vertices)


def test_a_frame_of_other_cameras_does_not_count():
    first = photograph(ring(6, 96))
    made = Stream(Moved(0.0), FUSED).add_frame(first)
    fused = FusedFrame(
        made, visual_hull(first.mask, first.cameras, made.proxy.bounds, HullConfig(resolution=8))
    )
    next_frame = replace(first, time=1)
    assert fused.surface_for(next_frame) is not None
    fewer = next_frame.without(["c2"])
    moved = replace(first.cameras, K=first.cameras.K * torch.tensor([1.01, 1.0, 1.0]))
    assert fused.surface_for(fewer) is None
    assert fused.surface_for(replace(next_frame, cameras=moved)) is None
    assert replace(fused, occupancy=None).surface_for(next_frame) is None
