"""Ray samples: compiled kernels and PyTorch agree with each other, and with slow reference implementations."""

from dataclasses import replace

import pytest
import torch
from models.plates import context, view
from reference.rays_reference import sample_fill_reference

from viewmend.geometry.cameras import Cameras
from viewmend.models.views.aggregation import SampleAggregator
from viewmend.models.views.config import AROUND, FAR, IN_VIEW, NEAR, NUM_FEATURES, NUM_STATISTICS, OFFSETS
from viewmend.models.views.pyramids import (
    MipLevels,
    SceneScale,
    SourceCameras,
    choose_levels,
    downsample2x,
    silhouette_pyramids,
)
from viewmend.models.views.ray_fill import OFFSETS as FILL_OFFSETS
from viewmend.models.views.ray_fill import sample_behind_proxy
from viewmend.models.views.sampler import (
    CAMERA_CHANNELS,
    PATCH,
    CameraChoice,
    CameraFeatures,
    Projections,
    Rays,
    RaySamples,
    choose_cameras,
    sample_level,
    sample_level_cubic,
    sample_rays,
    sample_rays_torch,
    with_cameras,
)
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import Silhouettes


def rays_of(view):
    pixels = torch.nonzero(view.mask > 0)
    z = view.depth[tuple(pixels.T)][:, None] + SceneScale.of(view).size_m * torch.tensor(OFFSETS)
    return Rays(view, SceneScale.of(view), pixels, z)


def rotated(cameras: Cameras, angle: float) -> Cameras:
    """The cameras rotated about their own vertical axis, so that their z-depths differ."""
    turn = torch.eye(4)
    c, s = torch.tensor(angle).cos(), torch.tensor(angle).sin()
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = c, s, -s, c
    return replace(cameras, camera_from_world=turn @ cameras.camera_from_world)


@pytest.mark.parametrize("kernels", [True, False])
def test_fill_samples_equal_the_reference(rng, kernels, monkeypatch):
    monkeypatch.setattr(SourceCameras, "use_kernels", kernels)
    incomplete, seen = view(5), context(5, ("left", "third", "right"))
    depth = seen.depth + 0.2 * torch.rand(seen.depth.shape, generator=rng) * (seen.depth > 0)
    masks = (torch.rand(depth.shape, generator=rng) * 256).byte()
    seen = replace(
        seen, frame=replace(seen.frame, cameras=rotated(seen.frame.cameras, 0.55), mask=masks), depth=depth
    )
    rig = context(5, ("left", "third", "right", "novel")).frame
    outlines = (torch.rand(rig.rgb[:, 0].shape, generator=rng) * 64).byte()
    incomplete = replace(incomplete, silhouettes=Silhouettes(outlines, rotated(rig.cameras, 0.55)))
    pixels = torch.nonzero(incomplete.error > 0)
    pixels = pixels[torch.randperm(len(pixels), generator=rng)[:25]]
    sources = SourceCameras.of(seen, incomplete.silhouettes)
    samples = sample_behind_proxy(incomplete, pixels, sources)
    features, smallest = sample_fill_reference(
        incomplete, pixels, seen, FILL_OFFSETS, NEAR, FAR, AROUND, PATCH
    )
    assert 0 < CameraFeatures.unstack(samples.features).in_view.mean() < 1, "some samples are out of view"
    assert torch.allclose(samples.features.double(), torch.from_numpy(features), atol=3e-3)
    assert torch.allclose(samples.statistics[..., -4:].double(), torch.from_numpy(smallest), atol=2e-3)
    assert 0.05 < (samples.statistics[..., -3] < 0.5).float().mean() < 0.95
    one = sample_behind_proxy(incomplete, pixels, sources, offsets=(0.09,)).features
    assert torch.allclose(one[:, 0], samples.features[:, FILL_OFFSETS.index(0.09)], atol=1e-6)


