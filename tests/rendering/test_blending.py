"""The blending rule, against its slow reference and case by case."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference.ball import camera_at, photograph, proxy, ring
from reference.blend_twin import blend_twin

from viewmend.geometry.cameras import unproject
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.rendering.blending import BlendConfig, blend, blend_torch
from viewmend.types import ContextViews

BIAS_M = 0.01


def scene(target, cameras):
    """The arguments of `blend` for the ball: target, depth, normals, sources."""
    ball, frame = proxy(), photograph(cameras)
    raster = rasterize(ball.mesh, target)
    normals = interpolate(ball.normals, ball.mesh, target, raster)[0]
    return target, raster.depth[0], normals, ContextViews(frame, ball.depth(cameras))


@pytest.fixture(scope="module")
def hard():
    """Soft masks, noisy depths (edges everywhere), cameras of different sizes, one inside the subject."""
    generator = torch.Generator().manual_seed(1)
    cameras = ring(5, 32)
    inside = camera_at(150, "inside", 32, distance_m=0.3)
    cameras = replace(
        cameras,
        names=(*cameras.names[:4], "inside"),
        camera_from_world=torch.cat([cameras.camera_from_world[:4], inside.camera_from_world]),
        size_px=torch.tensor([[32, 32], [20, 30], [32, 25], [32, 32], [32, 32]]),
    )
    target, depth, normals, sources = scene(camera_at(25, "t", 24, 0.3), cameras)
    shape = sources.frame.rgb.shape
    rgb, mask = (
        torch.randint(0, 256, size, generator=generator, dtype=torch.uint8)
        for size in (shape, (shape[0], *shape[2:]))
    )
    frame = replace(sources.frame, rgb=rgb, mask=mask)
    noise = 1 + 0.02 * torch.randn(sources.depth.shape, generator=generator)
    holes = torch.rand(sources.depth.shape, generator=generator) > 0.1
    return target, depth, normals, ContextViews(frame, sources.depth * noise * holes)


@pytest.mark.parametrize("fast", [blend_torch, blend])
@pytest.mark.parametrize(
    ("config", "masked"),
    [
        (BlendConfig(), True),
        (BlendConfig(), False),
        (BlendConfig(normal_power=1, view_power=4, slope_px=3.0), True),
    ],
)
def test_both_implementations_equal_the_reference(hard, fast, config, masked):
    *given, sources = hard
    if not masked:
        sources = ContextViews(replace(sources.frame, mask=None), sources.depth)
    expected = blend_twin(*given, sources, BIAS_M, config)
    result = fast(*given, sources, BIAS_M, config)
    for got, want in zip((result.rgb, result.weights, result.disagreement), expected, strict=True):
        # A depth test that float32 decides the other way is a flip: rare, and all else is tight.
        assert (np.abs(got.numpy() - want) > 2e-4).mean() < 0.002
    assert (expected[1].sum(0) > 0).sum() > 100


@pytest.mark.gpu
def test_cuda_equals_cpu(hard):
    target, depth, normals, sources = hard
    expected = blend(*hard, BIAS_M, BlendConfig())
    on_gpu = ContextViews(sources.frame.to("cuda"), sources.depth.cuda())
    got = blend(target.to("cuda"), depth.cuda(), normals.cuda(), on_gpu, BIAS_M, BlendConfig())
    assert ((got.rgb.cpu() - expected.rgb).abs() > 2e-4).float().mean() < 0.002


def test_a_camera_at_the_target_gives_its_own_image_back():
    target = camera_at(0, "t")
    given = scene(target, replace(target, names=("same",)))
    result = blend(*given, BIAS_M, BlendConfig())
    seen = result.weights[0] > 1e-5
    assert seen.sum() > 500
    torch.testing.assert_close(result.rgb[:, seen], given[3].frame.rgb[0][:, seen] / 255, atol=1e-3, rtol=0)


def test_an_occluder_takes_the_weight():
    target, depth, normals, sources = scene(camera_at(0, "t"), camera_at(20, "c"))
    seen, barely, hidden = (
        blend(target, depth, normals, ContextViews(sources.frame, there), BIAS_M, BlendConfig())
        .weights[0]
        .sum()
        for there in (sources.depth - nearer_m * (sources.depth > 0) for nearer_m in (0.0, 0.5 * BIAS_M, 0.3))
    )
    assert barely > 0.99 * seen > 1 and hidden == 0


def test_background_does_not_bleed_in():
    """White images on black: coloured pixels are white up to the rim."""
    target, depth, normals, sources = scene(camera_at(0, "t"), ring(12)[[0, 1]])
    white = (sources.frame.mask[:, None] > 0).expand(-1, 3, -1, -1) * torch.tensor(255, dtype=torch.uint8)
    sources = ContextViews(replace(sources.frame, rgb=white.contiguous()), sources.depth)
    result = blend(target, depth, normals, sources, BIAS_M, BlendConfig())
    seen = result.weights.sum(0) > 0
    assert seen.sum() > 500
    assert result.rgb[:, seen].min() > 0.999


@pytest.mark.parametrize("fast", [blend_torch, blend])
def test_a_surface_that_faces_a_camera_counts_in_every_pixel(fast):
    """Where the cosine is 1, rounding may exceed it, and the slope would be NaN."""
    target, depth, _, sources = scene(camera_at(0, "t"), camera_at(0, "c"))
    row, column = (depth > 0).nonzero(as_tuple=True)
    points = unproject((torch.stack([column, row], -1) + 0.5)[None], depth[row, column][None], target)[0]
    normals = torch.zeros(*depth.shape, 3)
    normals[row, column] = torch.nn.functional.normalize(target.centers[0] - points, dim=-1)
    frame = replace(sources.frame, mask=torch.full_like(sources.frame.mask, 255))
    weights = fast(target, depth, normals, ContextViews(frame, sources.depth), BIAS_M, BlendConfig()).weights[
        0
    ]
    inner = depth[row, column] < depth[depth > 0].quantile(0.5)
    assert len(row) > 500 and float(weights[row, column][inner].min()) > 0.99
