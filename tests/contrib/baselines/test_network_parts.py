"""The published networks' own operations against slow, obvious twins."""

import pytest
import torch
from reference.baselines_twin import (
    added_up_twin,
    bilinear_twin,
    deformable_twin,
    focal_attention_twin,
    patches_twin,
    window_keys_twin,
)
from torch.autograd import gradcheck

from viewmend.contrib.baselines.e2fgvi import FocalAttention, pooled_places, window_places
from viewmend.contrib.baselines.e2fgvi_propagation import SPyNet, deform_conv2d, warp
from viewmend.contrib.baselines.layers import FusionFeedForward, SoftComposition, SoftSplit


def test_deformable_convolution_reads_where_it_is_told(rng):
    x = torch.randn(2, 4, 5, 6, generator=rng)
    offsets, masks = 1.5 * torch.randn(2, 36, 5, 6, generator=rng), torch.rand(2, 18, 5, 6, generator=rng)
    weight, bias = torch.randn(3, 4, 3, 3, generator=rng), torch.randn(3, generator=rng)
    out = deform_conv2d(x, offsets, masks, weight, bias)
    for number in range(2):
        twin = deformable_twin(x[number], offsets[number], masks[number], weight, bias)
        assert torch.allclose(out[number], twin, atol=2e-5)


def test_deformable_convolution_learns_its_offsets(rng):
    x, weight = torch.randn(1, 2, 4, 5, generator=rng), torch.randn(2, 2, 3, 3, generator=rng)
    # Away from whole pixels, where bilinear reading has kinks.
    offsets = (torch.rand(1, 18, 4, 5, generator=rng) * 0.8 + 0.1).requires_grad_()
    masks = torch.rand(1, 9, 4, 5, generator=rng).requires_grad_()
    with pytest.warns(UserWarning, match="double precision"):
        assert gradcheck(
            lambda o, m: deform_conv2d(x, o, m, weight, None), (offsets, masks), eps=1e-2, atol=1e-2
        )


@pytest.mark.parametrize("size", [(9, 12), (10, 13)])
def test_soft_split_takes_overlapping_patches_of_any_size(size, rng):
    split = SoftSplit()
    features = torch.randn(1, 128, *size, generator=rng)
    tokens = split(features)
    assert tokens.shape[1:3] == (-(-size[0] // 3), -(-size[1] // 3))
    assert torch.allclose(tokens[0], split.embedding(patches_twin(features[0])), atol=1e-5)


def test_soft_composition_adds_patches_up(rng):
    size, tokens = (9, 12), torch.randn(1, 3, 4, 512, generator=rng)
    plain, biased = SoftComposition(), SoftComposition(bias_size=size)
    biased.embedding = plain.embedding
    assert biased.bias is not None
    with torch.no_grad():
        biased.bias += torch.randn(biased.bias.shape, generator=rng)
    total, _ = added_up_twin(plain.embedding(tokens[0]), size)
    assert torch.allclose(plain(tokens, size)[0], total, atol=1e-4)
    assert torch.allclose(biased(tokens, size)[0], total + biased.bias, atol=1e-4)


def test_fusion_feed_forward_averages_hidden_patches_where_they_overlap(rng):
    size, tokens = (10, 12), torch.randn(1, 4, 4, 512, generator=rng)
    ffn = FusionFeedForward(torch.nn.GELU())
    total, count = added_up_twin(ffn.conv1(tokens[0]), size)
    expected = ffn.conv2(patches_twin(total / count))
    assert torch.allclose(ffn(tokens, size)[0], expected, atol=1e-5)
    assert int(count.min()) >= 1 and int(count.max()) == 9


@pytest.mark.parametrize("grid", [(4, 4), (2, 3)])
def test_windows_see_themselves_and_half_a_window_around(grid):
    own, rolled = window_places(grid)
    keys = torch.cat([own, rolled[:, FocalAttention(8, 2).valid_ind_rolled]], 1)
    assert keys.shape == (grid[0] * grid[1], 165)
    for number, window in enumerate(keys):
        expected = window_keys_twin(grid, number // grid[1], number % grid[1])
        columns = 9 * grid[1]
        assert sorted(window.tolist()) == sorted(y * columns + x for y, x in expected)


def test_windows_see_pooled_windows_five_by_nine_around():
    cells, near = pooled_places((7, 12))
    seen = {(int(c) // 12, int(c) % 12) for c in cells[3 * 12 + 1][near[3 * 12 + 1]]}
    assert seen == {(y, x) for y in range(1, 6) for x in range(0, 6)}
    assert int(near.sum(1).max()) == 45


def test_focal_attention_is_attention_to_those_places(rng):
    torch.manual_seed(0)
    attention = FocalAttention(8, 2)
    fine = torch.randn(1, 3, 10, 18, 8, generator=rng)
    pooled = torch.randn(1, 3, 2, 2, 8, generator=rng)
    with torch.no_grad():
        out = attention(fine, pooled)
        frames = [(fine[0, t], pooled[0, t]) for t in range(3)]
        assert torch.allclose(out[0, 0], focal_attention_twin(attention, frames), atol=1e-5)
        # Frames have no order: each sees the same three.
        frames = [frames[1], frames[0], frames[2]]
        assert torch.allclose(out[0, 1], focal_attention_twin(attention, frames), atol=1e-5)


@pytest.mark.parametrize("padding", ["zeros", "border"])
def test_warp_reads_where_the_flow_leads(padding, rng):
    image, flow = torch.randn(1, 2, 5, 7, generator=rng), 2 * torch.randn(1, 2, 5, 7, generator=rng)
    out = warp(image, flow, padding)
    for row in range(5):
        for col in range(7):
            x, y = col + float(flow[0, 0, row, col]), row + float(flow[0, 1, row, col])
            if padding == "border":
                x, y = min(max(x, 0), 6), min(max(y, 0), 4)
            assert torch.allclose(out[0, :, row, col], bilinear_twin(image[0], y, x), atol=1e-5)


def test_flow_of_untrained_weights_has_the_images_size_and_scale():
    flow = SPyNet()
    with torch.no_grad():
        for parameter in flow.parameters():
            parameter.zero_()
        # Of the last level alone: a constant (32, 64) at 64 x 128, where the network works, is (27, 60) at 54 x 120.
        last = flow.basic_module[-1].basic_module[-1]["conv"]
        last.bias.copy_(torch.tensor([64.0, 32.0]))
        out = flow(torch.rand(1, 3, 54, 120), torch.rand(1, 3, 54, 120))
    assert out.shape == (1, 2, 54, 120)
    assert torch.allclose(out.mean((0, 2, 3)), torch.tensor([60.0, 27.0]), atol=1e-3)
