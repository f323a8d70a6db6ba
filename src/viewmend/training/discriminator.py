"""Patch discriminators for the adversarial term of section 8: one for an image, one for a clip of T frames.

Which network judges is ours, the paper does not say. Both are T-PatchGAN's (Chang et al. 2019), the image's without the
time axis: convolutions that halve height and width, spectrally normalised (Miyato et al. 2018), and a plain last one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import parametrize
from torch.nn.utils.parametrizations import spectral_norm

SLOPE = 0.2
"""Slope of the LeakyReLU between the convolutions."""
SHORTEST_PX = 3
"""The first convolution of a clip is padded by 1 alone: nothing is left of fewer pixels."""


@dataclass(frozen=True, kw_only=True)
class DiscriminatorConfig:
    """Which discriminator, and how large."""

    kind: Literal["image", "clip"] = "image"
    """Judge each view alone, or several consecutive frames of it together."""
    width: int = 32
    """Channels after the first convolution; they double twice."""
    layers: int = 4
    """Convolutions, each with half the height and width: a logit sees 61 pixels across with 4, 253 with 6."""

    def __post_init__(self) -> None:
        if self.width < 1 or self.layers < 2:
            raise ValueError(
                f"expected a width of at least 1 and at least 2 layers, got {self.width} and {self.layers}; "
                "T-PatchGAN has 32 and 6"
            )

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of the input and after each convolution."""
        return (3, *(self.width * 2 ** min(layer, 2) for layer in range(self.layers)))


class Discriminator(nn.Module):
    """Convolutions from images in [0, 1] to a map of logits; there is nothing in it that mixes images of a batch.

    An image has 5 x 5 kernels of stride 2. A clip is T-PatchGAN's: 3 x 5 x 5 kernels, stride 1 in time.
    """

    def __init__(self, config: DiscriminatorConfig) -> None:
        super().__init__()
        C, last = config.channels, config.layers - 1
        if config.kind == "image":
            layers = [nn.Conv2d(C[i], C[i + 1], 5, 2, 2, bias=i == last) for i in range(config.layers)]
        else:
            # The first is padded by 1 in every dimension, as in the published network.
            padding = [(1, 1, 1), *[(1, 2, 2)] * last]
            layers = [
                nn.Conv3d(C[i], C[i + 1], (3, 5, 5), (1, 2, 2), padding[i], bias=i == last)
                for i in range(config.layers)
            ]
        self.convolutions = nn.ModuleList([*(spectral_norm(layer) for layer in layers[:-1]), layers[-1]])

    def forward(self, images: Sequence[Float[Tensor, "3 ... _h _w"]]) -> list[Float[Tensor, "logit ..."]]:
        """Logits of images, or of clips of any number of frames, in [0, 1], of any sizes from 3 x 3.

        Images of one size go through as one batch, which changes nothing but the time. In training mode each call takes
        one step of power iteration: judge real and completed images in one call.

        Raises:
            ValueError: an image is too small.
        """
        if short := [tuple(image.shape) for image in images if min(image.shape[-2:]) < SHORTEST_PX]:
            raise ValueError(
                f"expected images of at least {SHORTEST_PX} x {SHORTEST_PX} pixels, got shapes {short}; leave them out"
            )
        maps: list[Tensor] = [images[0]] * len(images)
        # Weights are normalised once a call, and not under autocast: power iteration wants float32.
        with parametrize.cached():
            with torch.autocast(images[0].device.type, enabled=False):
                [layer.weight for layer in self.convolutions]
            for shape in dict.fromkeys(image.shape for image in images):
                places = [place for place, image in enumerate(images) if image.shape == shape]
                judged = self._convolve(torch.stack([images[place] for place in places]))
                for place, logits in zip(places, judged, strict=True):
                    maps[place] = logits
        return maps

    def _convolve(self, batch: Tensor) -> Tensor:
        x = 2 * batch - 1
        for number, layer in enumerate(self.convolutions):
            x = layer(x if number == 0 else nn.functional.leaky_relu(x, SLOPE))
        return x
