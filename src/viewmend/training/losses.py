"""The objective of section 8: L1 inside and outside the holes, on the network's own image Ftilde."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class ImageLoss:
    """L_in and L_out of section 8; each 0 where it has no pixels."""

    inside: Float[Tensor, ""]
    outside: Float[Tensor, ""]

    @property
    def total(self) -> Float[Tensor, ""]:
        """lambda_img (L_in + L_out) with lambda_img = 1."""
        return self.inside + self.outside


def weighted_l1(
    predicted: Float[Tensor, "3 height width"],
    truth: Float[Tensor, "3 height width"],
    weight: Float[Tensor, "height width"],
) -> Float[Tensor, ""]:
    """|weight * (predicted - truth)|_1 / |weight|_1, the mean of the channels; 0 where the weight is."""
    total = (weight * (predicted - truth).abs().mean(0)).sum()
    return total / weight.sum().clamp_min(torch.finfo(torch.float32).tiny)


def image_loss(
    predicted: list[Float[Tensor, "3 _h _w"]],
    coverage: list[Float[Tensor, "_h _w"]],
    error: list[Float[Tensor, "_h _w"]],
    truth: list[Float[Tensor, "3 _h _w"]],
) -> ImageLoss:
    """L_in and L_out of each image, and their means over a batch of images of any sizes.

    L_out counts the pixels that decoded patches cover (section 8). An empty weight gives 0 with a zero gradient.
    """
    inside, outside = [], []
    for image, covered, E, target in zip(predicted, coverage, error, truth, strict=True):
        inside.append(weighted_l1(image.float(), target, E))
        outside.append(weighted_l1(image.float(), target, (1 - E) * (covered > 0)))
    return ImageLoss(torch.stack(inside).mean(), torch.stack(outside).mean())
