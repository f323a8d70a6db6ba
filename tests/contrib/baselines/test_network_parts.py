"""The published networks' own operations against slow, obvious twins."""

import pytest
import torch
from reference.baselines_twin import (
    deformable_twin,
    focal_attention_twin,
)

from viewmend.contrib.baselines.e2fgvi import FocalAttention, FocalTokens
from viewmend.contrib.baselines.e2fgvi_propagation import deform_conv2d


def test_deformable_convolution_reads_where_it_is_told(rng):
    x = torch.randn(2, 4, 5, 6, generator=rng)
    offsets, masks = 1.5 * torch.randn(2, 36, 5, 6, generator=rng), torch.rand(2, 18, 5, 6, generator=rng)
    weight, bias = torch.randn(3, 4, 3, 3, generator=rng), torch.randn(3, generator=rng)
    out = deform_conv2d(x, offsets, masks, weight, bias)
    for number in range(2):
        twin = deformable_twin(x[number], offsets[number], masks[number], weight, bias)
        assert torch.allclose(out[number], twin, atol=2e-5)


def test_deformable_convolution_learns_its_offsets(rng):
    x = torch.randn(1, 2, 4, 5, generator=rng, dtype=torch.float64)
    # Away from whole pixels, where bilinear reading has kinks.
    offsets = (torch.rand(1, 18, 4, 5, generator=rng) * 0.8 + 0.1).double().requires_grad_()
    masks = torch.rand(1, 9, 4, 5, generator=rng).double().requires_grad_()
    weight = torch.randn(2, 2, 3, 3, generator=rng)
    deform_conv2d(x.float(), offsets.float(), masks.float(), weight, None).square().sum().backward()
    step = torch.zeros_like(offsets)
    step[0, 7, 2, 3] = 1e-2
    with torch.no_grad():
        ahead, back = (
            deform_conv2d(x.float(), (offsets + s).float(), masks.float(), weight, None).double().square().sum()
            for s in (step, -step)
        )
    assert offsets.grad is not None and masks.grad is not None and bool(masks.grad.any())
    assert float(offsets.grad[0, 7, 2, 3]) == pytest.approx(float((ahead - back) / 2e-2), rel=2e-2, abs=1e-2)


def test_focal_attention_equals_its_twin(rng):
    torch.manual_seed(0)
    attention = FocalAttention(8, 2)
    fine = torch.randn(1, 3, 10, 18, 8, generator=rng)
    pooled = torch.randn(1, 3, 2, 2, 8, generator=rng)
    with torch.no_grad():
        out = attention(FocalTokens(fine, pooled))
        frames = [(fine[0, t], pooled[0, t]) for t in range(3)]
        assert torch.allclose(out[0, 0], focal_attention_twin(attention, frames), atol=1e-5)
        # Frames have no order: each sees the same three.
        frames = [frames[1], frames[0], frames[2]]
        assert torch.allclose(out[0, 1], focal_attention_twin(attention, frames), atol=1e-5)
