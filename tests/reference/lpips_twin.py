"""LPIPS written out: one convolution after the other, from the weights' names."""

import torch
from torch.nn import functional as F

ALEX = {0: (4, 2), 3: (1, 2), 6: (1, 1), 8: (1, 1), 10: (1, 1)}
"""Stride and padding of AlexNet's convolutions by their place; pooling follows the first two."""
VGG = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Places of VGG16's convolutions, block by block; pooling follows each block."""


def lpips_twin(image, truth, weights, backbone):
    """The published number for two images in [0, 1]."""
    total = 0.0
    for layer, (a, b) in enumerate(
        zip(*(_features(x, weights, backbone) for x in (image, truth)), strict=True)
    ):
        distance = 0.0
        for channel, head in enumerate(weights[f"heads.{layer}"].tolist()):
            distance += head * float((a[channel] - b[channel]).square().mean())
        total += distance
    return total


def _features(image, weights, backbone):
    # The published scaling of images in [-1, 1].
    shift = torch.tensor([-0.030, -0.088, -0.188]).double()[:, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450]).double()[:, None, None]
    x = (2 * image.double() - 1 - shift) / scale
    layers = []
    for number, block in enumerate([(place,) for place in ALEX] if backbone == "alex" else VGG):
        if backbone == "vgg" and number:
            x = F.max_pool2d(x, 2)
        if backbone == "alex" and number in (1, 2):
            x = F.max_pool2d(x, 3, 2)
        for place in block:
            weight, bias = (weights[f"features.{place}.{kind}"].double() for kind in ("weight", "bias"))
            stride, padding = ALEX[place] if backbone == "alex" else (1, 1)
            x = F.conv2d(x, weight, bias, stride, padding).relu()
        layers.append(x / (x.square().sum(0).sqrt() + 1e-10))
    return layers
