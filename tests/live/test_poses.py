"""Orbits around the subject, the initial view, and requested cameras."""

import math

import pytest
import torch
from reference.ball import camera_at, ring

from viewmend.geometry.cameras import concatenate_cameras, project
from viewmend.geometry.orbit import orbit
from viewmend.live.poses import cameras_json, home_view, stereo_pair, view_camera
from viewmend.live.protocol import Camera

CENTER = torch.tensor([0.1, 0.2, 0.3])
HOME = home_view(ring(4), torch.zeros(3), None)


def around(center, degrees, radius_m, elevation_deg):
    azimuths, elevation = [math.radians(d) for d in degrees], math.radians(elevation_deg)
    shown = {"center": center, "up": torch.tensor([0.0, 1.0, 0.0]), "visible_m": 2.4}
    return orbit(azimuths, (64, 64), radius_m=radius_m, elevation_rad=elevation, **shown)


def test_azimuths_are_those_of_orbits():
    frame = home_view(ring(4), CENTER, torch.tensor([0.0, 2.0, 0.0]))
    for degrees in (0, 35, 250):
        ours = view_camera(Camera(azimuth=float(degrees), elevation=12.0, distance=2.5), frame, (64, 64))
        theirs = around(CENTER, [degrees], radius_m=2.5, elevation_deg=12)
        assert torch.allclose(ours.camera_from_world, theirs.camera_from_world, atol=1e-5)


def test_the_initial_view_of_a_ring():
    assert HOME.azimuth == pytest.approx(45) and HOME.elevation == pytest.approx(0, abs=1e-4)
    assert HOME.distance_m == pytest.approx(2) and HOME.fov_y == pytest.approx(math.degrees(0.7), abs=1e-3)
    assert torch.allclose(HOME.up, torch.tensor([0.0, 1.0, 0.0]), atol=1e-5)
    lone = home_view(ring(4)[0], torch.zeros(3), None)
    assert lone.azimuth == pytest.approx(0)


@pytest.mark.parametrize("degrees", [(60, 20, 100, 40), (340, 10, 50, 140), (200, 230)])
def test_the_initial_view_of_an_arc(degrees):
    arc = around(CENTER, degrees, radius_m=2.0, elevation_deg=0)
    middle = {(60, 20, 100, 40): 60, (340, 10, 50, 140): 60, (200, 230): -145}[degrees]
    assert home_view(arc, CENTER, torch.tensor([0.0, 1.0, 0.0])).azimuth == pytest.approx(middle, abs=0.02)


def test_a_camera_by_its_matrix():
    like = camera_at(77, "x")
    R, T = like.camera_from_world[0, :3, :3], like.camera_from_world[0, :3, 3]
    asked = Camera(R=tuple(R.flatten().tolist()), T=tuple(T.tolist()), fx=50.0, fy=60.0, cy=7.0)
    camera = view_camera(asked, HOME, (40, 30))
    assert torch.allclose(camera.camera_from_world, like.camera_from_world)
    assert camera.K[0].tolist() == [[50, 0, 20], [0, 60, 7], [0, 0, 1]]


@pytest.mark.parametrize("scale", [0.5, 0.3])
def test_a_smaller_image_has_the_same_field_of_view(scale):
    point = torch.tensor([[0.2, 0.1, -0.1]])
    full, small = (view_camera(Camera(azimuth=20.0), HOME, (200, 120), s) for s in (1.0, scale))
    (a, _), (b, _) = (project(point, c) for c in (full, small))
    assert torch.allclose(a / full.size_px, b / small.size_px, atol=1e-4)
    assert small.size_px[0].tolist() == [200 * scale, 120 * scale]
    assert view_camera(Camera(), HOME, (20, 20), 0.1).size_px.tolist() == [[16, 16]]


def test_in_a_tall_image_the_subject_has_the_same_width():
    wide, tall = (view_camera(Camera(), HOME, size) for size in ((80, 80), (80, 160)))
    assert float(wide.K[0, 0, 0]) == pytest.approx(float(tall.K[0, 0, 0]), rel=1e-5)


def test_a_requested_field_of_view_is_vertical():
    asked = view_camera(Camera(fov_y=40.0), HOME, (100, 200))
    assert float(asked.K[0, 1, 1]) == pytest.approx(100 / math.tan(math.radians(20)), rel=1e-5)


@pytest.mark.parametrize(("height_m", "elevation"), [(30.0, 80.0), (-30.0, -80.0), (2.0, 45.0)])
def test_the_initial_elevation_is_limited(height_m, elevation):
    overhead = concatenate_cameras([camera_at(90 * n, f"c{n}", 48, height_m) for n in range(4)])
    assert home_view(overhead, torch.zeros(3), torch.tensor([0.0, 1, 0])).elevation == pytest.approx(
        elevation
    )


def test_cameras_as_json():
    (said,) = cameras_json(camera_at(0, "c"))
    assert said["width"] == 48 and len(said["K"]) == 9 and len(said["R"]) == 9
    assert said["center"] == pytest.approx([0, 0, 2], abs=1e-5) and said["T"] == pytest.approx(
        [0, 0, 2], abs=1e-5
    )


def test_two_eyes_have_no_disparity_at_the_subject_and_some_elsewhere():
    camera = camera_at(40, "t", size=64, distance_m=2.0)
    left, right = stereo_pair(camera, 0.1, torch.zeros(3))
    across = right.centers[0] - left.centers[0]
    assert float(across.norm()) == pytest.approx(0.1, abs=1e-5)
    rightward = camera.world_from_camera[0, :3, 0]
    assert float(across @ rightward) == pytest.approx(0.1, abs=1e-5), "the right eye is on the right"
    ahead = camera.world_from_camera[0, :3, 2]
    points = torch.stack([torch.zeros(3), 0.3 * rightward, -0.5 * ahead, 0.5 * ahead])
    (l_uv, r_uv) = (project(points, eye)[0][0] for eye in (left, right))
    apart = (l_uv - r_uv)[:, 0]
    assert torch.allclose(apart[:2], torch.zeros(2), atol=1e-3) and torch.allclose(
        l_uv[:, 1], r_uv[:, 1], atol=1e-3
    )
    assert apart[2] > 0.5 and apart[3] < -0.3, "nearer points have crossed disparity"
    behind = stereo_pair(camera, 0.1, 5 * camera.centers[0])
    assert all(torch.equal(eye.K, camera.K) for eye in behind)