@pytest.mark.parametrize(("step_px", "cubic"), [(1.0, False), (1.0, True), (5.0, False)])
def test_both_implementations_take_the_same_samples(scene, step_px, cubic):
    _, view, sources = scene
    rays = rays_of(view)
    rays = replace(rays, z_m=torch.where(torch.rand(rays.z_m.shape) < 0.1, 0.0, rays.z_m))
    given = rays, sources, step_px
    fast, slow = sample_rays(*given, cubic=cubic), sample_rays_torch(*given, cubic=cubic)
    levels = sources.levels(view.camera, step_px, SceneScale.of(view))
    assert min(level for part in levels for pair in part for level in pair) == {1.0: 0, 5.0: 2}[step_px]
    for name in ("features", "prior", "statistics"):
        off = (getattr(fast, name) - getattr(slow, name)).abs()
        flips = (off > 1e-3).float().mean()  # of the proxy's nearest pixel, where a position is between two
        assert float(flips) < 2e-3 and float(off.median()) < 1e-6, name
    assert float(fast.prior.sum(2).max()) <= 1 + 1e-5 and float(fast.statistics[..., 3:6].max()) > 0.1


def test_cubic_samples_keep_straight_lines_and_overshoot_none(rng):
    ramp = (10 * torch.arange(12.0))[None, None, None].expand(1, 1, 9, 12).contiguous()
    positions = 5 + 2 * torch.rand(40, 1, 1, 2, dtype=torch.double, generator=rng)
    at = Projections(positions, torch.ones(40, 1, 1), torch.ones(40, 1, 1) > 0)
    levels = MipLevels.full(ramp)
    found = sample_level_cubic(levels, at, 1)
    assert torch.allclose(found, sample_level(levels, at, 1), atol=1e-5)
    step = torch.where(torch.arange(12) < 6, 0.0, 255.0)[None, None, None].expand(1, 1, 9, 12).contiguous()
    wide, narrow = sample_level(MipLevels.full(step), at, 1), sample_level_cubic(MipLevels.full(step), at, 1)
    assert float(narrow.min()) >= 0 and float(narrow.max()) <= 1
    assert float((narrow - 0.5).abs().mean()) > float((wide - 0.5).abs().mean()), "edges are sharper"


def test_positions_stay_exact_under_autocast(scene):
    _, view, sources = scene
    given = rays_of(view), sources, 2.0
    with torch.autocast("cpu", torch.bfloat16):
        again = sample_rays(*given)
    assert all(torch.equal(one, other) for one, other in zip(sample_rays(*given)[:3], again[:3], strict=True))


def test_levels_are_means_with_a_black_border():
    image = torch.zeros(7, 9, 1, dtype=torch.uint8)
    image[1:-1, 1:-1, 0] = torch.randint(0, 256, (5, 7), dtype=torch.uint8)
    half, inner = downsample2x(image), image[..., 0].int()
    assert (
        half.shape == (5, 6, 1)
        and int(half[0].sum() + half[-1].sum() + half[:, 0].sum() + half[:, -1].sum()) == 0
    )
    assert int(half[1, 1, 0]) == (int(inner[1:3, 1:3].sum()) + 2) // 4
    assert int(half[3, 4, 0]) == (int(inner[5, 7]) + 2) // 4, "an odd side is completed with black"


def test_levels_match_the_footprint_of_a_ray():
    mask = torch.zeros(1, 64, 64, dtype=torch.uint8)
    mask[0, 8:40, 16:48] = 255
    cameras = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).cameras.select(["cam00"])
    (pyramid,) = silhouette_pyramids(Silhouettes(mask, cameras))
    assert pyramid.subject_px == pytest.approx(32)
    last, subject_px = torch.tensor([len(pyramid.levels) - 1]), torch.tensor([100.0])
    scale = SceneScale(
        1.0, 2.0, 100.0
    )  # the viewer stands where the camera is: footprints are as large as rays are apart
    chosen = [
        choose_levels(cameras, last, subject_px, cameras, px, scale) for px in (0.3, 1.0, 1.5, 4.0, 1e9)
    ]
    assert [int(fine) for fine, _ in chosen] == [0, 0, 1, 2, int(last)]
    assert [int(wide) for _, wide in chosen] == [3, 3, 3, 3, int(last)]


