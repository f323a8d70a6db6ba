"""Images looked up at pixel positions. Pixel centres are at half-integers, (0.5, 0.5) at the top left."""

from collections.abc import Iterator
from itertools import product
from typing import Literal, NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras


class BilinearTap(NamedTuple):
    """One of the four pixels that a bilinear sample is made of, for many positions."""

    row: Int[Tensor, "*point"]
    """Clamped to the image."""
    column: Int[Tensor, "*point"]
    """Clamped to the image."""
    weight: Float[Tensor, "*point"]
    """The four weights sum to 1, also beyond the border of the image."""
    inside: Bool[Tensor, "*point"]
    """Whether the image has this pixel; where not, `row` and `column` name the nearest one at its border."""


def in_view(
    uv_px: Float[Tensor, "view point 2"], z_m: Float[Tensor, "view point"], cameras: Cameras
) -> Bool[Tensor, "view point"]:
    """Which points, projected to `uv_px` at z-depth `z_m`, lie in front of each camera and inside its image."""
    return (z_m > 0) & (uv_px >= 0).all(-1) & (uv_px < cameras.size_px[:, None]).all(-1)


def bilinear_taps(uv_px: Float[Tensor, "*point 2"], width: int, height: int) -> Iterator[BilinearTap]:
    """The four pixels around each position, row by row, for callers to whom not every pixel counts.

    Only four pixels a position are read, so an image of bytes need not be converted whole.
    """
    uv_px = _clamped(uv_px, width, height) - 0.5
    first = uv_px.floor()
    right, below = (uv_px - first).unbind(-1)
    left, top = first.long().unbind(-1)
    for down, across in product((0, 1), (0, 1)):
        row, column = top + down, left + across
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        weight = (right if across else 1 - right) * (below if down else 1 - below)
        yield BilinearTap(row.clamp(0, height - 1), column.clamp(0, width - 1), weight, inside)


def sample_bilinear(
    images: Float[Tensor, "view channel height width"],
    uv_px: Float[Tensor, "view point 2"],
    padding: Literal["zeros", "border"] = "zeros",
) -> Float[Tensor, "view point channel"]:
    """Images at pixel positions, each at its own. What lies outside is 0, or the nearest pixel of the border."""
    height, width = images.shape[2:]
    grid = 2 * _clamped(uv_px, width, height) / uv_px.new_tensor([width, height]) - 1
    return F.grid_sample(images, grid[:, None], padding_mode=padding, align_corners=False)[:, :, 0].movedim(1, -1)


def _clamped(uv_px: Float[Tensor, "*point 2"], width: int, height: int) -> Float[Tensor, "*point 2"]:
    """Positions kept so near the image that none overflows an integer; one outside stays outside."""
    return uv_px.clamp(-4, 4 * max(width, height))
