"""Carrying points between cameras: the slow twin, and what carrying must keep."""

import torch
from geometry.solids import camera_at, dome
from reference.carry_twin import carry_twin

from viewmend.geometry.reprojection import carry


def some_points():
    rng = torch.Generator().manual_seed(1)
    uv = torch.rand(3, 7, 2, generator=rng) * torch.tensor([96.0, 80.0])
    return uv, torch.rand(3, 7, generator=rng) * 4 + 0.5


def test_equals_the_twin():
    uv, z = some_points()
    target = camera_at((0.5, 1.0, 1.5), target=(0.2, 0.0, 0.0))
    carried, depth = carry(uv, z, dome(3), target)
    twin_uv, twin_z = carry_twin(uv, z, dome(3), target)
    assert (depth <= 0).any(), "a point lands behind the target"
    assert (depth > 0).any()
    torch.testing.assert_close(depth.double(), torch.from_numpy(twin_z), atol=1e-5, rtol=0)
    near = depth.abs() > 0.1
    torch.testing.assert_close(carried.double()[near], torch.from_numpy(twin_uv)[near], atol=1e-2, rtol=1e-5)


def test_carrying_into_the_same_camera_changes_nothing():
    uv, z = some_points()
    for view in range(3):
        same = carry(uv[view : view + 1], z[view : view + 1], dome(3)[view], dome(3)[view])
        torch.testing.assert_close(same[0][0], uv[view], atol=1e-3, rtol=0)
        torch.testing.assert_close(same[1][0], z[view], atol=1e-5, rtol=0)


def test_gradients_reach_the_depth():
    uv, z = some_points()
    z.requires_grad_()
    carried, _ = carry(uv, z, dome(3), camera_at((0.5, 1.0, 1.5)))
    carried.sum().backward()
    assert z.grad is not None and torch.isfinite(z.grad).all() and z.grad.abs().max() > 0
