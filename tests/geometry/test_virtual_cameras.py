"""Views all around the subject."""

import math

import pytest
import torch
from reference.ball import camera_at, ring

from viewmend.geometry.cameras import concatenate_cameras, project
from viewmend.geometry.virtual_cameras import surround

CENTER = torch.zeros(3)


def angles(cameras):
    """The angle at the centre between each camera and its closest neighbour, degrees."""
    direction = torch.nn.functional.normalize(cameras.centers, dim=1)
    cosine = (direction @ direction.T).fill_diagonal_(-1)
    return torch.rad2deg(torch.acos(cosine.amax(1).clamp(-1, 1)))


def test_all_cameras_come_first_and_gaps_are_halved():
    views = surround(ring(8), CENTER, 16, math.radians(5))
    assert set(views.names[:8]) == {f"c{n}" for n in range(8)}
    assert len(views) == 16
    assert len(set(views.names)) == 16
    assert angles(views).tolist() == pytest.approx([22.5] * 16, abs=0.1)


@pytest.mark.parametrize("left", [0.0, 300.0])
def test_virtual_cameras_look_at_the_centre_from_the_distance_of_their_neighbours(left):
    """Also if the images of the rig are cut, so that the principal point is outside of them."""
    views = surround(ring(6).moved(-left, 0.0), CENTER, 12, math.radians(5))
    uv, z = project(CENTER[None], views)
    assert z[:, 0].tolist() == pytest.approx([2.0] * 12, abs=1e-4)
    assert (uv[6:, 0] - views.size_px[6:] / 2).abs().max() < 1e-3
    # the image's up is the world's
    assert (views.camera_from_world[:, 1, 1] < -0.9).all()


def test_no_two_views_are_closer_than_the_smallest_angle():
    views = surround(ring(8), CENTER, 100, math.radians(20))
    assert len(views) == 16
    assert len(surround(ring(8), CENTER, 100, math.radians(30))) == 8


def test_of_many_cameras_the_ones_that_are_farthest_apart_are_taken():
    views = surround(ring(48), CENTER, 12, math.radians(5))
    assert len(views) == 12
    assert all(name.startswith("c") for name in views.names)
    assert angles(views).min() >= 22


def test_opposite_cameras_have_none_between_them():
    pair = concatenate_cameras([camera_at(0, "front"), camera_at(180, "back")])
    assert surround(pair, CENTER, 8, math.radians(5)).names == ("front", "back")


def test_a_camera_above_the_subject_gives_upright_views():
    cameras = concatenate_cameras([ring(4), camera_at(3, "top", height_m=40.0, distance_m=0.5)])
    views = surround(cameras, CENTER, 12, math.radians(5))
    assert len(views) > 5
    assert torch.isfinite(views.camera_from_world).all()
