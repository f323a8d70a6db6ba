"""The depth of the rim around the proxy, against its definition."""

import pytest
import torch

from viewmend.geometry.rim import rim_depth


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (17, 12)])
def test_the_rim_has_the_smallest_depth_within_two_pixels(shape, dtype):
    rng = torch.Generator().manual_seed(sum(shape))
    depth = torch.where(torch.rand(shape, generator=rng) < 0.1, 1 + torch.rand(shape, generator=rng), 0.0).to(
        dtype
    )
    found = rim_depth(depth)
    for row in range(shape[0]):
        for column in range(shape[1]):
            near = depth[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
            least = min((z for z in near.flatten().tolist() if z > 0), default=0.0)
            assert found[row, column] == (depth[row, column] if depth[row, column] > 0 else least)
