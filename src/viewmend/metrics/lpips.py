"""LPIPS (Zhang et al. 2018), version 0.1: distance between two images in the features of a network. Lower is better.

AlexNet's weights ship with the package; `viewmend weights get lpips-vgg` installs VGG16's.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import interpolate

from viewmend.metrics.weights import checked_weights, known_weights
from viewmend.utils.weight_files import construct, load_weights

Backbone = Literal["alex", "vgg"]
MEAN = (0.485, 0.456, 0.406)
"""ImageNet's mean of RGB in [0, 1]; equivalent to LPIPS' shift of [-1, 1]."""
DEVIATION = (0.229, 0.224, 0.225)
"""ImageNet's standard deviation of RGB in [0, 1]; equivalent to LPIPS' scale of [-1, 1]."""
TAPS: dict[Backbone, tuple[int, ...]] = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
"""The ReLUs whose features are compared."""
CHANNELS: dict[Backbone, tuple[int, ...]] = {
    "alex": (64, 192, 384, 256, 256),
    "vgg": (64, 128, 256, 512, 512),
}
MIN_PX: dict[Backbone, int] = {"alex": 63, "vgg": 16}
"""Smaller images have no features in the last layer."""


class Lpips(nn.Module):
    """LPIPS as a number for each pair of images, or as a map; `load_lpips` makes one with the published weights."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone: Backbone = backbone
        self.features = _alexnet() if backbone == "alex" else _vgg16()
        self.heads = nn.ParameterList(torch.zeros(channels) for channels in CHANNELS[backbone])

    def forward(
        self, image: Float[Tensor, "image 3 height width"], truth: Float[Tensor, "image 3 height width"]
    ) -> Float[Tensor, "image"]:
        """The distance of each pair of images in [0, 1], as published; differentiable, in float32.

        Raises:
            ValueError: the images are smaller than `MIN_PX`.
        """
        if min(image.shape[2:]) < MIN_PX[self.backbone]:
            raise ValueError(
                f"expected images of at least {MIN_PX[self.backbone]} pixels a side for LPIPS ({self.backbone}), got "
                f"{image.shape[3]} x {image.shape[2]}; use larger crops"
            )
        return torch.stack([layer.mean((1, 2)) for layer in self._layers(image, truth)]).sum(0)

    @torch.no_grad()
    def map(
        self, image: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"]
    ) -> Float[Tensor, "height width"] | None:
        """The distance around each pixel of images in [0, 1]; None for images that are too small.

        Each layer's map is enlarged bilinearly and scaled so that the mean is the published number.
        """
        if min(image.shape[1:]) < MIN_PX[self.backbone]:
            return None
        total = image.new_zeros(image.shape[1:], dtype=torch.float32)
        for layer in self._layers(image[None], truth[None]):
            enlarged = interpolate(layer[None], total.shape, mode="bilinear")[0, 0]
            total += enlarged * (layer.mean() / enlarged.mean().clamp_min(1e-30))
        return total

    def _layers(self, image: Tensor, truth: Tensor) -> list[Float[Tensor, "image _rows _columns"]]:
        """The distance map of each layer."""
        with torch.autocast(image.device.type, enabled=False):
            x = torch.cat([image, truth]).float()
            mean, deviation = x.new_tensor((MEAN, DEVIATION))[:, :, None, None]
            x = (x - mean) / deviation
            found = []
            for index, layer in enumerate(self.features):
                x = layer(x)
                if index in TAPS[self.backbone]:
                    # The small number keeps the gradient finite at 0
                    unit = x / (x.square().sum(1, keepdim=True) + 1e-20).sqrt()
                    a, b = unit.chunk(2)
                    found.append(torch.einsum("c,nchw->nhw", self.heads[len(found)], (a - b).square()))
            return found


def load_lpips(backbone: Backbone = "alex", device: torch.device | str = "cpu") -> Lpips:
    """LPIPS with the published weights, frozen: a metric, or a part of a training loss.

    Raises:
        MissingWeightsError: the weights of VGG16 are not installed.
        WeightsError: the file is damaged or a different one.

    Examples:
        >>> import torch
        >>> from viewmend.metrics.lpips import load_lpips
        >>> distance = load_lpips("alex")
        >>> distance(torch.zeros(2, 3, 64, 64), torch.zeros(2, 3, 64, 64)).tolist()
        [0.0, 0.0]
    """
    path = checked_weights(known_weights(f"lpips-{backbone}"))
    network = load_weights(construct(Lpips, backbone), path, device).requires_grad_(False)
    # A fifth faster on CPUs.
    return network.to(memory_format=torch.channels_last)  # pyrefly: ignore[no-matching-overload]


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
