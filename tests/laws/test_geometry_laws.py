"""Laws of the geometry, on analytic scenes and random rigs."""

from dataclasses import replace

import pytest
import torch
from geometry.solids import around, ball_masks, dome, volume
from hypothesis import example, given, settings
from hypothesis import strategies as st

from viewmend.geometry.cameras import Cameras, project, unproject
from viewmend.geometry.hull import HullConfig, visual_hull
from viewmend.geometry.proxy import reconstruct
from viewmend.geometry.rigid import invert_rigid, rigid, rotation_from_axis_angle

CONFIG = HullConfig(resolution=32)
seeds = st.integers(0, 10_000)


def random_rig(seed: int, views: int = 3) -> Cameras:
    """Cameras anywhere, looking anywhere, with skewed, uneven K."""
    rng = torch.Generator().manual_seed(seed)
    pose = rigid(
        rotation_from_axis_angle(torch.randn(views, 3, generator=rng)), torch.randn(views, 3, generator=rng)
    )
    K = torch.tensor([[80.0, 0.0, 50.0], [0.0, 80.0, 40.0], [0.0, 0.0, 1.0]]).repeat(views, 1, 1)
    K[:, 0, 0] *= 0.5 + torch.rand(views, generator=rng)
    K[:, 0, 1] = 4 * torch.randn(views, generator=rng)
    return Cameras(tuple(f"c{v}" for v in range(views)), K, pose, torch.tensor([[100, 80]] * views))


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_projecting_what_was_unprojected_is_the_identity(seed):
    rng = torch.Generator().manual_seed(seed)
    cameras = random_rig(seed)
    uv = torch.rand(3, 5, 2, generator=rng) * 100
    z = torch.rand(3, 5, generator=rng) * 5 + 0.1
    world = unproject(uv, z, cameras)
    for view in range(3):
        back, depth = project(world[view], cameras[view])
        torch.testing.assert_close(back[0], uv[view], atol=2e-2, rtol=1e-4)
        torch.testing.assert_close(depth[0], z[view], atol=1e-4, rtol=1e-4)


@given(st.lists(st.integers(0, 7), min_size=2, max_size=8, unique=True), st.integers(0, 7))
@example([7, 3], 0)
@settings(max_examples=6, deadline=None)
def test_more_views_never_grow_the_hull(some, another):
    """Where enough cameras see a point in both cases, one more mask only takes away."""
    cameras = dome(8)
    masks = ball_masks(cameras, center=(0.1, 0.0, -0.1))
    config = replace(CONFIG, min_fraction=0.0)
    grid = visual_hull(masks[some], cameras[some], around(0.7), config)
    more_views = sorted({*some, another})
    more = visual_hull(masks[more_views], cameras[more_views], around(0.7), config).values
    index = torch.cartesian_prod(*(torch.arange(side) for side in more.shape))
    uv, z = project(grid.low + (index + 0.5) * grid.voxel_m, cameras[some])
    # Half a pixel inside, since what rounds to the border may fall on either side.
    sees = (z > 0) & (uv > 0.5).all(-1) & (uv < cameras[some].size_px[:, None] - 0.5).all(-1)
    enough = (sees.sum(0) >= config.min_views).view(more.shape)
    assert enough.any()
    # Single precision rounds a voxel's image one way or the other as voxels are grouped.
    assert (more <= grid.values + 1e-4)[enough].all()


@pytest.mark.parametrize("scale", [1e-3, 10.0, 1000.0])
def test_units_do_not_matter(scale):
    """The same capture in millimetres or kilometres gives the same proxy, scaled."""
    cameras = dome(7)
    masks = ball_masks(cameras)
    pose = cameras.camera_from_world.clone()
    pose[:, :3, 3] *= scale
    scaled = replace(cameras, camera_from_world=pose)
    proxy, other = (reconstruct(masks, rig, None, CONFIG) for rig in (cameras, scaled))
    assert volume(other.mesh) / scale**3 == pytest.approx(volume(proxy.mesh), rel=0.01)
    torch.testing.assert_close(other.depth(scaled) / scale, proxy.depth(cameras), atol=0.05, rtol=0)


@given(seeds)
@settings(max_examples=2, deadline=None)
def test_the_worlds_orientation_does_not_matter(seed):
    """Turn and move the world: the proxy covers the same pixels at the same depth."""
    rng = torch.Generator().manual_seed(seed)
    motion = rigid(rotation_from_axis_angle(torch.randn(3, generator=rng)), torch.randn(3, generator=rng))
    cameras = dome(7)
    masks = ball_masks(cameras)
    moved = replace(cameras, camera_from_world=cameras.camera_from_world @ invert_rigid(motion))
    here = reconstruct(masks, cameras, None, CONFIG).depth(cameras)
    there = reconstruct(masks, moved, None, CONFIG).depth(moved)
    both = (here > 0) & (there > 0)
    assert both.sum() > 0.95 * (here > 0).sum()
    assert (here - there).abs()[both].median() < 0.01
