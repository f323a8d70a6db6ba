"""Images in cells of a few pixels, with a rim about the proxy; and values at points as images. Ours."""

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn import functional as F

from viewmend.views import RIM_PX

CELL_PX = 2
"""Side of the cells in which places are judged."""


def rim_depth(depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """The depth, metres, with a rim of `RIM_PX` about the proxy that has the smallest depth near it; 0 elsewhere."""
    far = torch.where(depth > 0, depth, torch.inf)
    near = -F.max_pool2d(-far[None], 2 * RIM_PX + 1, 1, RIM_PX)[0]
    return torch.where(depth > 0, depth, torch.where(near.isfinite(), near, 0.0))


def nearest_depth(depth: Float[Tensor, "height width"]) -> Float[Tensor, "rows columns"]:
    """The smallest depth in each cell, metres, of the pixels that have any; 0 where none has."""
    height, width = depth.shape
    far = F.pad(torch.where(depth > 0, depth, torch.inf), (0, width % 2, 0, height % 2), value=torch.inf)
    nearest = -F.max_pool2d(-far[None], CELL_PX)[0]
    return torch.where(nearest.isfinite(), nearest, 0.0)


def scattered(
    values: Shaped[Tensor, "point channel"], at: Int[Tensor, "point 2"], shape: torch.Size
) -> Shaped[Tensor, "channel rows columns"]:
    """An image of this shape with the values at rows and columns, zeros elsewhere."""
    image = values.new_zeros(shape[0] * shape[1], values.shape[1])
    return image.index_copy_(0, at[:, 0] * shape[1] + at[:, 1], values).view(*shape, -1).permute(2, 0, 1)


def stacked(*images: Shaped[Tensor, "_channel rows columns"]) -> Shaped[Tensor, "1 channel rows columns"]:
    """Images one upon another, with channels last in memory, as `scattered` lays them: nothing is transposed."""
    return torch.cat([image.movedim(0, 2) for image in images], 2)[None].movedim(3, 1)


def index_image(at: Int[Tensor, "point 2"], shape: torch.Size) -> Int[Tensor, "rows columns"]:
    """An image with the index of the point at each row and column; -1 where there is none."""
    image = torch.full(shape, -1, dtype=torch.long, device=at.device)
    image[tuple(at.T)] = torch.arange(len(at), device=at.device)
    return image
