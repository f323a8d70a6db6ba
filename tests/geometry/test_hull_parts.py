"""Parts of a hull that float and that no mask needs are dropped; people and things that a camera sees stay."""

import pytest
import torch
from geometry.solids import around, ball_masks, camera_at, dome
from scipy.ndimage import label

from viewmend.geometry.cameras import concatenate_cameras
from viewmend.geometry.hull import HullConfig, OccupancyGrid, visual_hull
from viewmend.geometry.hull_parts import without_floating_parts

CONFIG = HullConfig(resolution=72)


def carve(cameras, balls, radius):
    masks = torch.stack([ball_masks(cameras, ball, radius) for ball in balls]).amax(0)
    grid = visual_hull(masks, cameras, around(1.1), CONFIG)
    return grid, without_floating_parts(grid, cameras)


def parts(grid):
    return label((grid.values >= 0.5).numpy())[1]


def at(grid, point):
    """The value at a point."""
    return grid.values[tuple(((torch.tensor(point) - grid.low) / grid.voxel_m).long())].item()


@pytest.mark.parametrize("count", [4, 5, 7])
def test_a_phantom_is_dropped_and_what_made_it_stays(count):
    """Every camera sees a ball of its own in front of the middle, so that the masks allow something there."""
    cameras = dome(count, width=192, height=160)
    balls = [tuple(0.75 * torch.nn.functional.normalize(center, dim=0)) for center in cameras.centers]
    before, after = carve(cameras, balls, 0.12)
    assert parts(before) > count and at(before, (0.0, 0.0, 0.0)) > 0.9
    assert parts(after) == count and at(after, (0.0, 0.0, 0.0)) == 0.0
    assert all(at(after, ball) > 0.9 for ball in balls)
    middle = (before.values > 0) & (after.values == 0)
    assert torch.equal(after.values[~middle], before.values[~middle])


def test_separate_people_and_things_in_the_air_stay():
    balls = [(-0.6, 0.0, 0.1), (0.6, 0.0, -0.2), (0.1, 0.7, 0.3)]
    before, after = carve(dome(5, width=192, height=160), balls, 0.22)
    assert all(kept(before, after, ball, 0.3) for ball in balls) and parts(after) < parts(before)


def test_a_ball_that_one_camera_sees_on_its_own_stays():
    """It is in front of or behind another in all cameras but one, from above."""
    ring = [camera_at((2.5, 0.0, 0.01 * n), width=160, height=160) for n in (-2, 0, 2)]
    above = camera_at((0.3, 2.5, 0.0), target=(0.3, 0.0, 0.1), width=160, height=160)
    balls = [(0.7, 0.0, 0.0), (-0.2, 0.0, 0.0)]
    before, after = carve(concatenate_cameras([*ring, above]), balls, 0.15)
    assert all(kept(before, after, ball, 0.3) for ball in balls)
    assert parts(before) == 3 and parts(after) == 2, "what nothing needs, out of sight from above"


def without_parts(values, cameras):
    return without_floating_parts(OccupancyGrid(values, torch.full((3,), -0.5), 0.025), cameras).values


@pytest.mark.parametrize(("rows_covered", "stays"), [(8, False), (2, True)])
def test_a_part_that_covers_a_strip_by_chance_is_dropped(rows_covered, stays):
    """Masks of real cameras disagree by strips at the outline, which a part behind the subject can cover."""
    values = torch.zeros(40, 40, 40)
    values[25:35, 5:25, 10:30] = 1.0
    values[5:10, 25 - rows_covered : 35 - rows_covered, 15:25] = 1.0
    far = [camera_at((30.0, 0.0, z), width=1600, height=1600) for z in (-0.1, 0.0, 0.1)]
    after = without_parts(values, concatenate_cameras(far))
    assert torch.equal(after[20:], values[20:]) and bool(after[:20].any()) == stays


@pytest.mark.parametrize(("side", "stays"), [(2, False), (6, True)])
def test_a_speck_is_dropped_and_a_small_ball_stays(side, stays):
    values = torch.zeros(40, 40, 40)
    values[5:25, 5:25, 5:25] = 1.0
    values[32 : 32 + side, 32 : 32 + side, 32 : 32 + side] = 1.0
    after = without_parts(values, dome(5, width=800, height=800))
    assert torch.equal(after[:30], values[:30]) and bool(after[30:].any()) == stays


def test_the_largest_part_stays_even_if_it_is_a_speck():
    values = torch.zeros(40, 40, 40)
    values[10, 10, 10] = values[20:22, 20, 20] = 1.0
    after = without_parts(values, dome(5, width=800, height=800))
    assert after.nonzero().tolist() == [[20, 20, 20], [21, 20, 20]]


def kept(before, after, ball, radius):
    """Whether all within this distance is as it was."""
    index = torch.stack(torch.meshgrid(*map(torch.arange, before.values.shape), indexing="ij"), -1)
    near = (before.low + (index + 0.5) * before.voxel_m - torch.tensor(ball)).norm(dim=-1) < radius
    return torch.equal(before.values[near], after.values[near]) and at(after, ball) > 0.9
