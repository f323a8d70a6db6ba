"""RAFT: the published layers, and its parts against loops; what it learned is in a file that is not here."""

import pytest
import torch

from viewmend.contrib.baselines.rgvi import (
    CELL_PX,
    LEVELS,
    RADIUS,
    Raft,
    correlations,
    index_pyramid,
    load_raft,
    upsampled,
)
from viewmend.utils.weight_files import MissingWeightsError


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return Raft().eval()


def test_it_has_the_published_layers(network):
    assert sum(p.numel() for p in network.parameters()) == 5_257_536
    keys = network.state_dict()
    for key, shape in {
        "feature_encoder.convnormrelu.0.weight": (64, 3, 7, 7),
        "feature_encoder.layer2.0.downsample.0.weight": (96, 64, 1, 1),
        "context_encoder.layer3.1.convnormrelu2.1.running_var": (128,),
        "update_block.motion_encoder.convcorr1.0.weight": (256, 324, 1, 1),
        "update_block.motion_encoder.conv.0.weight": (126, 256, 3, 3),
        "update_block.recurrent_block.convgru2.convq.weight": (128, 384, 5, 1),
        "update_block.flow_head.conv2.bias": (2,),
        "mask_predictor.convrelu.0.weight": (256, 128, 3, 3),
        "mask_predictor.conv.weight": (576, 256, 1, 1),
    }.items():
        assert tuple(keys[key].shape) == shape
    assert "feature_encoder.convnormrelu.1.weight" not in keys  # instance normalisation learns nothing


def test_correlations_are_looked_up_around_the_place(rng):
    first, second = torch.randn(2, 1, 6, 16, 24, generator=rng)
    pyramid = correlations(first, second)
    at = torch.rand(1, 2, 16, 24, generator=rng) * 8 + 6
    found = index_pyramid(pyramid, at.round() + 0.5)
    assert len(pyramid) == LEVELS and found.shape == (1, LEVELS * (2 * RADIUS + 1) ** 2, 16, 24)
    for row, column in ((0, 0), (5, 7), (15, 23)):
        x, y = at.round()[0, :, row, column].int().tolist()
        for i in range(2 * RADIUS + 1):
            for j in range(2 * RADIUS + 1):
                there_x, there_y = x + i - RADIUS, y + j - RADIUS
                expected = 0.0
                if 0 <= there_x < 24 and 0 <= there_y < 16:
                    expected = float(first[0, :, row, column] @ second[0, :, there_y, there_x]) / 6**0.5
                got = float(found[0, i * (2 * RADIUS + 1) + j, row, column])
                assert got == pytest.approx(expected, abs=1e-4)


def test_upsampling_is_convex(rng):
    flow, mask = torch.randn(1, 2, 5, 6, generator=rng), torch.randn(1, 9 * CELL_PX**2, 5, 6, generator=rng)
    found = upsampled(flow, mask)
    weights = mask.view(9, CELL_PX, CELL_PX, 5, 6).softmax(0)
    for y, x in ((8, 8), (20, 33), (31, 39)):
        row, column = y // CELL_PX, x // CELL_PX
        expected = torch.zeros(2)
        for n in range(9):
            i, j = row + n // 3 - 1, column + n % 3 - 1
            if 0 <= i < 5 and 0 <= j < 6:
                expected += CELL_PX * weights[n, y % CELL_PX, x % CELL_PX, row, column] * flow[0, :, i, j]
        torch.testing.assert_close(found[0, :, y, x], expected, rtol=1e-4, atol=1e-5)


def test_any_size_gives_flow_of_that_size(network, rng):
    for height, width in ((100, 130), (131, 200)):
        image, other = torch.rand(2, 3, height, width, generator=rng)
        flow = network(image, other)
        assert flow.shape == (2, height, width) and flow.isfinite().all() and flow.any()


def test_there_is_none_without_weights(tmp_path, monkeypatch):
    for name in ("VIEWMEND_WEIGHTS", "XDG_CACHE_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    with pytest.raises(MissingWeightsError, match="raft_large"):
        load_raft()
