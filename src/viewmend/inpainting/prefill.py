"""A first guess for the holes: the surroundings' colours, pulled down a pyramid and pushed back up. Ours."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F


def pull_push(
    rgb: Float[Tensor, "channel height width"], known: Bool[Tensor, "height width"]
) -> Float[Tensor, "channel height width"]:
    """The image with every unknown pixel filled smoothly from the known ones; known pixels bit for bit.

    Pull: means of the known pixels at halved resolutions, until one pixel is left. Push: unknown pixels take the
    coarser level's colour, interpolated. Without any known pixel the fill is 0.
    """
    weight = known.to(rgb)[None, None]
    levels = [(rgb[None] * weight, weight)]
    while max(levels[-1][0].shape[2:]) > 1:
        colour, weight = (F.avg_pool2d(x, 2, ceil_mode=True, count_include_pad=False) for x in levels[-1])
        levels.append((colour / weight.clamp_min(1e-6), weight.clamp_max(1)))
        # A coarse pixel with any known one counts in full from here on.
        levels[-1] = (levels[-1][0] * (weight > 0), (weight > 0).to(rgb))
    filled = levels[-1][0]
    for colour, weight in reversed(levels[:-1]):
        coarse = F.interpolate(filled, size=colour.shape[2:], mode="bilinear", align_corners=False)
        filled = torch.where(weight > 0, colour, coarse)
    return torch.where(known, rgb, filled[0])
