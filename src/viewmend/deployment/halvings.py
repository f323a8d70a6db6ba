"""Images in all scales for `torch.export`: each level lies in a canvas whose length is never one, and soon a constant.

A length of one would be taken for a fixed one, and expressions of many nested halves are what a compiler spends its
time on. So each canvas has at least a row and a column of zeros more than its image, and from one level on canvases are
as large as the largest image's.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

LARGEST_PX = 4096
"""Sides of images and views are no longer."""


def halvings(
    images: Float[Tensor, "image channel height width"],
    count: int,
    change: Callable[[Tensor], Tensor],
    constant: int,
) -> list[Float[Tensor, "image channel _height _width"]]:
    """All scales of some images, each in a canvas.

    Args:
        images: of any size up to `LARGEST_PX`.
        count: how many scales there are beside the images' own.
        change: what is made of the means of 2 x 2 pixels, before they are halved again.
        constant: the first level whose canvas is as large as the largest image's.
    """
    levels = [F.pad(images, (0, 1, 0, 1))]
    for level in range(1, count + 1):
        half = F.pad(change(F.avg_pool2d(levels[-1], 2)), (0, 1, 0, 1))
        if level == constant:
            for axis in (2, 3):
                place = torch.arange(LARGEST_PX // 2**constant + 2)
                half = half.index_select(axis, place.clamp_max(half.shape[axis] - 1))
        levels.append(half)
    return levels


def lengths(size: int, count: int) -> Int[Tensor, "level"]:
    """What is image of each level's canvas along an axis, pixels."""
    sides = torch.tensor([2**level for level in range(count)])
    return (torch.full((count,), size, dtype=torch.long) + sides - 1) // sides
