"""Rigid motions."""

import math

import pytest
import torch

from viewmend.geometry.rigid import invert_rigid, is_rotation, look_at, rotation_from_axis_angle

UP = torch.tensor([0.0, 1.0, 0.0])


def test_looking_at_a_point():
    camera = look_at(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.0, 0.5, 0.0]), UP)
    target = camera @ torch.tensor([0.0, 0.5, 0.0, 1.0])
    torch.testing.assert_close(target[:2], torch.zeros(2), atol=1e-6, rtol=0)
    assert target[2] > 0
    assert is_rotation(camera[:3, :3])
    assert (camera[:3, :3] @ UP)[1] < 0, "up in the world is against y in the image"
    torch.testing.assert_close(invert_rigid(camera)[:3, 3], torch.tensor([1.0, 2.0, 3.0]))


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
    torch.testing.assert_close(rotation @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]), atol=1e-6, rtol=0)


def test_rotations_are_told_from_other_matrices():
    assert is_rotation(rotation_from_axis_angle(torch.tensor([0.3, 0.2, -1.0])))
    assert not is_rotation(torch.diag(torch.tensor([1.0, 1.0, -1.0]))), "a reflection"
    assert not is_rotation(torch.eye(3) * 1.01)
    assert is_rotation(torch.stack([torch.eye(3), torch.zeros(3, 3)])).tolist() == [True, False]
    assert not is_rotation(torch.full((3, 3), torch.nan))
