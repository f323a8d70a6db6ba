import math

import pytest
import torch
from reference.ball import camera_at, ring

from viewmend.geometry.cameras import concatenate_cameras, project
from viewmend.live.poses import cameras_json, rig_frame, view_camera
from viewmend.live.protocol import Camera
from viewmend.studio.rigs import orbit

CENTER = torch.tensor([0.1, 0.2, 0.3])
FRAME = rig_frame(ring(4), torch.zeros(3), None)


def test_azimuths_are_those_of_orbits():
    frame = rig_frame(ring(4), CENTER, torch.tensor([0.0, 2.0, 0.0]))
    for degrees in (0, 35, 250):
        ours = view_camera(Camera(azimuth=float(degrees), elevation=12.0, distance=2.5), frame, (64, 64))
        theirs = orbit([math.radians(degrees)], (64, 64), radius_m=2.5, elevation_rad=math.radians(12), center=CENTER)
        assert torch.allclose(ours.camera_from_world, theirs.camera_from_world, atol=1e-5)


def test_the_first_view_is_between_two_cameras_as_far_as_they_are():
    assert FRAME.azimuth == pytest.approx(45) and FRAME.elevation == pytest.approx(0, abs=1e-4)
    assert FRAME.distance_m == pytest.approx(2) and FRAME.fov_y == pytest.approx(math.degrees(0.7), abs=1e-3)
    assert torch.allclose(FRAME.up, torch.tensor([0.0, 1.0, 0.0]), atol=1e-5)
    lone = rig_frame(ring(4)[0], torch.zeros(3), None)
    assert lone.azimuth == pytest.approx(0)


@pytest.mark.parametrize("degrees", [(60, 20, 100, 40), (340, 10, 50, 140), (200, 230)])
def test_the_first_view_is_in_the_middle_of_an_arc(degrees):
    arc = orbit([math.radians(d) for d in degrees], (64, 64), radius_m=2.0, elevation_rad=0.0, center=CENTER)
    middle = {(60, 20, 100, 40): 60, (340, 10, 50, 140): 60, (200, 230): -145}[degrees]
    assert rig_frame(arc, CENTER, torch.tensor([0.0, 1.0, 0.0])).azimuth == pytest.approx(middle, abs=0.02)


def test_a_matrix_says_it_all():
    like = camera_at(77, "x")
    R, T = like.camera_from_world[0, :3, :3], like.camera_from_world[0, :3, 3]
    asked = Camera(R=tuple(R.flatten().tolist()), T=tuple(T.tolist()), fx=50.0, fy=60.0, cy=7.0)
    camera = view_camera(asked, FRAME, (40, 30))
    assert torch.allclose(camera.camera_from_world, like.camera_from_world)
    assert camera.K[0].tolist() == [[50, 0, 20], [0, 60, 7], [0, 0, 1]]


@pytest.mark.parametrize("scale", [0.5, 0.3])
def test_a_smaller_picture_shows_the_same(scale):
    point = torch.tensor([[0.2, 0.1, -0.1]])
    full, small = (view_camera(Camera(azimuth=20.0), FRAME, (200, 120), s) for s in (1.0, scale))
    (a, _), (b, _) = (project(point, c) for c in (full, small))
    assert torch.allclose(a / full.size_px, b / small.size_px, atol=1e-4)
    assert small.size_px[0].tolist() == [200 * scale, 120 * scale]
    assert view_camera(Camera(), FRAME, (20, 20), 0.1).size_px.tolist() == [[16, 16]]


def test_a_tall_picture_shows_the_subject_as_wide():
    wide, tall = (view_camera(Camera(), FRAME, size) for size in ((80, 80), (80, 160)))
    assert float(wide.K[0, 0, 0]) == pytest.approx(float(tall.K[0, 0, 0]), rel=1e-5)


def test_what_is_asked_for_is_given_in_tall_pictures_too():
    asked = view_camera(Camera(fov_y=40.0), FRAME, (100, 200))
    assert float(asked.K[0, 1, 1]) == pytest.approx(100 / math.tan(math.radians(20)), rel=1e-5)


@pytest.mark.parametrize(("height_m", "elevation"), [(30.0, 80.0), (-30.0, -80.0), (2.0, 45.0)])
def test_nobody_begins_right_above_the_subject(height_m, elevation):
    overhead = concatenate_cameras([camera_at(90 * n, f"c{n}", 48, height_m) for n in range(4)])
    assert rig_frame(overhead, torch.zeros(3), torch.tensor([0.0, 1, 0])).elevation == pytest.approx(elevation)


def test_cameras_are_said_in_flat_lists():
    (said,) = cameras_json(camera_at(0, "c"))
    assert said["width"] == 48 and len(said["K"]) == 9 and len(said["R"]) == 9
    assert said["center"] == pytest.approx([0, 0, 2], abs=1e-5) and said["T"] == pytest.approx([0, 0, 2], abs=1e-5)
