"""Smooth fills of views whose size is not known: the twin of `coarse_fill.fill` for `torch.export`."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.deployment.halvings import halvings, lengths
from viewmend.inpainting.coarse_fill import from_near, spread

LEVELS = 12
"""Halvings until one pixel is left of 4096; further ones change nothing."""
CONSTANT = 3
"""The first level whose canvas is as large for all views: 514 pixels."""


def fill_any_size(
    rgb: Float[Tensor, "channel height width"],
    missing: Bool[Tensor, "height width"],
    subject: Bool[Tensor, "height width"],
) -> Float[Tensor, "channel height width"]:
    """What `coarse_fill.fill` makes of an image, by the same operations whatever is missing."""
    near, _ = from_near(rgb, ~missing, missing)
    wide = missing & spread(~spread(~missing))
    filled, reached = from_near(rgb, ~missing & subject, missing)
    deep = missing & ~reached
    filled = torch.where(deep, pull_push_any_size(filled, ~deep & subject), filled)
    return torch.where(wide, filled, near)


def pull_push_any_size(
    image: Float[Tensor, "channel height width"], known: Bool[Tensor, "height width"]
) -> Float[Tensor, "channel height width"]:
    """What `coarse_fill.pull_push` makes of an image."""
    height, width = known.shape

    def mean(halved: Tensor) -> Tensor:
        colour, weight = halved.split((len(image), 1), 1)
        return torch.cat([colour / weight.clamp_min(1e-6), (weight > 0).to(weight)], 1)

    whole = torch.cat([image * known, known[None].to(image)])
    levels = [level[0] for level in halvings(whole[None], LEVELS, mean, CONSTANT)]
    sides = [(axis, lengths(size, LEVELS + 1)) for axis, size in ((1, height), (2, width))]
    filled = levels[-1][:-1]
    for level in range(LEVELS - 1, -1, -1):
        colour, weight = levels[level][:-1], levels[level][-1:]
        for axis, size in sides:
            filled = _pushed(filled, axis, size[level + 1], size[level], colour.shape[axis])
        filled = torch.where(weight > 0, colour, filled)
    return torch.where(known, image, filled[:, :height, :width])


def _pushed(image: Tensor, axis: int, coarse: Tensor, fine: Tensor, length: int) -> Tensor:
    """An image of `coarse` pixels along an axis, interpolated to `fine` of them, in a canvas of this length."""
    at = ((torch.arange(length) + 0.5) * (coarse / fine) - 0.5).clamp_min(0)
    first = torch.minimum(at.long(), coarse - 1)
    share = (at - first).clamp(0, 1).view([-1 if other == axis else 1 for other in range(3)])
    after = torch.minimum(first + 1, coarse - 1)
    return (1 - share) * image.index_select(axis, first) + share * image.index_select(axis, after)
