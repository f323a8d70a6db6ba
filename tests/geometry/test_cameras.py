"""Pinhole cameras: projection and changes of the image grid."""

import math
from dataclasses import replace

import pytest
import torch
from geometry.solids import camera_at, dome

from viewmend.geometry.cameras import concatenate_cameras, is_intrinsics, pinhole, pixel_centers, project
from viewmend.geometry.rigid import invert_rigid, is_rotation, look_at, rotation_from_axis_angle


def test_axes_are_opencvs():
    """Seen by a camera that looks along z with y up in the world: world up is image up, v grows downwards."""
    camera = camera_at((0.0, 0.0, -2.0))
    uv, _ = project(torch.tensor([[0.0, 0.1, 0.0], [-0.1, 0.0, 0.0]]), camera)
    assert uv[0, 0, 1] < 40, "what is above the axis is above the middle"
    assert uv[0, 1, 0] > 48, "from the front, world -x is to the right"


def test_skew_moves_points_sideways_by_their_height():
    camera = pinhole(0.8, 40, 30, torch.eye(4))
    skewed = camera.K.clone()
    skewed[0, 0, 1] = 7.0
    points = torch.tensor([[0.1, 0.2, 2.0]])
    straight, slanted = (project(points, one)[0] for one in (camera, replace(camera, K=skewed)))
    torch.testing.assert_close(slanted - straight, torch.tensor([[[7 * 0.1, 0.0]]]))


def test_a_point_behind_has_negative_depth_and_finite_pixels():
    uv, z = project(torch.tensor([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), pinhole(0.8, 40, 30, torch.eye(4)))
    assert (z <= 0).all() and torch.isfinite(uv).all()


def test_resizing_keeps_the_field_of_view():
    views = [camera_at((2, 0, 0), width=40, height=30), camera_at((0, 0, 2), width=60, height=50)]
    cameras = concatenate_cameras(views)
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    before, _ = project(points, cameras)
    after, _ = project(points, cameras.resized(80, 100))
    torch.testing.assert_close(after, before * torch.tensor([[[2.0, 100 / 30]], [[80 / 60, 2.0]]]))
    assert cameras.resized(80, 100).max_size_px == (80, 100)


def test_cropping_moves_the_origin():
    camera = camera_at((2.0, 0.0, 0.0))
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    window = camera.cropped(10, -5, 20, 16)
    torch.testing.assert_close(
        project(points, window)[0], project(points, camera)[0] - torch.tensor([10.0, -5.0])
    )
    assert window.max_size_px == (20, 16)


def test_selection_by_name_and_by_position():
    cameras = dome(4)
    assert cameras.select(["c2", "c0"]).names == ("c2", "c0")
    assert torch.equal(cameras.select(["c2"]).K, cameras[2].K)
    assert cameras[1:3].names == ("c1", "c2") and cameras[-1].names == ("c3",) and len(cameras[[3, 3]]) == 2
    with pytest.raises(ValueError, match="spelling"):
        cameras.select(["c9"])
    with pytest.raises(ValueError, match=r"names as a list of names, got the string 'c2'; write \['c2'\]"):
        cameras.select("c2")


def test_pixel_centers_start_at_a_half():
    assert pixel_centers(3, 2).tolist() == [
        [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5]],
        [[0.5, 1.5], [1.5, 1.5], [2.5, 1.5]],
    ]


# Rigid motions.


UP = torch.tensor([0.0, 1.0, 0.0])


def test_looking_at_a_point():
    camera = look_at(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.0, 0.5, 0.0]), UP)
    target = camera @ torch.tensor([0.0, 0.5, 0.0, 1.0])
    torch.testing.assert_close(target[:2], torch.zeros(2), atol=1e-6, rtol=0)
    assert target[2] > 0
    assert is_rotation(camera[:3, :3])
    assert (camera[:3, :3] @ UP)[1] < 0, "up in the world is against y in the image"
    torch.testing.assert_close(invert_rigid(camera)[:3, 3], torch.tensor([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("fov", [50.0, 0.0, -0.8, math.pi, math.nan])
def test_a_field_of_view_is_in_radians(fov):
    with pytest.raises(ValueError, match=f"between 0 and pi radians, got {fov}; convert degrees to radians"):
        pinhole(fov, 40, 30, torch.eye(4))


@pytest.mark.parametrize(("eye", "up"), [((0.0, 0.0, 0.0), UP), ((0.0, 3.0, 0.0), UP)])
def test_looking_nowhere_is_an_error(eye, up):
    with pytest.raises(ValueError, match="choose another up"):
        look_at(torch.tensor(eye), torch.zeros(3), up)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 1.0, 3.0, math.pi])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.6, -0.8, 0.0), (-0.48, 0.6, 0.64)])
def test_an_axis_angle_keeps_its_axis_and_turns_by_its_angle(axis, angle):
    axis = torch.tensor(axis, dtype=torch.float64)
    rotation = rotation_from_axis_angle(axis * angle)
    assert is_rotation(rotation)
    torch.testing.assert_close(rotation @ axis, axis)
    assert float(rotation.trace()) == pytest.approx(1 + 2 * math.cos(angle))


def test_a_quarter_turn_about_z_takes_x_to_y():
    rotation = rotation_from_axis_angle(torch.tensor([0.0, 0.0, math.pi / 2]))
    torch.testing.assert_close(
        rotation @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]), atol=1e-6, rtol=0
    )


def test_rotations_are_told_from_other_matrices():
    assert is_rotation(rotation_from_axis_angle(torch.tensor([0.3, 0.2, -1.0])))
    assert not is_rotation(torch.diag(torch.tensor([1.0, 1.0, -1.0]))), "a reflection"
    assert not is_rotation(torch.eye(3) * 1.01)
    assert is_rotation(torch.stack([torch.eye(3), torch.zeros(3, 3)])).tolist() == [True, False]
    assert not is_rotation(torch.full((3, 3), torch.nan))


def test_intrinsics_may_be_rounded():
    K = torch.tensor([[500.0, 0.1, 320.0], [1e-5, 500.0, 240.0], [0.0, 1e-8, 1.0]])
    assert is_intrinsics(K.tolist())
    assert not any(is_intrinsics(wrong.tolist()) for wrong in (K.mT, -K, K / 2, K * torch.inf, K * torch.nan))