def test_without_silhouettes_the_source_masks_count():
    incomplete, seen = view(5), context(5)
    pixels = torch.nonzero(incomplete.error > 0)[::20]
    parts = (
        SourceCameras.of(seen, None),
        SourceCameras.of(seen, Silhouettes(seen.frame.mask, seen.frame.cameras)),
    )
    without, given = (sample_behind_proxy(incomplete, pixels, part).statistics for part in parts)
    assert torch.equal(without, given)


@pytest.mark.parametrize("unit", [0.001, 10.0])
def test_the_unit_of_length_does_not_matter(unit):
    def scaled(cameras):
        pose = cameras.camera_from_world.clone()
        pose[:, :3, 3] *= unit
        return replace(cameras, camera_from_world=pose)

    incomplete, seen = view(5), context(5)
    pixels = torch.nonzero(incomplete.error > 0)[::40]
    other = replace(incomplete, camera=scaled(incomplete.camera), depth=incomplete.depth * unit)
    frame = replace(seen.frame, cameras=scaled(seen.frame.cameras))
    sources = SourceCameras.of(replace(seen, frame=frame, depth=seen.depth * unit), None)
    after = sample_behind_proxy(other, pixels, sources)
    before = sample_behind_proxy(incomplete, pixels, SourceCameras.of(seen, None))
    assert torch.allclose(after.features, before.features, atol=1e-3)


# Samples are aggregated alike by the compiled loop and by PyTorch.


@pytest.fixture
def samples():
    """150 rays with 3 samples and 5 cameras, each of which sees two thirds of them; one sample is in no view."""
    torch.manual_seed(3)
    seen = (torch.rand(150, 3, 5) > 1 / 3).float()
    seen[7, 1] = 0
    features = torch.rand(150, 3, 5, NUM_FEATURES) * seen[..., None]
    features[..., IN_VIEW] = seen
    prior = torch.rand(150, 3, 5) * seen
    return RaySamples(
        features, prior / prior.sum(2, keepdim=True).clamp_min(1e-6), torch.rand(150, 3, NUM_STATISTICS)
    )


@pytest.mark.parametrize("own_prior", [True, False])
def test_the_compiled_loop_equals_pytorch(samples, own_prior):
    torch.manual_seed(0)
    net, prior = SampleAggregator(24, 12), None if own_prior else torch.rand(150, 3, 5)
    before = [part.clone() for part in samples[:3]]
    with torch.no_grad():
        fast = net(samples, prior)
    assert all(torch.equal(part, old) for part, old in zip(samples[:3], before, strict=True)), (
        "inputs are not changed"
    )
    slow = net(samples, prior)
    for name, own, wanted in zip(fast._fields, fast, slow, strict=True):
        torch.testing.assert_close(
            own, wanted.detach(), atol=1e-5, rtol=1e-5, msg=lambda m, name=name: f"{name}: {m}"
        )
    seen = samples.features[..., IN_VIEW]
    assert not bool(fast.trust[seen == 0].any())
    torch.testing.assert_close(fast.trust.sum(2), seen.amax(2), atol=1e-5, rtol=0)
    mean = (fast.trust[..., None] * samples.features).sum(2)
    torch.testing.assert_close(fast.rgba, mean[..., :4])


def some_cameras(rays, cameras: int, count: int):
    """Indices of cameras for each ray, drawn at random."""
    rng = torch.Generator().manual_seed(3)
    return torch.rand(len(rays.cells), cameras, generator=rng).argsort(1)[:, :count].contiguous()


@pytest.mark.parametrize("cubic", [False, True])
@pytest.mark.parametrize("kernels", [True, False])
def test_rays_are_sampled_in_their_own_cameras_only(scene, kernels, cubic):
    _, view, sources = scene
    sample = sample_rays if kernels else sample_rays_torch
    rays = rays_of(view)
    chosen = some_cameras(rays, len(sources.cameras), 2)
    everything = sample(rays, sources, 2.0, cubic)
    found = sample(replace(rays, cameras=chosen), sources, 2.0, cubic)
    index = chosen[:, None, :, None].expand(-1, len(OFFSETS), -1, sum(CAMERA_CHANNELS))
    features = everything.features[..., : sum(CAMERA_CHANNELS)].gather(2, index)
    torch.testing.assert_close(found.features[..., : sum(CAMERA_CHANNELS)], features, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.statistics[..., 6:], everything.statistics[..., 6:], atol=1e-6, rtol=0)
    seen = found.features[..., IN_VIEW].amax(2)
    torch.testing.assert_close(found.prior.sum(2), seen, atol=1e-3, rtol=0)
    parts = [sample(part, sources, 2.0, cubic) for part in replace(rays, cameras=chosen).split(700)]
    together = torch.cat([part.features for part in parts])
    torch.testing.assert_close(together, found.features, atol=0 if kernels else 1e-6, rtol=0)


