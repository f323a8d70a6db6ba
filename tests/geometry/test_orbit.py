"""Where novel views are looked at from."""

import math
from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at

from viewmend.geometry.cameras import Cameras, concatenate_cameras, project
from viewmend.geometry.orbit import fit_to, orbit_around

CENTER = torch.tensor([0.1, 0.0, -0.1])


def degrees_around(cameras: Cameras) -> torch.Tensor:
    offsets = cameras.centers - CENTER
    return torch.rad2deg(torch.atan2(offsets[:, 0], offsets[:, 2]))


def test_a_ring_is_circled_at_its_own_height_and_distance():
    rig = concatenate_cameras([camera_at(30 * n, f"c{n}", height_m=0.7) for n in range(12)])
    path = orbit_around(CENTER, rig, None, 8, 8)
    steps = (degrees_around(path).diff() + 360) % 360
    torch.testing.assert_close(steps, torch.full((7,), 45.0), atol=1e-2, rtol=0)
    distance = (rig.centers - CENTER).norm(dim=-1).mean()
    torch.testing.assert_close((path.centers - CENTER).norm(dim=-1), distance.expand(8), atol=1e-3, rtol=0)
    assert path.centers[:, 1].std() < 1e-4 and path.centers[0, 1] == pytest.approx(0.7, abs=0.05)
    middle, _ = project(CENTER[None], path)
    torch.testing.assert_close(middle[:, 0], torch.full((8, 2), 24.0), atol=1e-2, rtol=0)
    torch.testing.assert_close(path.K[0, 1, 1], rig.K[0, 1, 1], atol=0.5, rtol=0)


def test_a_rig_on_one_side_is_swung_over():
    rig = concatenate_cameras([camera_at(angle, f"c{angle}") for angle in (-60, -20, 10, 50)])
    around = degrees_around(orbit_around(CENTER, rig, None, 30, 30))
    assert around.min() >= -65 and around.max() <= 56
    assert around.max() - around.min() > 100
    assert around[0] == pytest.approx(float(around[-1]), abs=3)


@pytest.mark.parametrize("arc_deg", [40, 360])
def test_an_arc_is_swung_around_the_rigs_middle(arc_deg):
    rig = concatenate_cameras([camera_at(angle, f"c{angle}") for angle in (-60, -20, 10, 50)])
    path = orbit_around(CENTER, rig, None, 40, 40, math.radians(arc_deg), (80, 48))
    around = degrees_around(path)
    assert path.size_px[0].tolist() == [80, 48]
    if arc_deg == 360:
        assert (around.diff() % 360).sub(9).abs().max() < 0.1
    else:
        assert around.mean() == pytest.approx(-5, abs=5) and around.max() - around.min() == pytest.approx(
            40, abs=0.5
        )


def test_a_path_is_fitted_to_all_points():
    rig = concatenate_cameras([camera_at(30 * n, f"c{n}") for n in range(12)])
    points = CENTER + 0.4 * torch.randn(200, 3, generator=torch.manual_seed(0)).clamp(-1, 1)
    uv_px, _ = project(points, fit_to(orbit_around(CENTER, rig, None, 9, 9, size_px=(90, 50)), points))
    size = torch.tensor([90.0, 50.0])
    assert (uv_px > 0).all() and (uv_px < size).all()
    free = torch.minimum(uv_px, size - uv_px) / size
    assert free.min() == pytest.approx(0.03, abs=1e-3), "and no further"


def test_images_upside_down_do_not_tilt_the_orbit():
    """The cameras of one side are upside down and look downwards: the mean of their ups points sideways."""
    rig = concatenate_cameras([camera_at(45 * n, f"c{n}", height_m=0.8) for n in range(8)])
    turned = torch.diag(torch.tensor([-1.0, -1, 1, 1]))
    poses = torch.stack([turned @ pose if n < 4 else pose for n, pose in enumerate(rig.camera_from_world)])
    path = orbit_around(CENTER, replace(rig, camera_from_world=poses), None, 6, 6)
    assert path.centers[:, 1].std() < 1e-3
