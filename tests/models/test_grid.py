"""Images on the grid of cells, and convolutions over parts of them, against obvious references."""

import math

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from viewmend.geometry.cameras import project
from viewmend.models.views.grid import (
    BAND_PX,
    CELL_PX,
    TILE_PX,
    TILES_AT_ONCE,
    UNet,
    band_sides_px,
    detail_bands,
    downsample2x,
    index_image,
    run_tiled,
    scatter_to_image,
    upsample2x,
)
from viewmend.models.views.prediction import DepthDistribution

SHAPES = [(70, 53), (64, 96), (33, 161), (17, 9)]


@pytest.mark.parametrize("grad", [False, True])
def test_detail_is_what_pixels_have_around_weighted_local_means(grad, rng):
    shape, (finest, coarser) = torch.Size((9, 14)), (side // 2 for side in BAND_PX)
    pixels = torch.nonzero(torch.rand(shape, generator=rng) < 0.6)
    colours, weight = (
        torch.rand(len(pixels), 2, 3, generator=rng),
        0.01 + torch.rand(len(pixels), generator=rng),
    )
    with torch.set_grad_enabled(grad):  # both implementations
        bands = detail_bands(colours, weight, pixels, shape)
    for n, (row, column) in enumerate(pixels.tolist()):
        means = []
        for radius in (finest, coarser):
            near = ((pixels - pixels[n]).abs() <= radius).all(1)
            means.append((weight[near, None, None] * colours[near]).sum(0) / weight[near].sum())
        expected = torch.stack([colours[n] - means[0], means[0] - means[1]])
        assert torch.allclose(bands[n], expected, atol=1e-5), (row, column)


def test_magnified_images_have_the_magnified_detail(rng):
    """Nine pixels for one of the cameras: at their centres, the detail is that of the camera's own pixels."""
    colours = torch.rand(8 * 11, 1, 3, generator=rng)
    weight = 0.01 + torch.rand(8 * 11, generator=rng)
    small = torch.Size((8, 11))
    bands = detail_bands(colours, weight, torch.nonzero(torch.ones(small)), small)
    large = torch.Size((24, 33))
    pixels = torch.nonzero(torch.ones(large))
    source = (pixels[:, 0] // 3) * 11 + pixels[:, 1] // 3
    magnified = detail_bands(colours[source], weight[source], pixels, large, magnification=3.0)
    centres = ((pixels % 3) == 1).all(1)
    assert torch.allclose(magnified[centres], bands, atol=1e-5)


@pytest.mark.parametrize("magnification", [0.5, 1.5, 3.0, 20.0])
def test_detail_is_the_same_where_the_magnification_is_a_tensor(magnification, rng):
    """So it is in exported models."""
    shape = torch.Size((31, 40))
    pixels = torch.nonzero(torch.rand(shape, generator=rng) < 0.6)
    colours = torch.rand(len(pixels), 2, 3, generator=rng)
    weight = 0.01 + torch.rand(len(pixels), generator=rng)
    expected = detail_bands(colours, weight, pixels, shape, magnification)
    bands = detail_bands(colours, weight, pixels, shape, torch.tensor(magnification).double())
    assert torch.allclose(bands, expected, atol=1e-5)


def test_squares_of_detail_grow_with_the_magnification():
    assert band_sides_px(0.4) == band_sides_px(1.0) == band_sides_px(1.25) == BAND_PX == (3, 7)
    assert [band_sides_px(factor) for factor in (2.0, 3.0, 6.1)] == [(5, 13), (9, 21), (17, 41)]
    assert band_sides_px(100.0) == band_sides_px(8.0)


def test_a_downsampled_view_has_the_means_of_covered_pixels(scene):
    _, view, _ = scene
    small, (height, width) = downsample2x(view), view.mask.shape
    assert (
        small.mask.shape == (math.ceil(height / 2), math.ceil(width / 2))
        and small.source_views == view.source_views
    )
    partly = 0
    for row in range(small.mask.shape[0]):
        for column in range(small.mask.shape[1]):
            cell = (slice(2 * row, 2 * row + 2), slice(2 * column, 2 * column + 2))
            covered = view.mask[cell] > 0
            assert bool(small.mask[row, column]) == bool(covered.any())
            if covered.any():
                for own, whole in ((small.rgb, view.rgb), (small.weights, view.weights)):
                    assert torch.allclose(own[:, row, column], whole[:, *cell][:, covered].mean(1), atol=1e-5)
                assert small.depth[row, column] == view.depth[cell][covered].min()
                partly += not covered.all()
    assert partly > 20
    point = (
        view.camera.centers[0] + 2.0 * view.camera.world_from_camera[0, :3, 2] + torch.tensor([0.1, 0.2, 0.0])
    )
    (one, _), (other, _) = (project(point[None], each.camera) for each in (view, small))
    assert torch.allclose(one / 2, other, atol=1e-4), "the same rays"


def test_upsampling_interpolates_between_values_inside():
    image, inside = torch.tensor([[[1.0, 3.0, 100.0]]]), torch.tensor([[True, True, False]])
    large = upsample2x(image, inside, (2, 5))
    assert large.shape == (1, 2, 5) and large[0, 0].tolist() == pytest.approx([1.0, 1.5, 2.5, 3.0, 3.0])


def some_pixels(shape, share, rng):
    """Random pixels, and all corners."""
    chosen = torch.rand(shape, generator=rng) < share
    chosen[[0, 0, -1, -1], [0, -1, 0, -1]] = True
    return torch.nonzero(chosen)


def layers_of(channels: int) -> nn.Sequential:
    torch.manual_seed(1)
    return nn.Sequential(
        *(nn.Conv2d(channels, 8, 3, padding=1), nn.ReLU(), nn.Conv2d(8, 8, 3, padding=1), nn.ReLU()),
        nn.Conv2d(8, 5, 3, padding=1),
    )


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("share", [0.002, 0.3])
@torch.no_grad()
def test_tiles_equal_a_pass_over_the_whole_image(shape, share, rng):
    pixels = some_pixels(shape, share, rng)
    values = torch.randn(len(pixels), 6, generator=rng)
    cells = torch.randn(1, 4, -(-shape[0] // CELL_PX), -(-shape[1] // CELL_PX), generator=rng)
    near = F.interpolate(cells, scale_factor=CELL_PX, mode="bilinear")[0, :, : shape[0], : shape[1]]
    image = torch.cat([near, scatter_to_image(values, pixels, torch.Size(shape))])[None]
    wanted = layers_of(10)(image)[0, :, pixels[:, 0], pixels[:, 1]].T
    found = run_tiled(layers_of(10), cells, values, pixels, torch.Size(shape))
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_only_tiles_with_pixels_pass_the_layers_in_few_batch_sizes(monkeypatch):
    layers, own, shapes = layers_of(3), F.conv2d, []
    shape, cells = torch.Size((10 * TILE_PX, 10 * TILE_PX)), torch.zeros(1, 2, 5 * TILE_PX, 5 * TILE_PX)
    at = torch.arange(0, 10) * TILE_PX + 5
    monkeypatch.setattr(F, "conv2d", lambda x, *rest: shapes.append(tuple(x.shape)) or own(x, *rest))
    run_tiled(layers, cells, torch.ones(10, 1), torch.stack([at, at], 1), shape)
    first = [size for size in shapes if size[1] == 3]
    assert sum(size[0] for size in first) == 10 and {size[0] for size in first} <= set(TILES_AT_ONCE)
    assert {size[2:] for size in first} == {(TILE_PX + 6, TILE_PX + 6)}


@pytest.mark.parametrize("shape", SHAPES)
def test_the_first_layer_at_points_equals_the_whole_one(shape, rng):
    torch.manual_seed(3)
    net, cells = UNet(12, 8), some_pixels(shape, 0.2, rng)
    values = torch.randn(len(cells), 9, generator=rng, requires_grad=True)
    image = torch.randn(1, 3, *shape, generator=rng)
    found = net.forward_points(values, cells, image)
    whole = net(torch.cat([scatter_to_image(values, cells, torch.Size(shape))[None], image], 1))
    torch.testing.assert_close(found, whole, atol=1e-5, rtol=1e-5)
    (own,), (wanted,) = (torch.autograd.grad(out.square().sum(), values) for out in (found, whole))
    torch.testing.assert_close(own, wanted, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("shape", SHAPES)
def test_cells_at_pixels_equal_an_upsampled_image(shape, rng):
    rows, columns = -(-shape[0] // CELL_PX), -(-shape[1] // CELL_PX)
    cells = some_pixels((rows, columns), 0.4, rng)
    values, size = torch.randn(len(cells), 3, generator=rng), torch.Size((rows, columns))
    index = index_image(cells, size)
    inside = (index >= 0).repeat_interleave(CELL_PX, 0).repeat_interleave(CELL_PX, 1)[: shape[0], : shape[1]]
    pixels = torch.nonzero(inside)
    distribution = DepthDistribution(cells, index, torch.zeros(rows, columns), values, None, None, None)
    image = scatter_to_image(torch.cat([values, torch.ones(len(cells), 1)], 1), cells, size)
    image = F.interpolate(image[None], scale_factor=CELL_PX, mode="bilinear")[0]
    at = image[:, pixels[:, 0], pixels[:, 1]].T
    torch.testing.assert_close(
        distribution.interpolate(values, pixels), at[:, :-1] / at[:, -1:].clamp_min(1e-6)
    )
