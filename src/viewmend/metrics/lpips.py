"""LPIPS (Zhang et al. 2018), version 0.1: distance between two images in the features of a network. Lower is better.

Keys of the networks are those of torchvision's `alexnet` and `vgg16`, and of the `lpips` package's own small files.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import interpolate

from viewmend.metrics.weights import checked_weights, known_weights
from viewmend.utils.weight_files import load_weights

Backbone = Literal["alex", "vgg"]
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""ImageNet's mean and deviation of RGB in [0, 1]; equivalent to LPIPS' shift and scale of [-1, 1]."""
TAPS: dict[Backbone, tuple[int, ...]] = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
"""The ReLUs whose features are compared."""
CHANNELS: dict[Backbone, tuple[int, ...]] = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}
MIN_PX: dict[Backbone, int] = {"alex": 63, "vgg": 16}
"""Smaller images have no features in the last layer."""
FILES: dict[Backbone, tuple[str, str]] = {"alex": ("alexnet", "lpips-alex"), "vgg": ("vgg16", "lpips-vgg")}


class Features(nn.Module):
    """The convolutions of AlexNet or VGG16."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.taps = TAPS[backbone]
        self.features = _alexnet() if backbone == "alex" else _vgg16()

    def forward(self, rgb: Float[Tensor, "image 3 height width"]) -> list[Float[Tensor, "image _channel _rows _cols"]]:
        """Features of images in [0, 1], normalised to length 1 over channels."""
        mean, deviation = rgb.new_tensor((MEAN, DEVIATION))[:, :, None, None]
        x, found = (rgb - mean) / deviation, []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in self.taps:
                found.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return found


class Heads(nn.Module):
    """The weight of each channel; named as in the published files."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        for number, channels in enumerate(CHANNELS[backbone]):
            head = nn.Module()
            head.model = nn.Sequential(nn.Dropout(), nn.Conv2d(channels, 1, 1, bias=False))
            self.add_module(f"lin{number}", head)


class Lpips(nn.Module):
    """LPIPS as a map; `load_lpips` makes one with the published weights."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone: Backbone = backbone
        self.network, self.heads = Features(backbone), Heads(backbone)

    @torch.no_grad()
    def forward(
        self, image: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"]
    ) -> Float[Tensor, "height width"] | None:
        """The distance around each pixel of images in [0, 1]; None for images that are too small.

        Its mean is LPIPS as published to within 1e-5; the layers' maps are resampled before they are averaged.
        """
        layers = self.layers(image, truth)
        if layers is None:
            return None
        size = image.shape[1:]
        return torch.stack([interpolate(x[None, None], size, mode="bilinear")[0, 0] for x in layers]).sum(0)

    def layers(
        self, image: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"]
    ) -> list[Float[Tensor, "_rows _cols"]] | None:
        """The distance map of each layer; the sum of their means is LPIPS as published."""
        if min(image.shape[1:]) < MIN_PX[self.backbone]:
            return None
        pairs = self.network(torch.stack([image, truth]).float())
        weights = self.heads.state_dict().values()
        return [(weight[0] * (x[0] - x[1]).square()).sum(0) for x, weight in zip(pairs, weights, strict=True)]


def load_lpips(backbone: Backbone, device: torch.device | str = "cpu") -> Lpips:
    """LPIPS with the published weights.

    Raises:
        MissingWeightsError: one of its two files is not installed.
        WeightsError: a file is damaged or a different one.
    """
    metric = Lpips(backbone)
    layers, heads = (checked_weights(known_weights(name)) for name in FILES[backbone])
    load_weights(metric.network, layers, spare=("classifier.",))
    load_weights(metric.heads, heads)
    return metric.to(device).requires_grad_(False)


def _alexnet() -> nn.Sequential:
    layers: list[nn.Module] = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    layers += [nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    for before, after in ((192, 384), (384, 256), (256, 256)):
        layers += [nn.Conv2d(before, after, 3, 1, 1), nn.ReLU()]
    return nn.Sequential(*layers)


def _vgg16() -> nn.Sequential:
    """The convolutional part of VGG16 (Simonyan & Zisserman 2015), with torchvision's layer numbers."""
    layers: list[nn.Module] = []
    before = 3
    for block, channels in enumerate(CHANNELS["vgg"]):
        layers += [nn.MaxPool2d(2)] if block else []
        for _ in range(2 if block < 2 else 3):
            layers += [nn.Conv2d(before, channels, 3, 1, 1), nn.ReLU()]
            before = channels
    return nn.Sequential(*layers)
