"""Convolutions over a view where only some pixels matter: in tiles about these. Ours."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.inpainting.sweep.cells import CELL_PX, index_image

TILE_PX = 32
"""Side of the tiles; a multiple of a cell's."""
AT_ONCE = (8, 4, 2, 1)
"""So many tiles go through the layers together: few numbers, since convolutions are compiled for each they meet."""


def in_tiles(
    layers: nn.Sequential,
    decided: Float[Tensor, "1 feature rows columns"],
    told: Float[Tensor, "pixel told"],
    pixels: Int[Tensor, "pixel 2"],
    shape: torch.Size,
) -> Float[Tensor, "pixel output"]:
    """What layers make of an image at some pixels, as if they had gone over all of it.

    The image's first channels are `decided`, enlarged from cells bilinearly; the others are what is `told` of the
    pixels, zeros elsewhere.

    Args:
        layers: convolutions of odd kernels that keep the size, and what looks at each pixel by itself.
        decided: of a view's cells.
        told: of each pixel.
        pixels: row and column.
        shape: height and width of the view.
    """
    halo = sum(layer.kernel_size[0] // 2 for layer in layers if isinstance(layer, nn.Conv2d))
    across = -(-shape[1] // TILE_PX)
    number = pixels[:, 0] // TILE_PX * across + pixels[:, 1] // TILE_PX
    tiles, own = number.unique(return_inverse=True)
    rows, columns = tiles // across * TILE_PX, tiles % across * TILE_PX
    end = TILE_PX + halo
    leaves = (rows < halo) | (columns < halo) | (rows + end > shape[0]) | (columns + end > shape[1])
    border = bool(leaves.any())
    index = _Framed(index_image(pixels, shape)[None], halo, TILE_PX, -1)
    near = _Framed(decided[0], -(-halo // CELL_PX) + 1, TILE_PX // CELL_PX, None)
    values = F.pad(told, (0, 0, 0, 1))  # last, a pixel of which nothing is told
    found = []
    for part in _parts(len(tiles)):
        place = index.windows(rows[part], columns[part])[0]
        fine = F.interpolate(
            near.windows(rows[part] // CELL_PX, columns[part] // CELL_PX).movedim(0, 1),
            scale_factor=CELL_PX, mode="bilinear", align_corners=False,
        )  # fmt: skip
        beyond = CELL_PX * near.halo - halo
        fine = fine[:, :, beyond:-beyond, beyond:-beyond].to(told)
        x = torch.cat([fine.movedim(1, 3), values[place]], 3).movedim(3, 1)
        inside = _inside(rows[part], columns[part], halo, shape) if border else None
        found.append(_through(layers, x, None if inside is None else inside.to(x)))
    out = torch.cat(found)
    return out[own, :, pixels[:, 0] % TILE_PX, pixels[:, 1] % TILE_PX]


class _Framed:
    """An image with a frame, in windows of a tile and a halo; the frame repeats the border where no value is given."""

    def __init__(self, image: Tensor, halo: int, tile: int, value: int | None) -> None:
        height, width = image.shape[1:]
        below, right = (halo + -length % tile for length in (height, width))
        frame = (halo, right, halo, below)
        if value is None:
            image = F.pad(image[None], frame, mode="replicate")[0]
        else:
            image = F.pad(image, frame, value=value)
        self.halo, self._tile = halo, tile
        self._windows = image.unfold(1, tile + 2 * halo, tile).unfold(2, tile + 2 * halo, tile)

    def windows(self, rows: Int[Tensor, "tile"], columns: Int[Tensor, "tile"]) -> Tensor:
        """The windows of tiles that begin at these rows and columns, `[channel, tile, height, width]`."""
        return self._windows[:, rows // self._tile, columns // self._tile]


def _parts(count: int) -> Iterator[slice]:
    first = 0
    for size in AT_ONCE:
        while count - first >= size:
            yield slice(first, first + size)
            first += size


def _inside(
    rows: Int[Tensor, "tile"], columns: Int[Tensor, "tile"], halo: int, shape: torch.Size
) -> Float[Tensor, "tile 1 height width"]:
    """1 where a tile and its halo are in the image: beyond it layers see zeros."""
    reach = torch.arange(-halo, TILE_PX + halo, device=rows.device)
    down, right = rows[:, None] + reach, columns[:, None] + reach
    down, right = (down >= 0) & (down < shape[0]), (right >= 0) & (right < shape[1])
    return (down[:, None, :, None] & right[:, None, None, :]).float()


def _through(layers: nn.Sequential, x: Tensor, inside: Tensor | None) -> Tensor:
    x = x if inside is None else x * inside
    for layer in layers:
        if not isinstance(layer, nn.Conv2d):
            x = layer(x)
            continue
        x = F.conv2d(x, layer.weight, layer.bias)
        lost = layer.kernel_size[0] // 2
        if inside is not None and lost:
            inside = inside[:, :, lost:-lost, lost:-lost]
        x = x if inside is None else x * inside
    return x
