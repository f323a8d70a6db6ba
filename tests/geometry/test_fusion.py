"""Depth fusion: the slow reference, both fast paths, and laws on solids whose surface is known."""

from dataclasses import replace

import pytest
import torch
from geometry.solids import volume
from reference.ball import camera_at, ring
from reference.fusion_reference import fuse_reference

from viewmend.geometry import fusion
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import concatenate_cameras
from viewmend.geometry.fusion import DepthViews, FusionConfig, fuse_depth, fuse_occupancy
from viewmend.geometry.hull import Cubes, HullConfig, OccupancyGrid, visual_hull
from viewmend.geometry.mesh import vertex_normals
from viewmend.geometry.proxy import GeometryProxy, reconstruct
from viewmend.geometry.surface import extract_surface

BOX = Bounds(torch.full((3,), -0.6), torch.full((3,), 0.6))
ABOVE = concatenate_cameras([camera_at(90 * n + 20, f"above{n}", 96, height_m=2.0) for n in range(4)])
CONFIG = FusionConfig(resolution=48)
FAR_AWAY = torch.eye(4)
FAR_AWAY[:3, 3] = 100.0


@pytest.fixture(params=["numba", "torch"])
def fuse(request, monkeypatch):
    """`fuse_occupancy` by each of the two fast paths; returns the values."""
    if request.param == "torch":
        monkeypatch.setattr(fusion, "_sums_numba", fusion._sums_torch)
        monkeypatch.setattr(fusion, "_vote_numba", fusion._vote_torch)
    return lambda *arguments: fuse_occupancy(*arguments).values


def bowl(points):
    """How far points are inside a ball with a deep dent from above, metres; negative outside."""
    ball = 0.5 - points.norm(dim=-1)
    dent = 0.35 - (points - points.new_tensor([0.0, 0.45, 0.0])).norm(dim=-1)
    return torch.minimum(ball, -dent)


def proxy_of(inside) -> GeometryProxy:
    """The surface of a solid, from a fine grid."""
    cubes = Cubes.of(BOX, 128)
    values = (
        (0.5 + inside(cubes.centers(torch.device("cpu"))) / cubes.side_m / 2).clamp(0, 1).view(cubes.shape)
    )
    mesh = extract_surface(OccupancyGrid(values, cubes.low, cubes.side_m))
    return GeometryProxy(mesh, vertex_normals(mesh), BOX)


def true_views(proxy, cameras) -> DepthViews:
    depth = proxy.depth(cameras)
    return DepthViews(cameras, depth, torch.ones_like(depth))


def carved(proxy, cameras, views, config=CONFIG):
    """The hull of a solid's masks in these cameras, and the same after fusion."""
    mask = (255 * (proxy.depth(cameras) > 0)).byte()
    hull = reconstruct(mask, cameras, BOX)
    return hull, fuse_depth(hull, mask, cameras, views, config).proxy


def test_both_paths_equal_the_slow_reference(fuse, rng):
    proxy = proxy_of(bowl)
    cameras = concatenate_cameras(
        [*(ring(3, 40)[[n]] for n in range(3)), ABOVE[[0]], camera_at(10, "near", 30)]
    )
    mask = (255 * (proxy.depth(cameras) > 0)).byte()
    config = FusionConfig(resolution=14)
    hull = visual_hull(mask, cameras, BOX, replace(fusion.HullConfig(), resolution=14))
    exact = true_views(proxy, cameras)
    views = replace(
        exact,
        depth=exact.depth + 0.05 * torch.randn(exact.depth.shape, generator=rng) * (exact.depth > 0),
        confidence=torch.rand(exact.depth.shape, generator=rng),
    )
    found = fuse(hull, views, config)
    expected = torch.from_numpy(fuse_reference(hull, views, config))
    # A voxel whose image is on the border of a pixel may read its neighbour.
    assert ((found - expected).abs() > 1e-3).float().mean() < 2e-3
    assert (found > 0).sum() > 50


def test_a_bowl_becomes_hollow_which_no_hull_can_be():
    proxy = proxy_of(bowl)
    cameras = concatenate_cameras([ring(8, 96), ABOVE])
    hull, fused = carved(proxy, cameras, true_views(proxy, cameras))
    true = volume(proxy.mesh)
    assert volume(hull.mesh) > 1.1 * true
    assert abs(volume(fused.mesh) - true) < 0.2 * (volume(hull.mesh) - true)


def test_what_no_view_says_anything_about_stays_as_the_hull_has_it():
    proxy = proxy_of(bowl)
    cameras = concatenate_cameras([ring(8, 96), ABOVE])
    nothing = torch.zeros(len(cameras), 96, 96)
    hull, fused = carved(proxy, cameras, DepthViews(cameras, nothing, nothing))
    assert volume(fused.mesh) == pytest.approx(volume(hull.mesh), rel=0.05)


def test_the_hull_is_never_exceeded(fuse):
    proxy = proxy_of(bowl)
    cameras = ring(6, 64)
    mask = (255 * (proxy.depth(cameras) > 0)).byte()
    hull = visual_hull(mask, cameras, BOX, fusion.HullConfig(resolution=32))
    near = true_views(proxy, cameras)
    near = replace(near, depth=(near.depth - 0.2) * (near.depth > 0))
    assert (fuse(hull, near, CONFIG) <= hull.values).all()


