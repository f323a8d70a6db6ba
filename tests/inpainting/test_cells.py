"""Images in cells, the rim about the proxy, and views in half their resolution, against slow twins."""

import math

import pytest
import torch

from viewmend.geometry.cameras import project
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.protocol import RenderQuality
from viewmend.inpainting.sweep import error_net
from viewmend.inpainting.sweep.cells import doubled, halved, rim_depth


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (17, 12)])
def test_the_rim_has_the_smallest_depth_within_two_pixels(shape, dtype):
    rng = torch.Generator().manual_seed(sum(shape))
    depth = torch.where(torch.rand(shape, generator=rng) < 0.1, 1 + torch.rand(shape, generator=rng), 0.0).to(dtype)
    found = rim_depth(depth)
    for row in range(shape[0]):
        for column in range(shape[1]):
            near = depth[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3]
            least = min((z for z in near.flatten().tolist() if z > 0), default=0.0)
            assert found[row, column] == (depth[row, column] if depth[row, column] > 0 else least)


def test_half_a_view_shows_the_mean_of_what_is_covered(scene):
    _, view, _ = scene
    small, (height, width) = halved(view), view.mask.shape
    assert small.mask.shape == (math.ceil(height / 2), math.ceil(width / 2)) and small.source_views == view.source_views
    seen = 0
    for row, column in torch.nonzero(small.mask).tolist():
        cell = (slice(2 * row, 2 * row + 2), slice(2 * column, 2 * column + 2))
        covered = view.mask[cell] > 0
        assert torch.allclose(small.rgb[:, row, column], view.rgb[:, *cell][:, covered].mean(1), atol=1e-5)
        assert torch.allclose(small.weights[:, row, column], view.weights[:, *cell][:, covered].mean(1), atol=1e-5)
        assert small.depth[row, column] == view.depth[cell][covered].min()
        seen += 0 < int(covered.sum()) < 4
    assert seen > 20 and int(small.mask.sum()) == sum(
        bool(view.mask[2 * r : 2 * r + 2, 2 * c : 2 * c + 2].any())
        for r in range(small.mask.shape[0])
        for c in range(small.mask.shape[1])
    )
    point = view.camera.centers[0] + 2.0 * view.camera.world_from_camera[0, :3, 2] + torch.tensor([0.1, 0.2, 0.0])
    (one, _), (other, _) = (project(point[None], each.camera) for each in (view, small))
    assert torch.allclose(one / 2, other, atol=1e-4), "the same rays"


def test_what_is_doubled_lies_between_its_values_inside():
    image, inside = torch.tensor([[[1.0, 3.0, 100.0]]]), torch.tensor([[True, True, False]])
    large = doubled(image, inside, (2, 5))
    assert large.shape == (1, 2, 5)
    assert large[0, 0].tolist() == pytest.approx([1.0, 1.5, 2.5, 3.0, 3.0]), "nothing comes in from outside"


@torch.no_grad()
def test_a_large_subject_is_judged_in_half_its_resolution_where_nothing_is_read(scene, monkeypatch):
    _, view, rig = scene
    errors, there = load_network("views").errors, rim_depth(view.depth) > 0
    whole = errors(view, rig)
    assert all(
        torch.equal(*pair)
        for pair in zip(errors.expected(view, rig, RenderQuality(read_fraction=0.0)), whole, strict=True)
    ), "it is small"
    monkeypatch.setattr(error_net, "LARGE_PX", 8)
    assert all(
        torch.equal(*pair)
        for pair in zip(errors.expected(view, rig, RenderQuality(read_fraction=0.1)), whole, strict=True)
    )
    for one, other in zip(errors.expected(view, rig, RenderQuality(read_fraction=0.0)), whole, strict=True):
        assert not torch.equal(one, other) and not bool(one[~there].any()) and float(one[there].min()) > 0
    alphas = torch.stack(
        [found.alpha[there] for found in (errors.expected(view, rig, RenderQuality(read_fraction=0.0)), whole)]
    )
    assert float(alphas.corrcoef()[0, 1]) > 0.85
