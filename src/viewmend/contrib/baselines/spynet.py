"""Optical flow by a pyramid of small networks (SPyNet), and the warp that its flows are made for."""

from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.cameras import pixel_centers
from viewmend.geometry.sampling import sample_bilinear

LEVELS = 6
CHANNELS = (8, 32, 64, 32, 16, 2)
"""Channels of one level: both images and the flow so far go in, what the flow lacks comes out."""
MULTIPLE = 2 ** (LEVELS - 1)
"""Sizes that halve at each level."""
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


def warp(
    image: Float[Tensor, "sample channel height width"],
    flow: Float[Tensor, "sample 2 height width"],
    padding: Literal["zeros", "border"] = "zeros",
) -> Float[Tensor, "sample channel height width"]:
    """What `image` shows at x + flow(x): bilinear, flow in pixels as (right, down).

    `padding` is what lies outside: "zeros", or "border" for the nearest edge pixel.
    """
    height, width = image.shape[-2:]
    # Positions of a hundred pixels need more digits than half precision has.
    with torch.autocast(image.device.type, enabled=False):
        at = pixel_centers(width, height, flow.device) + flow.float().movedim(1, -1)
        read = sample_bilinear(image.float(), at.flatten(1, 2), padding)
    return read.movedim(-1, 1).unflatten(2, (height, width)).to(image.dtype)


class SPyNet(nn.Module):
    """Flow from each image to another, refined from 1/32 of the size to the whole; 1,440,300 parameters."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.basic_module = nn.ModuleList(_Level() for _ in range(LEVELS))
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1))

    def forward(
        self, images: Float[Tensor, "sample 3 height width"], others: Float[Tensor, "sample 3 height width"]
    ) -> Float[Tensor, "sample 2 height width"]:
        """Flow in pixels, (right, down): `warp(others, flow)` looks like `images`. RGB in [0, 1], any size."""
        height, width = images.shape[-2:]
        size = tuple(-(-side // MULTIPLE) * MULTIPLE for side in (height, width))
        flow = self._refine(_resize(images, size), _resize(others, size))
        scale = flow.new_tensor([width / size[1], height / size[0]]).view(2, 1, 1)
        return _resize(flow, (height, width)) * scale

    def _refine(
        self, images: Float[Tensor, "sample 3 height width"], others: Float[Tensor, "sample 3 height width"]
    ) -> Float[Tensor, "sample 2 height width"]:
        """The flow of images whose sides are multiples of 32."""
        pairs = [((images - self.mean) / self.std, (others - self.mean) / self.std)]
        for _ in range(LEVELS - 1):
            image, other = pairs[-1]
            pairs.append((F.avg_pool2d(image, 2), F.avg_pool2d(other, 2)))
        flow = images.new_zeros(len(images), 2, *pairs[-1][0].shape[-2:])
        for level, (image, other) in zip(self.basic_module, reversed(pairs), strict=True):
            if flow.shape[-1] != image.shape[-1]:
                flow = 2 * F.interpolate(flow, scale_factor=2, mode="bilinear", align_corners=True)
            flow = flow + level(torch.cat([image, warp(other, flow, "border"), flow], 1))
        return flow


class _Level(nn.Module):
    """Five convolutions of 7 x 7; the nesting is that of the published checkpoints' names."""

    def __init__(self) -> None:
        super().__init__()
        self.basic_module = nn.ModuleList(
            nn.ModuleDict({"conv": nn.Conv2d(a, b, 7, padding=3)}) for a, b in pairwise(CHANNELS)
        )

    def forward(self, x: Float[Tensor, "sample 8 height width"]) -> Float[Tensor, "sample 2 height width"]:
        for number, step in enumerate(self.basic_module):
            assert isinstance(step, nn.ModuleDict)
            x = step["conv"](x.relu() if number else x)
        return x


def _resize(images: Float[Tensor, "sample channel _h _w"], size: tuple[int, ...]) -> Float[Tensor, "..."]:
    return F.interpolate(images, size=size, mode="bilinear", align_corners=False)