def test_one_view_that_misses_the_subject_removes_nothing():
    proxy = proxy_of(lambda points: 0.5 - points.norm(dim=-1))
    cameras = ring(8, 96)
    views = true_views(proxy, cameras)
    blind = torch.arange(8)[:, None, None] == 3
    wrong = replace(views, depth=torch.where(blind, 0.0, views.depth))
    _, fused = carved(proxy, cameras, wrong)
    assert volume(fused.mesh) == pytest.approx(volume(proxy.mesh), rel=0.06)


def test_confident_depth_outweighs_uncertain_depth():
    proxy = proxy_of(lambda points: 0.5 - points.norm(dim=-1))
    cameras = ring(8, 96)
    views = true_views(proxy, cameras)
    wrong = torch.arange(8)[:, None, None] % 2 == 1
    depth = torch.where(wrong & (views.depth > 0), views.depth + 0.06, views.depth)

    def error_m3(confidence_of_wrong: float) -> float:
        confidence = torch.where(wrong, confidence_of_wrong, views.confidence)
        _, fused = carved(proxy, cameras, replace(views, depth=depth, confidence=confidence))
        return abs(volume(fused.mesh) - volume(proxy.mesh))

    assert error_m3(0.01) < 0.5 * error_m3(1.0)


def test_an_empty_grid_stays_empty(fuse):
    grid = OccupancyGrid(torch.zeros(4, 5, 6), torch.zeros(3), 0.1)
    cameras = ring(2)
    image = torch.zeros(2, 48, 48)
    assert not fuse(grid, DepthViews(cameras, image, image), CONFIG).any()
    assert fuse_occupancy(grid, DepthViews(cameras, image, image), CONFIG).values.shape == (4, 5, 6)


def test_a_surface_of_uncertain_depth_is_smoothed(rng):
    proxy = proxy_of(lambda points: 0.5 - points.norm(dim=-1))
    cameras = ring(8, 96)
    exact = true_views(proxy, cameras)
    noise = 0.03 * torch.randn(exact.depth.shape, generator=rng) * (exact.depth > 0)

    def roughness(confidence: float, config: FusionConfig) -> float:
        views = DepthViews(cameras, exact.depth + noise, torch.full_like(exact.depth, confidence))
        _, fused = carved(proxy, cameras, views, config)
        return float((fused.mesh.vertices.norm(dim=-1) - 0.5).std())

    light = replace(CONFIG, hull_weight=1e-3)
    sharp = replace(light, smooth_below=-2.0, sharp_above=-1.0)
    assert roughness(0.1, light) < 0.5 * roughness(0.1, sharp)
    assert roughness(0.9, light) == pytest.approx(roughness(0.9, sharp), rel=0.05)


def test_uncertain_depth_moves_the_hull_less_than_certain_depth():
    proxy = proxy_of(lambda points: 0.5 - points.norm(dim=-1))
    cameras = ring(8, 96)
    exact = true_views(proxy, cameras)
    too_deep = (exact.depth + 0.1) * (exact.depth > 0)

    def removed_m3(confidence: float) -> float:
        views = DepthViews(cameras, too_deep, torch.full_like(exact.depth, confidence))
        hull, fused = carved(proxy, cameras, views)
        return volume(hull.mesh) - volume(fused.mesh)

    assert removed_m3(0.02) < 0.5 * removed_m3(1.0)


@pytest.mark.parametrize("wrong", [{"hull_weight": 0.0}, {"smooth_below": 0.5}, {"last_share": 1.0}])
def test_a_config_without_meaning_is_refused(wrong):
    with pytest.raises(ValueError, match="expected"):
        FusionConfig(**wrong)


def test_the_hull_is_carved_with_the_parameters_given():
    cameras = ring(6, 48)
    ball = proxy_of(lambda points: 0.5 - points.norm(dim=-1))
    mask = (255 * (ball.depth(cameras) > 0)).byte()
    views = true_views(ball, cameras)
    assert len(fuse_depth(ball, mask, cameras, views, CONFIG).proxy.mesh.vertices)
    behind = replace(ABOVE[[0]], camera_from_world=ABOVE.camera_from_world[:1] @ FAR_AWAY)
    mask = torch.cat([mask, torch.zeros_like(mask[:1])])
    cameras = concatenate_cameras([cameras, behind.resized(48, 48)])
    all_must_see = HullConfig(min_fraction=1.0, least_fraction=1.0)
    six_of_seven = fuse_depth(ball, mask, cameras, views, CONFIG)
    assert len(six_of_seven.proxy.mesh.vertices), "six of seven cameras see it"
    assert not len(fuse_depth(ball, mask, cameras, views, CONFIG, all_must_see).proxy.mesh.vertices)


@pytest.mark.parametrize("field", ["depth", "confidence"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_view_says_nothing_where_its_values_are_not_finite(fuse, field, value):
    ball = proxy_of(lambda points: 0.5 - points.norm(dim=-1))
    cameras = ring(6, 48)
    mask = (255 * (ball.depth(cameras) > 0)).byte()
    hull = visual_hull(mask, cameras, BOX, HullConfig(resolution=32))
    views = true_views(ball, cameras)
    broken = getattr(views, field).clone()
    broken[:3] = value
    nothing = torch.cat([torch.zeros_like(views.depth[:3]), views.depth[3:]])
    expected = fuse(hull, replace(views, depth=nothing), CONFIG)
    assert torch.equal(fuse(hull, replace(views, **{field: broken}), CONFIG), expected)
