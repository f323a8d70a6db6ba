"""Selection of source cameras."""

import torch
from reference.ball import camera_at, ring

from viewmend.geometry.cameras import concatenate_cameras
from viewmend.rendering.view import angles_to, select_closest

CENTER = torch.zeros(3)


def test_angles_are_measured_at_the_subject():
    # Distance does not count: the second camera is much nearer.
    cameras = concatenate_cameras([camera_at(30, "a"), camera_at(100, "b", distance_m=0.8), camera_at(10.001, "c")])
    degrees = torch.rad2deg(angles_to(camera_at(10, "t"), cameras, CENTER))
    torch.testing.assert_close(degrees, torch.tensor([20.0, 90.0, 0.001]), atol=2e-4, rtol=0)


def test_cameras_are_sorted_by_angle():
    assert select_closest(camera_at(100, "t"), ring(12), CENTER) == ("c3", "c4", "c2")
    assert select_closest(camera_at(0, "t"), ring(2), CENTER, k=3) == ("c0", "c1")
