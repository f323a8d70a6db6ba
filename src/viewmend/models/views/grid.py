"""Images at full resolution and on a grid of 2 x 2 pixel cells, and the convolutions over them."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.rim import BEYOND_M
from viewmend.models.views.box_sums import BoxSums
from viewmend.types import IncompleteView
from viewmend.utils.cancellation import stop_if_cancelled

Pixels = Int[Tensor, "pixel 2"]
"""Row and column of pixels."""
CELL_PX = 2
"""The depth hypotheses are those of square cells with this side, pixels."""
TILE_PX = 32
"""The tiles of `run_tiled` have this side, pixels, which is a multiple of `CELL_PX`."""
TILES_AT_ONCE = (8, 4, 2, 1)
"""The layers run on one of these numbers of tiles at a time: each other batch size would compile convolutions again."""
BAND_PX = (3, 7)
"""Means over squares of these sides, pixels, separate the bands of detail. The sides are those for a view
that shows the subject as large as the source cameras do; see `band_sides_px`."""
MAX_MAGNIFICATION = 8.0
"""The squares grow with a view's magnification up to this factor."""
LARGE_CELLS_FROM = 3.0
"""Views of at least this magnification have cells of twice the side. There, a normal cell is smaller than
a pixel of the source cameras: the depths of neighbouring cells would differ by chance, which shows as specks."""
WIDTH_STEP = 16
"""The U-Net adds this many channels at each coarser scale."""
MIN_COVERAGE = 1e-6
"""A cell is covered if its mean mask is above this share."""


