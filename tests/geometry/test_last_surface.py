"""The last surface as a prior: the slow reference, what counts as a change, and a dent that opens."""

from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, ring
from reference.fusion_reference import steadied_reference
from torch.nn.functional import avg_pool2d, max_pool2d

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import concatenate_cameras
from viewmend.geometry.hull import Cubes, OccupancyGrid
from viewmend.geometry.last_surface import BEHIND_VOXELS, SIMILAR, LastSurface, continued, steadied, stillness

BOX = Bounds(torch.full((3,), -0.6), torch.full((3,), 0.6))
CAMERAS = concatenate_cameras([ring(3, 40), camera_at(10, "near", 40, height_m=1.5)])


def solid(inside, box=BOX, resolution=24) -> OccupancyGrid:
    """A solid on a grid; `inside` is how far points are inside, metres."""
    cubes = Cubes.of(box, resolution)
    distance = inside(cubes.centers(torch.device("cpu"))) / cubes.side_m
    return OccupancyGrid((0.5 + distance / 2).clamp(0, 1).view(cubes.shape), cubes.low, cubes.side_m)


def ball(radius_m):
    return lambda points: radius_m - points.norm(dim=-1)


def test_it_equals_the_slow_reference(rng):
    own = solid(ball(0.45), resolution=13)
    hull = solid(ball(0.5), resolution=13)
    elsewhere = Bounds(torch.tensor([-0.5, -0.62, -0.55]), torch.tensor([0.55, 0.5, 0.61]))
    depth = 1.5 + 0.3 * torch.rand(4, 40, 40, generator=rng)
    depth[:, :9] = 0
    last = LastSurface(solid(ball(0.4), elsewhere, 15), CAMERAS, depth, torch.rand(4, 40, 40, generator=rng))
    found = steadied(own, hull, last, 0.7).values
    expected = torch.from_numpy(steadied_reference(own, hull, last, 0.7, BEHIND_VOXELS * own.voxel_m))
    # A voxel whose image is on a pixel's border may read its neighbour.
    assert ((found - expected).abs() > 1e-4).float().mean() < 2e-3
    assert ((found - own.values).abs() > 0.05).sum() > 50


def test_the_hull_is_never_exceeded_and_nothing_is_kept_where_all_changed():
    hull = solid(ball(0.3))
    own = solid(ball(0.25))
    image = torch.zeros(4, 40, 40)
    still = LastSurface(solid(ball(0.5)), CAMERAS, image, image + 1)
    assert (steadied(own, hull, still, 0.9).values <= hull.values).all()
    assert (steadied(own, hull, still, 0.9).values > own.values + 0.1).any()
    changed = replace(still, stillness=image)
    assert torch.equal(steadied(own, hull, changed, 0.9).values, own.values)


@pytest.mark.parametrize("changed", [0, 1, 2])
def test_one_camera_that_sees_a_change_is_enough(changed):
    hull = solid(ball(0.5))
    own = solid(ball(0.4))
    cameras = ring(3, 40)
    image = torch.ones(3, 40, 40)
    still = LastSurface(hull, cameras, image, image)
    one = torch.arange(3)[:, None, None] == changed
    last = replace(still, stillness=torch.where(one, 0.0, image), depth=torch.where(one, 0.0, 9 * image))
    assert not torch.equal(steadied(own, hull, still, 0.8).values, own.values)
    assert torch.equal(steadied(own, hull, last, 0.8).values, own.values)


def test_a_surface_that_stays_converges_to_what_the_depth_says():
    hull = solid(ball(0.5))
    own = solid(ball(0.4))
    image = torch.ones(4, 40, 40)
    kept = solid(ball(0.5))
    errors = []
    for _ in range(8):
        kept = steadied(own, hull, LastSurface(kept, CAMERAS, image, image), 0.8)
        errors.append(float((kept.values - own.values).abs().sum()))
    assert errors[-1] < 0.3 * errors[0]


def test_noise_is_no_change_but_a_thin_line_that_moves_is(rng):
    image = torch.randint(40, 200, (2, 4, 30, 40), generator=rng).byte()
    assert torch.equal(stillness(image, image), torch.ones(2, 30, 40))
    noise = (3 * torch.randn(image.shape, generator=rng)).round()
    noisy = (image.float() + noise).byte()
    assert float(stillness(noisy, image).median()) > 0.8

    mean = avg_pool2d(noisy.float() - image.float(), 5, 1, 2).abs().amax(1)
    change = max_pool2d(mean, 5, 1, 2)
    assert torch.allclose(stillness(noisy, image), torch.exp(-((change / SIMILAR) ** 2)), atol=1e-5)

    line = torch.zeros(1, 4, 30, 40).byte()
    moved = line.clone()
    line[..., 20] = 200
    moved[..., 22] = 200
    still = stillness(moved, line)
    assert float(still[..., 18:25].max()) < 0.01
    assert float(still[..., :12].min()) == 1


def test_a_dent_that_opens_is_open_at_once():
    """No mask shows a dent, so only colours say that what filled it has gone."""
    cameras = concatenate_cameras([ring(3, 40), camera_at(0, "above", 40, height_m=2.0)])
    hull = solid(ball(0.5), resolution=32)
    dented = solid(
        lambda points: torch.minimum(
            ball(0.5)(points), (points - torch.tensor([0.0, 0.45, 0.0])).norm(dim=-1) - 0.3
        ),
        resolution=32,
    )
    image = torch.ones(4, 40, 40)
    last = LastSurface(hull, cameras, torch.zeros(4, 40, 40), image)
    stays = steadied(dented, hull, last, 0.8)
    assert float((stays.values - dented.values).max()) > 0.5, "without a change, it would fill the dent"
    above = torch.arange(4)[:, None, None] == 3
    opened = steadied(dented, hull, replace(last, stillness=torch.where(above, 0.0, image)), 0.8)
    assert torch.equal(opened.values, dented.values)


def test_voxels_continue_the_last_frames():
    last = Cubes.of(BOX, 24)
    grid = OccupancyGrid(torch.zeros(last.shape), last.low, last.side_m)
    moved = Bounds(torch.tensor([-0.57, -0.61, -0.52]), torch.tensor([0.55, 0.56, 0.6]))
    box, resolution = continued(moved, 24, grid)
    cubes = Cubes.of(box, resolution)
    assert cubes.side_m == pytest.approx(last.side_m, rel=1e-5)
    steps = (cubes.low - last.low) / last.side_m
    assert torch.allclose(steps, steps.round(), atol=1e-3)
    assert (box.low <= moved.low + 1e-4).all()
    assert (box.high >= moved.high - 1e-4).all()
    assert (box.size_m < moved.size_m + 2.01 * last.side_m).all()

    same, resolution = continued(BOX, 24, grid)
    assert resolution == 24
    assert torch.allclose(torch.stack([same.low, same.high]), torch.stack([BOX.low, BOX.high]), atol=1e-6)
    larger = Bounds(1.2 * BOX.low, 1.2 * BOX.high)
    assert continued(larger, 24, grid) == (larger, 24)
