import math

import pytest
import torch

from viewmend.data.synthetic.rigs import SUBJECT_CENTER_M, dome_rig, orbit, ring_rig
from viewmend.geometry.cameras import project
from viewmend.geometry.rigid import is_rotation

PERSON = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.8, 0.0]])


@pytest.mark.parametrize("make", [ring_rig, dome_rig])
@pytest.mark.parametrize("count", [1, 4, 60])
def test_rigs_hold_an_upright_person(make, count):
    cameras = make(count, (320, 240), seed=7)
    assert len(cameras) == count == len(set(cameras.names))
    assert bool(is_rotation(cameras.camera_from_world[:, :3, :3]).all())
    uv, z = project(PERSON, cameras)
    assert float(z.min()) > 1
    assert float(uv.min()) > 0 and float(uv[..., 1].max()) < 240 and float(uv[..., 0].max()) < 320
    assert float((uv[:, 0, 1] - uv[:, 1, 1]).min()) > 0, "the feet are below the head"
    assert float(cameras.centers[:, 1].min()) > 0.5


def test_heights_take_turns():
    exact = ring_rig(5, seed=1, jitter=0.0, heights_m=(1.1, 1.8, 0.6))
    torch.testing.assert_close(exact.centers[:, 1], torch.tensor([1.1, 1.8, 0.6, 1.1, 1.8]))


def test_a_person_fills_most_of_the_height():
    uv, _ = project(PERSON, ring_rig(12, (512, 512), seed=1))
    height = (uv[:, 0, 1] - uv[:, 1, 1]) / 512
    assert float(height.min()) > 0.6 and float(height.max()) < 0.85


def test_rigs_are_seeded_and_jitter_can_be_off():
    a, b, c = ring_rig(5, seed=1), ring_rig(5, seed=1), ring_rig(5, seed=2)
    assert torch.equal(a.camera_from_world, b.camera_from_world)
    assert not torch.equal(a.camera_from_world, c.camera_from_world)
    exact = ring_rig(5, seed=1, jitter=0.0, heights_m=(1.2,), radius_m=2.5)
    torch.testing.assert_close(exact.centers[:, [0, 2]].norm(dim=1), torch.full((5,), 2.5))
    torch.testing.assert_close(exact.centers[:, 1], torch.full((5,), 1.2))
    uv, _ = project(torch.tensor([SUBJECT_CENTER_M]), exact)
    torch.testing.assert_close(uv[:, 0], torch.full((5, 2), 256.0), atol=1e-3, rtol=0)


def test_no_cameras_is_an_error():
    with pytest.raises(ValueError, match="at least 1 camera"):
        ring_rig(0)


def test_orbits_start_in_front_and_turn_towards_x():
    cameras = orbit([0.0, math.pi / 2], (32, 32), radius_m=2.0, elevation_rad=0.0)
    torch.testing.assert_close(cameras.centers, torch.tensor([[0.0, 0.95, 2.0], [2.0, 0.95, 0.0]]), atol=1e-5, rtol=0)
