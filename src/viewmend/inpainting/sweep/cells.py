"""Images in cells of a few pixels, with a rim about the proxy; and values at points as images. Ours."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn import functional as F

from viewmend.views import RIM_PX, IncompleteView

CELL_PX = 2
"""Side of the cells in which places are judged."""
BEYOND_M = 1e30
"""Farther than anything; not infinite, of which ONNX Runtime's pooling makes its largest number here and there."""


def rim_depth(depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """The depth, metres, with a rim of `RIM_PX` about the proxy that has the smallest depth near it; 0 elsewhere."""
    far = torch.where(depth > 0, depth, BEYOND_M)
    side = 2 * RIM_PX + 1
    cpu = depth.device.type == "cpu" and depth.dtype == torch.float32
    if cpu and not torch.compiler.is_exporting():  # in a tenth of the time that torch takes
        import cv2

        window, border = np.ones((side, side), np.uint8), {"borderType": cv2.BORDER_CONSTANT, "borderValue": BEYOND_M}
        near = torch.from_numpy(cv2.erode(far.numpy(), window, **border))
    else:
        near = -F.max_pool2d(-far[None], side, 1, RIM_PX)[0]
    return torch.where(near < BEYOND_M, torch.where(depth > 0, depth, near), 0.0)


def halved(view: IncompleteView) -> IncompleteView:
    """The view in half its resolution: what covered pixels of each cell show in the mean, at the nearest depth.

    E is not brought along.
    """
    height, width = view.mask.shape
    right, below = width % 2, height % 2
    camera = view.camera.cropped(0, 0, width + right, height + below)
    covered = F.pad(view.mask, (0, right, 0, below))[None]
    share = F.avg_pool2d(covered, 2).clamp(min=1e-6)

    def mean(images: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel rows columns"]:
        return F.avg_pool2d(F.pad(images, (0, right, 0, below)) * covered, 2) / share

    mask = (share[0] > 1e-6).to(covered)
    return IncompleteView(
        camera.resized((width + right) // 2, (height + below) // 2),
        mean(view.rgb),
        mask,
        mask,
        nearest_depth(view.depth),
        view.source_views,
        mean(view.weights),
        view.time,
        view.candidate_views,
        view.silhouettes,
    )


def doubled(
    image: Float[Tensor, "channel rows columns"], inside: Bool[Tensor, "rows columns"], shape: Sequence[int]
) -> Float[Tensor, "channel height width"]:
    """An image in twice its resolution, cut to this height and width, between its values inside alone."""
    known = inside.to(image)[None]
    large = F.interpolate(torch.cat([image * known, known])[None], scale_factor=2, mode="bilinear")[0]
    large = large[:, : shape[0], : shape[1]]
    return large[:-1] / large[-1:].clamp(min=1e-6)


def nearest_depth(depth: Float[Tensor, "height width"]) -> Float[Tensor, "rows columns"]:
    """The smallest depth in each cell, metres, of the pixels that have any; 0 where none has."""
    height, width = depth.shape
    far = F.pad(torch.where(depth > 0, depth, BEYOND_M), (0, width % 2, 0, height % 2), value=BEYOND_M)
    nearest = -F.max_pool2d(-far[None], CELL_PX)[0]
    return torch.where(nearest < BEYOND_M, nearest, 0.0)


def cell_means(image: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel rows columns"]:
    """The mean of each cell, where it is cut off of what is left of it."""
    height, width = image.shape[1:]
    return F.avg_pool2d(F.pad(image[None], (0, width % 2, 0, height % 2), mode="replicate"), CELL_PX)[0]


def scattered(
    values: Shaped[Tensor, "point channel"], at: Int[Tensor, "point 2"], shape: torch.Size
) -> Shaped[Tensor, "channel rows columns"]:
    """An image of this shape with the values at rows and columns, zeros elsewhere."""
    image = values.new_zeros(shape[0] * shape[1], values.shape[1])
    return image.index_copy_(0, at[:, 0] * shape[1] + at[:, 1], values).view(*shape, -1).permute(2, 0, 1)


def stacked(*images: Shaped[Tensor, "_channel rows columns"]) -> Shaped[Tensor, "1 channel rows columns"]:
    """Images one upon another, with channels last in memory, as `scattered` lays them: nothing is transposed."""
    return torch.cat([image.movedim(0, 2) for image in images], 2)[None].movedim(3, 1)


def cut_to(image: Float[Tensor, "channel rows columns"], shape: torch.Size) -> Float[Tensor, "channel height width"]:
    """The first rows and columns of an image.

    They are gathered in what `torch.export` traces, which else takes it for granted that none are left out, or some.
    """
    if torch.compiler.is_exporting():
        rows, columns = (torch.arange(length, device=image.device) for length in shape)
        return image.index_select(1, rows).index_select(2, columns)
    return image[:, : shape[0], : shape[1]]


def index_image(at: Int[Tensor, "point 2"], shape: torch.Size) -> Int[Tensor, "rows columns"]:
    """An image with the index of the point at each row and column; -1 where there is none."""
    image = torch.full(shape, -1, dtype=torch.long, device=at.device)
    image[tuple(at.T)] = torch.arange(at.shape[0], device=at.device)
    return image
