"""The CPU's fast path of `interpolate` against the path for any device, which gradients take."""

import torch
from reference.ball import proxy, ring

from viewmend.geometry.rasterize import interpolate, rasterize


def test_the_fast_path_equals_the_other():
    ball, cameras = proxy(16), ring(3, 40).cropped(-4, 6, 50, 40)
    raster = rasterize(ball.mesh, cameras)
    attributes = torch.randn(len(ball.mesh.vertices), 5, generator=torch.Generator().manual_seed(0))
    fast = interpolate(attributes, ball.mesh, cameras, raster)
    slow = interpolate(attributes.clone().requires_grad_(), ball.mesh, cameras, raster)
    assert slow.requires_grad and (raster.triangle >= 0).float().mean() > 0.2
    torch.testing.assert_close(fast, slow.detach(), atol=1e-4, rtol=1e-4)


def test_gradients_reach_the_attributes():
    ball, cameras = proxy(8), ring(1, 20)
    attributes = torch.ones(len(ball.mesh.vertices), 1, requires_grad=True)
    raster = rasterize(ball.mesh, cameras)
    interpolate(attributes, ball.mesh, cameras, raster).sum().backward()
    assert attributes.grad is not None
    torch.testing.assert_close(attributes.grad.sum(), (raster.triangle >= 0).sum().float())
