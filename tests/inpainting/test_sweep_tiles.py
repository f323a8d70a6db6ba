"""Layers that go over a view where pixels are read alone: what the obvious pass over all of it gives."""

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from viewmend.inpainting.sweep.cells import CELL_PX, index_image, scattered
from viewmend.inpainting.sweep.reading import Swept, finer
from viewmend.inpainting.sweep.tiles import AT_ONCE, TILE_PX, in_tiles
from viewmend.inpainting.sweep.unet import UNet

SHAPES = [(70, 53), (64, 96), (33, 161), (17, 9)]


def some_pixels(shape, share, chance):
    """Random pixels, and all corners: what is beyond the border must count as the whole pass counts it."""
    read = torch.rand(shape, generator=chance) < share
    read[[0, 0, -1, -1], [0, -1, 0, -1]] = True
    return torch.nonzero(read)


def layers_of(channels: int) -> nn.Sequential:
    torch.manual_seed(1)
    return nn.Sequential(
        *(nn.Conv2d(channels, 8, 3, padding=1), nn.ReLU(), nn.Conv2d(8, 8, 3, padding=1), nn.ReLU()),
        nn.Conv2d(8, 5, 3, padding=1),
    )


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("share", [0.002, 0.3])
@torch.no_grad()
def test_tiles_are_parts_of_the_whole(shape, share):
    chance = torch.Generator().manual_seed(7)
    pixels = some_pixels(shape, share, chance)
    told = torch.randn(len(pixels), 6, generator=chance)
    decided = torch.randn(1, 4, -(-shape[0] // CELL_PX), -(-shape[1] // CELL_PX), generator=chance)
    layers = layers_of(10)
    near = F.interpolate(decided, scale_factor=CELL_PX, mode="bilinear")[0, :, : shape[0], : shape[1]]
    image = torch.cat([near, scattered(told, pixels, torch.Size(shape))])[None]
    wanted = layers(image)[0, :, pixels[:, 0], pixels[:, 1]].T
    found = in_tiles(layers, decided, told, pixels, torch.Size(shape))
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_only_tiles_with_pixels_are_gone_through_and_few_sizes_of_them():
    layers = layers_of(3)
    layers[0].register_forward_hook(lambda *_: pytest.fail("the layer's own way pads"))
    own, seen = F.conv2d, []
    shape, decided = torch.Size((10 * TILE_PX, 10 * TILE_PX)), torch.zeros(1, 2, 5 * TILE_PX, 5 * TILE_PX)
    at = torch.arange(0, 10) * TILE_PX + 5
    pixels = torch.stack([at, at], 1)

    def counted(x, *rest):
        seen.append(tuple(x.shape))
        return own(x, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(F, "conv2d", counted)
        in_tiles(layers, decided, torch.ones(10, 1), pixels, shape)
    sizes = [size[0] for size in seen if size[1] == 3]
    assert sum(sizes) == 10 and set(sizes) <= set(AT_ONCE)
    assert {size[2:] for size in seen if size[1] == 3} == {(TILE_PX + 6, TILE_PX + 6)}


@pytest.mark.parametrize("shape", SHAPES)
def test_the_first_layer_at_points_alone_is_the_whole_one(shape):
    torch.manual_seed(3)
    net, chance = UNet(12, 8), torch.Generator().manual_seed(5)
    cells = some_pixels(shape, 0.2, chance)
    values = torch.randn(len(cells), 9, generator=chance, requires_grad=True)
    image = torch.randn(1, 3, *shape, generator=chance)
    found = net.of_points(values, cells, image)
    whole = torch.cat([scattered(values, cells, torch.Size(shape))[None], image], 1)
    torch.testing.assert_close(found, net(whole), atol=1e-5, rtol=1e-5)
    (own,) = torch.autograd.grad(found.square().sum(), values)
    (theirs,) = torch.autograd.grad(net(whole).square().sum(), values)
    torch.testing.assert_close(own, theirs, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("shape", SHAPES)
def test_cells_at_pixels_are_what_enlarging_gives(shape):
    chance = torch.Generator().manual_seed(11)
    rows, columns = -(-shape[0] // CELL_PX), -(-shape[1] // CELL_PX)
    cells = some_pixels((rows, columns), 0.4, chance)
    values = torch.randn(len(cells), 3, generator=chance)
    read = torch.zeros(rows, columns, dtype=torch.bool)
    read[tuple(cells.T)] = True
    inside = read.repeat_interleave(CELL_PX, 0).repeat_interleave(CELL_PX, 1)[: shape[0], : shape[1]]
    pixels = torch.nonzero(inside)
    swept = Swept(
        cells, index_image(cells, read.shape), torch.zeros(rows, columns), values, None, None
    )  # the last two are not looked at
    whole = torch.cat([values, torch.ones(len(cells), 1)], 1)
    image = F.interpolate(scattered(whole, cells, read.shape)[None], scale_factor=CELL_PX, mode="bilinear")[0]
    at = image[:, pixels[:, 0], pixels[:, 1]].T
    torch.testing.assert_close(finer(values, swept, pixels), at[:, :-1] / at[:, -1:].clamp_min(1e-6))
