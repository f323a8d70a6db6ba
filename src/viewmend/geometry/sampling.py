"""Images looked up at pixel positions. Pixel centres are at half-integers, (0.5, 0.5) at the top left."""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras


class BilinearTaps(NamedTuple):
    """The four pixels that bilinear samples at many positions are made of."""

    row: Int[Tensor, "tap=4 view point"]
    """That of the nearest pixel at the border, if the image has no such pixel."""
    column: Int[Tensor, "tap=4 view point"]
    """That of the nearest pixel at the border, as `row`."""
    weight: Float[Tensor, "tap=4 view point"]
    """The four weights sum to 1, also beyond the border of the image."""


def in_view(
    uv_px: Float[Tensor, "view point 2"], z_m: Float[Tensor, "view point"], cameras: Cameras
) -> Bool[Tensor, "view point"]:
    """Which points, projected to `uv_px` at z-depth `z_m`, lie in front of each camera and inside its image."""
    return (z_m > 0) & ((uv_px >= 0) & (uv_px < cameras.size_px[:, None])).all(-1)


def nearest_pixels(
    uv_px: Float[Tensor, "view point 2"], cameras: Cameras
) -> tuple[Int[Tensor, "view 1"], Int[Tensor, "view point"], Int[Tensor, "view point"]]:
    """View, row and column of the pixel at each position, to index images with; at the border if there is none."""
    last = (cameras.size_px - 1)[:, None]
    column, row = torch.minimum(uv_px.nan_to_num(0.0).clamp_min(0).long(), last).unbind(-1)
    view = torch.arange(len(cameras), device=uv_px.device)[:, None]
    return view, row, column


def bilinear_taps(uv_px: Float[Tensor, "view point 2"], cameras: Cameras) -> BilinearTaps:
    """The four pixels around each position in its camera's image, stacked in front, row by row.

    Only four pixels a position are read, so an image of bytes need not be converted whole.
    """
    width, height = cameras.max_size_px
    size = cameras.size_px[:, None]
    clamped = _clamped(uv_px, width, height) - 0.5
    first = clamped.floor()
    share = clamped - first
    corner = uv_px.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]])[:, None, None]
    place = (first + corner).long()
    weight = torch.lerp(1 - share, share, corner).prod(-1)
    column, row = place.clamp(min=0).minimum(size - 1).unbind(-1)
    return BilinearTaps(row, column, weight)


def sample_bilinear(
    images: Float[Tensor, "view channel height width"],
    uv_px: Float[Tensor, "view point 2"],
    padding: Literal["zeros", "border"] = "zeros",
) -> Float[Tensor, "view point channel"]:
    """Images at pixel positions, each at its own. What lies outside is 0, or the nearest pixel of the border."""
    height, width = images.shape[2:]
    grid = 2 * _clamped(uv_px, width, height) / uv_px.new_tensor([width, height]) - 1
    return F.grid_sample(images, grid[:, None], padding_mode=padding, align_corners=False)[:, :, 0].movedim(
        1, -1
    )


def _clamped(uv_px: Float[Tensor, "*point 2"], width: int, height: int) -> Float[Tensor, "*point 2"]:
    """Positions kept so near the image that none overflows an integer; one outside stays outside."""
    return uv_px.clamp(-4, 4 * max(width, height))
