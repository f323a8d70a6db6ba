"""Convolutions at four scales (U-Net, Ronneberger et al., MICCAI 2015)."""

from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.inpainting.sweep.cells import scattered

WIDER = 16
"""More channels at each coarser scale."""


class UNet(nn.Module):
    """Down three times by strides, and up again; scales are added, so that a coarse one need not repeat a fine one."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        widths = tuple(width + WIDER * scale for scale in range(4))
        self.enter = nn.Conv2d(channels, width, 1)
        self.first = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, width, 3, padding=1)
        )
        self.down = nn.ModuleList(_halving(fine, coarse) for fine, coarse in pairwise(widths))
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairwise(widths))
        self.join = nn.ModuleList(nn.Conv2d(fine, fine, 3, padding=1) for fine in widths[:-1])

    def forward(self, image: Float[Tensor, "1 channel height width"]) -> Float[Tensor, "1 feature height width"]:
        """Features of the same resolution."""
        return self.across(F.relu(self.enter(image.contiguous(memory_format=torch.channels_last))))

    def of_points(
        self,
        values: Float[Tensor, "point first_channel"],
        at: Int[Tensor, "point 2"],
        image: Float[Tensor, "1 other_channel height width"],
    ) -> Float[Tensor, "1 feature height width"]:
        """What `forward` makes of an image whose first channels are these values at rows and columns, zeros elsewhere.

        The first layer looks at single pixels: where there is no point, it has less to do.
        """
        own, weight = values.shape[1], self.enter.weight
        x = F.conv2d(image.contiguous(memory_format=torch.channels_last), weight[:, own:], self.enter.bias)
        told = F.linear(values, weight[:, :own, 0, 0]).to(x.dtype)
        return self.across(F.relu(x + scattered(told, at, image.shape[2:])))

    def across(self, x: Float[Tensor, "1 feature height width"]) -> Float[Tensor, "1 feature height width"]:
        """All but the first layer."""
        scales = [F.relu(x + self.first(x))]
        for layer in self.down:
            scales.append(layer(scales[-1]))
        x = scales.pop()
        for scale, up, join in reversed(list(zip(scales, self.up, self.join, strict=True))):
            coarse = F.interpolate(up(x), size=scale.shape[2:], mode="bilinear", align_corners=False)
            x = F.relu(scale + join(F.relu(coarse + scale)))
        return x


def _halving(fine: int, coarse: int) -> nn.Sequential:
    return nn.Sequential(
        *(nn.Conv2d(fine, coarse, 3, stride=2, padding=1), nn.ReLU()),
        *(nn.Conv2d(coarse, coarse, 3, padding=1), nn.ReLU()),
    )