def downsample2x(view: IncompleteView) -> IncompleteView:
    """The view at half its resolution: means over the covered pixels of each cell, at their nearest depth.

    E is 1 wherever the proxy covers the cell.
    """
    height, width = view.mask.shape
    right = width % 2
    below = height % 2
    padded = view.camera.cropped(0, 0, width + right, height + below)
    camera = padded.resized((width + 1) // 2, (height + 1) // 2)
    pixel_mask = F.pad(view.mask, (0, right, 0, below))[None]
    share = F.avg_pool2d(pixel_mask, 2)

    def mean(images: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel rows columns"]:
        total = F.avg_pool2d(F.pad(images, (0, right, 0, below)) * pixel_mask, 2)
        return total / share.clamp(min=MIN_COVERAGE)

    mask = (share[0] > MIN_COVERAGE).to(view.mask)
    return replace(
        view,
        camera=camera,
        rgb=mean(view.rgb),
        mask=mask,
        error=mask,
        depth=nearest_depth(view.depth),
        weights=mean(view.weights),
        fade=None,
        target_mask=None,
    )


def upsample2x(
    image: Float[Tensor, "channel rows columns"], inside: Bool[Tensor, "rows columns"], shape: Sequence[int]
) -> Float[Tensor, "channel height width"]:
    """The image at twice its resolution, cut to `shape`, interpolated between values inside only."""
    known = inside.to(image)[None]
    weighted = torch.cat([image * known, known])
    large = F.interpolate(weighted[None], scale_factor=2, mode="bilinear")[0]
    cut = large[:, : shape[0], : shape[1]]
    return cut[:-1] / cut[-1:].clamp(min=1e-6)


def nearest_depth(depth: Float[Tensor, "*image height width"]) -> Float[Tensor, "*image rows columns"]:
    """The smallest depth in each cell, metres, of the pixels that have one (above 0); 0 if no pixel has."""
    nearness = -F.threshold(depth, 0.0, BEYOND_M).view(-1, *depth.shape[-2:])
    nearest = -F.max_pool2d(nearness, CELL_PX, ceil_mode=True)
    return (nearest * (nearest < BEYOND_M)).view(*depth.shape[:-2], *nearest.shape[1:])


def cell_means(image: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel rows columns"]:
    """The mean of each cell; of a cell that reaches beyond the image, the mean of the part inside."""
    return F.avg_pool2d(image, CELL_PX, ceil_mode=True)


def scatter_to_image(
    values: Shaped[Tensor, "point channel"], at: Int[Tensor, "point 2"], shape: torch.Size
) -> Shaped[Tensor, "channel rows columns"]:
    """An image of this shape with the values `at` these rows and columns, and zeros elsewhere."""
    image = values.new_zeros(*shape, values.shape[1])
    return image.index_put_(tuple(at.unbind(1)), values).permute(2, 0, 1)


def detail_bands(
    colours: Float[Tensor, "pixel image 3"],
    weight: Float[Tensor, "pixel"],
    pixels: Pixels,
    shape: torch.Size,
    magnification: float | Float[Tensor, ""] = 1.0,
) -> Float[Tensor, "pixel band image 3"]:
    """The detail of images in frequency bands: one band for each of `BAND_PX`, the finest first.

    A band is the difference between two local means, or between the image and its finest local mean. The
    means are over larger squares in magnified views. Otherwise, the finest band would add specks where
    neighbouring pixels were sampled in different cameras.

    Args:
        colours: the images' colours at the pixels.
        weight: weight of each pixel in the means, above 0.
        pixels: row and column of each pixel.
        shape: height and width of the images.
        magnification: that of the images, relative to the source cameras (`SourceCameras.magnification`).
    """
    count = colours.shape[1]
    weighted = (weight[:, None, None] * colours).flatten(1)
    image = scatter_to_image(torch.cat([weighted, weight[:, None]], 1), pixels, shape)
    sums = torch.stack([_box_means_at(image, side, pixels) for side in band_sides_px(magnification)], 1)
    means = (sums[..., :-1] / sums[..., -1:].clamp_min(1e-6)).unflatten(2, (count, 3))
    return torch.cat([colours[:, None], means[:, :-1]], 1) - means


def band_sides_px(magnification: float | Float[Tensor, ""]) -> tuple[int | Int[Tensor, ""], ...]:
    """`BAND_PX` times the magnification of a view, rounded down to odd numbers of pixels."""
    if isinstance(magnification, Tensor):
        factors = magnification.clamp(1.0, MAX_MAGNIFICATION)
        return tuple(2 * ((factors * side - 1) / 2).long() + 1 for side in BAND_PX)
    factor = min(max(magnification, 1.0), MAX_MAGNIFICATION)
    return tuple(2 * int((factor * side - 1) / 2) + 1 for side in BAND_PX)


def _box_means_at(
    image: Float[Tensor, "channel height width"], side: int | Int[Tensor, ""], pixels: Pixels
) -> Float[Tensor, "pixel channel"]:
    """Means over squares around pixels of an image, which is 0 beyond its border."""
    rows, columns = pixels.unbind(1)
    if isinstance(side, Tensor):
        # Pooling in an exported model needs a side that is known in advance; summed-area tables do not
        corners = torch.stack([-(side // 2), side // 2 + 1])
        sums = BoxSums.of(image[None]).boxes(rows[:, None, None] + corners, columns[:, None, None] + corners)
        return (sums.flatten(1) / side.double() ** 2).float()
    if image.device.type == "cpu" and not torch.is_grad_enabled() and not torch.compiler.is_exporting():
        import cv2

        # Faster than PyTorch by an order of magnitude
        channels_last = image.permute(1, 2, 0).contiguous().numpy()
        means = cv2.blur(channels_last, (side, side), borderType=cv2.BORDER_CONSTANT)
        return torch.from_numpy(means)[rows, columns]
    return F.avg_pool2d(image[None], side, 1, side // 2)[0, :, rows, columns].T


def index_image(at: Int[Tensor, "point 2"], shape: torch.Size) -> Int[Tensor, "rows columns"]:
    """An image with the index of the point at each row and column; -1 where there is none."""
    image = torch.full(shape, -1, dtype=torch.long, device=at.device)
    image[tuple(at.T)] = torch.arange(at.shape[0], device=at.device)
    return image


def concatenate_channels(
    *images: Shaped[Tensor, "_channel rows columns"],
) -> Shaped[Tensor, "1 channel rows columns"]:
    """The channels of all images as a batch of one. Memory is channels-last, as `scatter_to_image` returns it."""
    return torch.cat([image.movedim(0, 2) for image in images], 2)[None].movedim(3, 1)


def crop_to(
    image: Float[Tensor, "channel rows columns"], shape: torch.Size
) -> Float[Tensor, "channel height width"]:
    """The first rows and columns of an image.

    While `torch.export` traces, rows and columns are gathered: a slice would fix whether anything is cut off.
    """
    if torch.compiler.is_exporting():
        rows, columns = (torch.arange(length, device=image.device) for length in shape)
        return image.index_select(1, rows).index_select(2, columns)
    return image[:, : shape[0], : shape[1]]


class UNet(nn.Module):
    """Convolutions at four scales (Ronneberger et al., MICCAI 2015), with skip connections that add features."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        widths = tuple(width + WIDTH_STEP * scale for scale in range(4))
        self.enter = nn.Conv2d(channels, width, 1)
        self.first = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=1),
        )
        self.down = nn.ModuleList()
        for fine, coarse in pairwise(widths):
            layers = nn.Sequential(
                nn.Conv2d(fine, coarse, 3, stride=2, padding=1),
                nn.ReLU(),
                nn.Conv2d(coarse, coarse, 3, padding=1),
                nn.ReLU(),
            )
            self.down.append(layers)
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairwise(widths))
        self.join = nn.ModuleList(nn.Conv2d(fine, fine, 3, padding=1) for fine in widths[:-1])

    def forward(
        self, image: Float[Tensor, "1 channel height width"]
    ) -> Float[Tensor, "1 feature height width"]:
        """Features of the same resolution."""
        return self._run_scales(F.relu(self.enter(image.contiguous(memory_format=torch.channels_last))))

    def forward_points(
        self,
        values: Float[Tensor, "point first_channel"],
        at: Int[Tensor, "point 2"],
        image: Float[Tensor, "1 other_channel height width"],
    ) -> Float[Tensor, "1 feature height width"]:
        """The same as `forward` for an image whose first channels are 0 except at some points.

        The first layer has a kernel of one pixel, so it runs on the first channels at these points only.

        Args:
            values: the first channels at the points.
            at: row and column of each point.
            image: the other channels.
        """
        weight = self.enter.weight
        first_channels = values.shape[1]
        channels_last = image.contiguous(memory_format=torch.channels_last)
        x = F.conv2d(channels_last, weight[:, first_channels:], self.enter.bias)
        at_points = F.linear(values, weight[:, :first_channels, 0, 0]).to(x.dtype)
        return self._run_scales(F.relu(x + scatter_to_image(at_points, at, image.shape[2:])))

    def _run_scales(
        self, x: Float[Tensor, "1 feature height width"]
    ) -> Float[Tensor, "1 feature height width"]:
        """The output of all layers after the first, for its output `x`."""
        scales = [F.relu(x + self.first(x))]
        for layer in self.down:
            stop_if_cancelled()
            scales.append(layer(scales[-1]))
        joined = scales.pop()
        for scale, up, join in reversed(list(zip(scales, self.up, self.join, strict=True))):
            stop_if_cancelled()
            coarse = F.interpolate(up(joined), size=scale.shape[2:], mode="bilinear", align_corners=False)
            joined = F.relu(scale + join(F.relu(coarse + scale)))
        return joined


def run_tiled(
    layers: nn.Sequential,
    cells: Float[Tensor, "1 feature rows columns"],
    values: Float[Tensor, "pixel input"],
    pixels: Pixels,
    shape: torch.Size,
) -> Float[Tensor, "pixel output"]:
    """The output of layers at some pixels of an image, from the tiles around these pixels only.

    The image has `shape`. Its first channels are `cells`, which have half its resolution and are
    upsampled bilinearly. Its other channels are `values` at the pixels, and zeros elsewhere. The layers
    are convolutions that keep the size, with kernels of odd sides, and layers that act on single pixels.
    """
    # The tiles that contain a pixel
    halo = sum(layer.kernel_size[0] // 2 for layer in layers if isinstance(layer, nn.Conv2d))
    tiles_per_row = -(-shape[1] // TILE_PX)
    tile_number = pixels[:, 0] // TILE_PX * tiles_per_row + pixels[:, 1] // TILE_PX
    tiles, tile_of_pixel = tile_number.unique(return_inverse=True)
    tile_rows = tiles // tiles_per_row
    tile_columns = tiles % tiles_per_row
    at_border = _reaches_border(tile_rows, tile_columns, halo, shape)

    # The indices of values and of cells in each tile and its halo: a window
    value_windows = _value_windows(pixels, shape, halo)
    cell_windows = _cell_windows(cells, halo)
    padded_values = F.pad(values, (0, 0, 0, 1))  # the last row stands for pixels without values
    cell_values = cells[0].movedim(0, 2).flatten(0, 1)

    outputs = []
    first = 0
    while first < len(tiles):
        stop_if_cancelled()
        size = next(size for size in TILES_AT_ONCE if size <= len(tiles) - first)
        rows = tile_rows[first : first + size]
        columns = tile_columns[first : first + size]
        upsampled = _upsample_windows(cell_values[cell_windows[rows, columns]], halo).to(values)
        x = torch.cat([upsampled, padded_values[value_windows[rows, columns]]], 3).movedim(3, 1)
        inside = _inside(rows, columns, halo, shape).to(x) if at_border else None
        outputs.append(_run_unpadded(layers, x, inside))
        first += size
    return torch.cat(outputs)[tile_of_pixel, :, pixels[:, 0] % TILE_PX, pixels[:, 1] % TILE_PX]


def _cell_halo(halo: int) -> int:
    """The halo of tiles in cells: one cell more than is needed, for the interpolation."""
    return -(-halo // CELL_PX) + 1


def _value_windows(
    pixels: Pixels, shape: torch.Size, halo: int
) -> Int[Tensor, "tile_row tile_column height width"]:
    """The pixels of each tile's window, as indices in `pixels`; -1 for a pixel that is not in `pixels`."""
    index = F.pad(index_image(pixels, shape)[None], _window_padding(shape, halo, TILE_PX), value=-1)
    return _windows(index, halo, TILE_PX)[0]


def _cell_windows(
    cells: Float[Tensor, "1 feature rows columns"], halo: int
) -> Int[Tensor, "tile_row tile_column height width"]:
    """The cells of each tile's window, as indices in `cells`; beyond the border, that of the nearest cell."""
    grid = cells.shape[2:]
    index = torch.arange(grid.numel(), device=cells.device).view(1, 1, *grid).double()
    padding = _window_padding(grid, _cell_halo(halo), TILE_PX // CELL_PX)
    padded = F.pad(index, padding, mode="replicate").long()
    return _windows(padded[0], _cell_halo(halo), TILE_PX // CELL_PX)[0]


def _upsample_windows(
    coarse: Float[Tensor, "tile rows columns feature"], halo: int
) -> Float[Tensor, "tile height width feature"]:
    """Windows of cells, upsampled to pixels; what lies beyond a halo of `halo` pixels is cut off."""
    # Interpolation is faster with channels last in memory
    channels_first = coarse.movedim(3, 1)
    fine = F.interpolate(channels_first, scale_factor=CELL_PX, mode="bilinear", align_corners=False)
    cut = CELL_PX * _cell_halo(halo) - halo
    return fine.movedim(1, 3)[:, cut:-cut, cut:-cut]


def _window_padding(shape: Sequence[int], halo: int, tile: int) -> tuple[int, int, int, int]:
    """Padding of an image to whole tiles with a halo around them: left, right, top, bottom."""
    bottom, right = (halo + (-length) % tile for length in shape)
    return halo, right, halo, bottom


def _windows(image: Shaped[Tensor, "channel height width"], halo: int, tile: int) -> Tensor:
    """The windows of all tiles of a padded image, [channel, tile row, tile column, height, width]."""
    return image.unfold(1, tile + 2 * halo, tile).unfold(2, tile + 2 * halo, tile)


def _reaches_border(
    tile_rows: Int[Tensor, "tile"], tile_columns: Int[Tensor, "tile"], halo: int, shape: torch.Size
) -> bool:
    """Whether the window of any of these tiles reaches beyond the image."""
    beyond = False
    for tile, length in ((tile_rows, shape[0]), (tile_columns, shape[1])):
        first = tile * TILE_PX
        beyond |= bool(((first < halo) | (first + TILE_PX + halo > length)).any())
    return beyond


def _inside(
    tile_rows: Int[Tensor, "tile"], tile_columns: Int[Tensor, "tile"], halo: int, shape: torch.Size
) -> Float[Tensor, "tile 1 height width"]:
    """1 for pixels of the tiles' windows that are in the image, 0 for those beyond its border."""
    reach = torch.arange(-halo, TILE_PX + halo, device=tile_rows.device)
    row = tile_rows[:, None] * TILE_PX + reach
    column = tile_columns[:, None] * TILE_PX + reach
    row_inside = (row >= 0) & (row < shape[0])
    column_inside = (column >= 0) & (column < shape[1])
    return (row_inside[:, None, :, None] & column_inside[:, None, None, :]).float()


def _run_unpadded(layers: nn.Sequential, x: Tensor, inside: Tensor | None) -> Tensor:
    """The output of the layers without padding.

    Pixels that are not `inside` the image are 0 before each convolution, as padding would make them.
    """
    x = x if inside is None else x * inside
    for layer in layers:
        if not isinstance(layer, nn.Conv2d):
            x = layer(x)
            continue
        x = F.conv2d(x, layer.weight, layer.bias)
        border = layer.kernel_size[0] // 2
        if inside is not None and border:
            inside = inside[:, :, border:-border, border:-border]
        x = x if inside is None else x * inside
    return x
