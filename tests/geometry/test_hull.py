"""The visual hull: the slow twin, both fast paths, the search for the subject's box, and bounds from nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from geometry.solids import around, ball_masks, camera_at, dome
from reference.hull_twin import hull_twin

from viewmend.geometry import hull as hull_module
from viewmend.geometry._hull_numba import NEAR_M, locate
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import concatenate_cameras
from viewmend.geometry.hull import (
    FAINT,
    ISO,
    HullConfig,
    OccupancyGrid,
    any_in_blocks,
    bounds_from_cameras,
    bounds_from_masks,
    choose_pools,
    filled_sides,
    needed_views,
    occupied_bounds,
    visual_hull,
)
from viewmend.geometry.proxy import reconstruct

SMALL = HullConfig(resolution=16)


@pytest.fixture(params=["numba", "torch"])
def path(request, monkeypatch) -> str:
    """Run a test on the numba path and on the torch path."""
    if request.param == "torch":
        monkeypatch.setattr(hull_module, "_has_kernels", lambda mask: False)
    return request.param


def mixed_rig():
    """Views of three sizes that crop the subject, one camera amid the volume, one turned away from it; soft masks."""
    views = [
        camera_at((2.0, 0.3, 0.1), width=40, height=30),
        camera_at((0.2, -0.3, 2.0), width=30, height=44),
        camera_at((-1.4, 0.8, -1.0), width=40, height=44, fov=0.4),
        camera_at((0.4, 0.3, -0.2), target=(-1.0, 0.0, 0.3), width=36, height=30, fov=1.2),
        camera_at((0.0, 0.2, -2.0), target=(0.0, 0.2, -3.0), width=30, height=30),
        camera_at((1.5, -0.5, -1.2), width=17, height=13),
    ]
    cameras = concatenate_cameras(views)
    masks = ball_masks(cameras)
    masks[2, 10:20] = 128
    masks[3, :, :18] = 255
    return cameras, masks


@pytest.mark.parametrize(("pixels_per_voxel", "distinct"), [(1.0, 2), (30.0, 1)])
def test_equals_the_twin(path, pixels_per_voxel, distinct):
    cameras, masks = mixed_rig()
    config = replace(SMALL, pixels_per_voxel=pixels_per_voxel)
    bounds = Bounds(torch.tensor([-0.7, -0.6, -0.5]), torch.tensor([0.6, 0.7, 0.6]))
    grid = visual_hull(masks, cameras, bounds, config)
    pools = choose_pools(cameras, bounds, grid.voxel_m, pixels_per_voxel)
    assert len(set(pools)) == distinct and (max(pools) > 1) == (pixels_per_voxel < 30)
    needed = hull_module.needed_views(6, config, hull_module.count_cut_off(masks, cameras))
    twin = hull_twin(masks, cameras, grid.low, grid.voxel_m, grid.values.shape, pools, needed)
    # A voxel whose image is on an image's very border may be seen by one and not by the other.
    assert ((grid.values - torch.from_numpy(twin)).abs() > 0.01).float().mean() < 1e-3
    assert 0.05 < (grid.values > 0.5).float().mean() < 0.95


def test_points_behind_a_camera_never_count(path):
    """The mirror image of the subject behind a camera is neither kept nor carved."""
    cameras = concatenate_cameras([dome(4), camera_at((0.0, 0.0, 1.0), target=(0.0, 0.0, 3.0), name="away")])
    masks = ball_masks(cameras)
    assert not masks[4].any()
    config = replace(SMALL, min_fraction=0.0)
    with_it = visual_hull(masks, cameras, around(0.6), config)
    without = visual_hull(masks[:4], cameras[0:4], around(0.6), config)
    assert torch.equal(with_it.values, without.values)


def test_space_that_too_few_cameras_see_is_empty(path):
    """Bounds much larger than what the rig sees do not fill up at their corners."""
    cameras = dome(8)
    grid = visual_hull(ball_masks(cameras), cameras, around(4.0), HullConfig(resolution=64))
    filled = (grid.values > 0.1).nonzero() * grid.voxel_m + grid.low
    assert len(filled) and filled.norm(dim=1).max() < 0.9


@pytest.mark.parametrize(("views", "expected"), [(2, 2), (3, 2), (4, 2), (8, 4), (19, 10)])
def test_half_of_the_cameras_must_see_a_point(views, expected):
    assert needed_views(views, HullConfig()) == expected


def test_cropped_subjects_keep_what_some_cameras_do_not_see(path):
    """A camera that sees the lower half only says nothing about the upper one."""
    cameras = dome(6)
    everyone = concatenate_cameras(
        [cameras, camera_at((0.0, -0.5, 2.5), target=(0.0, -0.9, 0.0), name="low")]
    )
    masks = ball_masks(everyone)
    assert masks[6, 0].any(), "the subject leaves this image at the top"
    with_it = visual_hull(masks, everyone, around(0.6), SMALL)
    without = visual_hull(masks[:6], cameras, around(0.6), SMALL)
    top = with_it.values.shape[1] * 3 // 4
    assert torch.equal(with_it.values[:, top:], without.values[:, top:])
    assert (without.values[:, top:] > 0.5).any()


def test_the_search_keeps_all_of_the_hull(path):
    cameras = dome(7, fov=1.4)
    masks = ball_masks(cameras, center=(0.3, -0.1, 0.2), radius=0.3)
    box = occupied_bounds(masks, cameras, around(1.6), HullConfig())
    assert box is not None and float(box.size_m.max()) < 1.2
    grid = visual_hull(masks, cameras, around(1.0), HullConfig(resolution=50))
    filled = (grid.values > 0).nonzero() * grid.voxel_m + grid.low
    assert (filled.amin(0) + grid.voxel_m >= box.low).all() and (filled.amax(0) <= box.high).all()


def test_the_search_finds_nothing_where_masks_contradict(path):
    cameras = dome(4)
    masks = ball_masks(cameras, radius=0.3)
    masks[2] = 0
    assert occupied_bounds(masks, cameras, around(0.8), HullConfig()) is None


def test_cameras_of_low_resolution_carve_no_thin_parts_away(path):
    """A rod of 4 voxels, whose image is 4 pixels wide in two of the five cameras, and 40 in the others."""
    large = dome(3, width=480, height=400)
    small = [camera_at(eye, width=48, height=40) for eye in ((-1.9, 0.4, 1.7), (1.5, -0.3, -2.0))]
    cameras = concatenate_cameras([large, *small])
    masks = torch.zeros(5, 400, 480, dtype=torch.uint8)
    for view, (width, height) in enumerate(cameras.sizes):
        half = width // 24
        masks[view, :height, width // 2 - half : width // 2 + half] = 255
    config = HullConfig(resolution=40)
    bounds = around(0.8)
    assert choose_pools(cameras, bounds, 0.04, 2.0) == (4, 4, 4, 1, 1)
    values = visual_hull(masks, cameras, bounds, config).values
    assert (values[19:21, 10:30, 19:21] > ISO).all()


@pytest.mark.parametrize("scale", [0.01, 1.0, 1000.0])
def test_bounds_from_masks_hold_the_subject(scale):
    cameras = concatenate_cameras(
        [camera_at(eye) for eye in ((2.5, 0.5, 0.0), (1.5, 0.2, 2.0), (-1.0, 0.0, 2.4))]
    )
    masks = ball_masks(cameras, center=(0.2, 0.1, 0.3), radius=0.4)
    pose = cameras.camera_from_world.clone()
    pose[:, :3, 3] *= scale
    bounds = bounds_from_masks(masks, replace(cameras, camera_from_world=pose))
    center = torch.tensor([0.2, 0.1, 0.3]) * scale
    assert (bounds.low <= center - 0.4 * scale).all() and (bounds.high >= center + 0.4 * scale).all()
    assert float(bounds.size_m.max()) < 1.5 * scale, "as by the masks, not by all that the cameras see"


def test_bounds_hold_what_cameras_look_at_and_cameras_that_look_apart_have_none():
    bounds = bounds_from_cameras(dome(6))
    assert (bounds.low <= -0.6).all() and (bounds.high >= 0.6).all() and float(bounds.size_m.max()) < 3
    apart = [camera_at((1.0, 0, 0), target=(3.0, 0, 0)), camera_at((-1.0, 0, 0.1), target=(-3.0, 0, 0.1))]
    with pytest.raises(ValueError, match="OpenCV axes"):
        bounds_from_cameras(concatenate_cameras(apart))


def test_masks_that_show_no_common_subject_have_an_empty_hull():
    cameras = concatenate_cameras([camera_at((2.5, 0, -0.2)), camera_at((2.5, 0, 0.2))])
    width, height = cameras.max_size_px
    masks = torch.zeros(2, 2, height, width, dtype=torch.uint8)  # outer edges, then inner ones
    for number, sides in enumerate(((slice(0, 3), slice(-3, None)), (slice(-3, None), slice(0, 3)))):
        for view, columns in enumerate(sides):
            masks[number, view, height // 2 - 2 : height // 2 + 2, columns] = 255
    low = bounds_from_cameras(cameras).low
    diverging = [own for own in masks if torch.equal(bounds_from_masks(own, cameras).low, low)]
    assert len(diverging) == 1 and len(reconstruct(diverging[0], cameras).mesh.vertices) == 0


@pytest.mark.parametrize("shape", [(7, 5, 6), (4, 8, 3), (1, 1, 1)])
@pytest.mark.parametrize("value", [0.0, FAINT, 0.3, ISO, 0.6])
def test_a_grid_is_summarised_as_on_a_device(shape, value, rng):
    """A few voxels have the value, in single precision as on the grid; the others are empty."""
    values = torch.where(torch.rand(shape, generator=rng) > 0.9, value, 0.0)
    summary = OccupancyGrid(values, torch.zeros(3), 0.1).summary
    assert torch.equal(summary.blocks, any_in_blocks(values >= ISO))
    assert summary.inside == filled_sides(values > ISO)
    assert summary.filled == filled_sides(values > FAINT)


@pytest.mark.parametrize("target_x", [1.0, 1.1])
@pytest.mark.parametrize("shown", [0, 1])
def test_parallel_or_diverging_cameras_have_an_empty_hull_if_fewer_than_two_masks_show_something(
    target_x, shown
):
    pair = [camera_at((x, 0.0, 0.0), target=(target_x * x, 0.0, 3.0)) for x in (-0.4, 0.4)]
    cameras = concatenate_cameras(pair)
    masks = ball_masks(cameras, center=(0.0, 0.0, 3.0))
    assert len(reconstruct(masks, cameras, None, SMALL).mesh.vertices)
    masks[shown:] = 0
    proxy = reconstruct(masks, cameras, None, SMALL)
    assert len(proxy.mesh.vertices) == 0
    assert float(proxy.center[2]) > 0, "the middle of its box is in front of the cameras"


def test_one_camera_is_an_error():
    cameras = dome(3)
    masks = ball_masks(cameras)
    with pytest.raises(ValueError, match="at least two cameras"):
        visual_hull(masks[:1], cameras[0], around(1.0), SMALL)


def test_empty_masks_have_an_empty_hull_where_all_cameras_look():
    cameras = dome(3)
    masks = torch.zeros_like(ball_masks(cameras))
    assert not visual_hull(masks, cameras, around(1.0), SMALL).values.any()
    for found in (bounds_from_masks(masks, cameras), reconstruct(masks, cameras).bounds):
        assert torch.equal(found.low, bounds_from_cameras(cameras).low)
    assert len(reconstruct(masks, cameras).mesh.vertices) == 0


@pytest.mark.gpu
def test_cuda_equals_cpu():
    cameras, masks = mixed_rig()
    here = visual_hull(masks, cameras, around(0.7), SMALL)
    there = visual_hull(masks.cuda(), cameras.to("cuda"), around(0.7).to("cuda"), SMALL)
    assert ((here.values - there.values.cpu()).abs() > 0.01).float().mean() < 1e-3


def test_an_image_has_the_points_on_its_first_borders_and_none_on_its_last():
    """The camera sees (u, v, 1) at (u, v) of the mask, which is pooled by 2 to 4 x 3 pixels."""
    points = [
        ((0.0, 0.0, 1.0), True),
        ((3.99, 2.99, 1.0), True),
        ((4.0, 1.0, 1.0), False),
        ((1.0, 3.0, 1.0), False),
        ((-0.01, 1.0, 1.0), False),
        ((1.0, -0.01, 1.0), False),
        ((0.0, 0.0, NEAR_M), False),
        ((0.0, 0.0, 2 * NEAR_M), True),
        ((1.0, 1.0, -1.0), False),
    ]
    scratch = np.zeros((8, len(points)), np.float32)
    scratch[:3] = np.array([point for point, _ in points]).T
    P = np.diag([2.0, 2.0, 1.0]) @ np.eye(3, 4)
    locate(P, (0.0, 0.0, 0.0), 1.0, np.array([8, 6]), 2, len(points), scratch)
    u, v = scratch[6:]
    assert (u >= 0).tolist() == [seen for _, seen in points]
    assert u[1] == pytest.approx(3.99) and v[1] == pytest.approx(2.99)


def test_voxels_are_located_in_the_pooled_mask():
    """A general camera, whose rows all depend on all coordinates, against the projection in 64 bits."""
    rng = np.random.default_rng(0)
    P = rng.uniform(-9, 9, (3, 4))
    P[2] = rng.uniform(0.5, 1, 4)
    P[:, 3] += [50, 50, 5]
    origin = np.array([0.3, 0.5, 0.7])
    voxels = rng.integers(0, 8, (30, 3))
    scratch = np.zeros((8, len(voxels)), np.float32)
    scratch[:3] = voxels.T
    locate(P, tuple(origin), 0.25, np.array([60, 50]), 2, len(voxels), scratch)
    u, v, z = P[:, :3] @ (origin + 0.25 * voxels).T + P[:, 3:]
    assert ((u > 0) & (v > 0) & (u / z < 60) & (v / z < 50)).all(), "all are in view"
    np.testing.assert_allclose(scratch[6], u / z / 2, rtol=1e-5)
    np.testing.assert_allclose(scratch[7], v / z / 2, rtol=1e-5)
