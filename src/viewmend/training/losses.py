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
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Sum of |predicted - truth| over the weighted pixels (mean of the channels), and the sum of the weights."""
    return (weight * (predicted - truth).abs().mean(0)).sum(), weight.sum()


def image_loss(
    predicted: list[Float[Tensor, "3 _h _w"]],
    coverage: list[Float[Tensor, "_h _w"]],
    error: list[Float[Tensor, "_h _w"]],
    truth: list[Float[Tensor, "3 _h _w"]],
) -> ImageLoss:
    """L_in and L_out over a batch of images of any sizes: sums over all pixels of the batch, then one division.

    L_out counts the pixels that decoded patches cover (section 8). An empty weight gives 0 with a zero gradient.
    """
    sums = [torch.zeros((), device=truth[0].device) for _ in range(4)]
    for image, covered, E, target in zip(predicted, coverage, error, truth, strict=True):
        image = image.float()
        parts = (*weighted_l1(image, target, E), *weighted_l1(image, target, (1 - E) * (covered > 0)))
        sums = [total + part for total, part in zip(sums, parts, strict=True)]
    tiny = torch.finfo(torch.float32).tiny
    return ImageLoss(sums[0] / sums[1].clamp_min(tiny), sums[2] / sums[3].clamp_min(tiny))