def test_a_camera_that_does_not_exist_sees_nothing(scene, monkeypatch):
    _, view, sources = scene
    rays = rays_of(view)
    chosen = some_cameras(rays, len(sources.cameras), 2)
    absent = torch.cat([chosen, torch.full_like(chosen[:, :1], len(sources.cameras))], 1)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    wanted = sample_rays_torch(replace(rays, cameras=chosen), sources, 2.0)
    found = sample_rays_torch(replace(rays, cameras=absent), sources, 2.0)
    assert torch.equal(found.statistics, wanted.statistics) and not bool(found.features[:, :, 2].any())


@pytest.mark.parametrize("kernels", [True, False])
def test_cameras_are_chosen_by_their_prior_weights(scene, kernels, monkeypatch):
    _, view, sources = scene
    monkeypatch.setattr(SourceCameras, "use_kernels", kernels)
    rays = rays_of(view)
    features = CameraFeatures.unstack(
        sample_rays_torch(rays, sources, 2.0).features[..., : sum(CAMERA_CHANNELS)]
    )
    weight = (4 * features.viewing_cosine).exp() / (1 + (6 * features.depth_difference).exp())
    scores = (features.in_view * weight).sum((1, 3))
    chosen = choose_cameras(rays, sources, 2)
    own, others = (scores.gather(1, index) for index in (chosen, scores.argsort(1, descending=True)[:, :2]))
    torch.testing.assert_close(own, others, atol=1e-2, rtol=1e-3)
    assert len(chosen.unique(dim=0)) > 3, "they depend on the ray"
    assert choose_cameras(rays, sources, len(sources.cameras)) is None


def test_cameras_chosen_by_samples_that_are_taken_anyway_are_the_same(scene, monkeypatch):
    _, view, sources = scene
    monkeypatch.setattr(SourceCameras, "use_kernels", False)
    rays, choice = rays_of(view), CameraChoice((1, 6, 10), 2)
    found = sample_rays_torch(rays, sources, 2.0, choice=choice)
    wanted = sample_rays_torch(with_cameras(rays, sources, choice), sources, 2.0)
    assert torch.equal(found.cameras, wanted.cameras) and len(found.cameras.unique(dim=0)) > 3
    for one, other in zip(found[:3], wanted[:3], strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=0)


@pytest.mark.parametrize("way", ["kernels", "torch", "export"])
def test_of_cameras_that_see_a_ray_equally_well_the_first_are_chosen(scene, way, monkeypatch):
    """Otherwise each runtime may choose others of equal ones, and sample other cameras than the model."""
    _, view, sources = scene
    monkeypatch.setattr(SourceCameras, "use_kernels", way == "kernels")
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: way == "export")
    rays = rays_of(view)
    in_no_view = replace(rays, z_m=torch.zeros_like(rays.z_m))
    count = len(sources.cameras) - 1
    chosen = choose_cameras(in_no_view, sources, count)
    assert torch.equal(chosen.sort(1).values, torch.arange(count).expand(len(chosen), -1))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_an_export_interpolates_the_same_pixels(dtype, rng, monkeypatch):
    images = (torch.rand(3, 4, 9, 7, generator=rng) * 255).to(dtype)
    levels = MipLevels.full(images)
    uv_px = torch.rand(20, 5, 3, 2, generator=rng).double() * torch.tensor([7.0, 9.0])
    at = Projections(uv_px, uv_px[..., 0], uv_px[..., 0] >= 0)
    expected = sample_level(levels, at, 4)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    torch.testing.assert_close(sample_level(levels, at, 4), expected, atol=1e-6, rtol=0)
    assert float(expected.std()) > 0.05
