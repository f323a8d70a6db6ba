"""The objective of section 8: L1 inside and outside the holes, on the network's own image Ftilde; and PSNR, ours."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

LEAST_SQUARE = 1e-4
"""Squared error below which nothing is gained: 40 dB."""
WIDE_PX = 9
"""Side of the square that fits into a wide hole."""


@dataclass(frozen=True)
class ImageLoss:
    """L_in and L_out of section 8, each 0 where it has no pixels, and the logarithmic error in the holes."""

    inside: Float[Tensor, ""]
    outside: Float[Tensor, ""]
    log_error: Float[Tensor, ""]
    """log10 of the mean squared error in the holes, a tenth of -PSNR. Ours: where nobody can know whether a pixel is
    subject or background, L1 decides for one of them, squares hedge."""


def slivers(error: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Pixels of E that no square of `WIDE_PX` pixels of E holds; beyond the image all counts as E."""
    missing = (error > 0).float()[None]
    fits = -F.max_pool2d(-missing, WIDE_PX, 1, WIDE_PX // 2)
    return (missing[0] > 0) & (F.max_pool2d(fits, WIDE_PX, 1, WIDE_PX // 2)[0] == 0)


def weighted_l1(
    predicted: Float[Tensor, "3 height width"],
    truth: Float[Tensor, "3 height width"],
    weight: Float[Tensor, "height width"],
    channels: Literal["mean", "sum"] = "mean",
) -> Float[Tensor, ""]:
    """|weight * (predicted - truth)|_1 / |weight|_1, the mean or sum of the channels; 0 where the weight is."""
    away = (predicted - truth).abs()
    total = (weight * (away.sum(0) if channels == "sum" else away.mean(0))).sum()
    return total / weight.sum().clamp_min(torch.finfo(torch.float32).tiny)


def image_loss(
    predicted: list[Float[Tensor, "3 _h _w"]],
    coverage: list[Float[Tensor, "_h _w"]],
    error: list[Float[Tensor, "_h _w"]],
    truth: list[Float[Tensor, "3 _h _w"]],
    channels: Literal["mean", "sum"] = "mean",
) -> ImageLoss:
    """The losses of each image, and their means over a batch of images of any sizes.

    An empty weight gives 0 with a zero gradient.

    Args:
        predicted: Ftilde.
        coverage: the pixels that L_out counts: those that decoded patches cover, or all.
        error: E.
        truth: F*, upon the background that Ftilde is upon.
        channels: whether L_in and L_out take their mean or, as the paper, their sum.
    """
    losses = []
    for image, covered, E, target in zip(predicted, coverage, error, truth, strict=True):
        inside = weighted_l1(image.float(), target, E, channels)
        outside = weighted_l1(image.float(), target, (1 - E) * (covered > 0), channels)
        squares = (E * (image.float() - target).square().mean(0)).sum() / E.sum().clamp_min(1e-6)
        losses.append(ImageLoss(inside, outside, (squares + LEAST_SQUARE).log10()))
    return mean_loss(losses)


def pixel_loss(predicted: Float[Tensor, "pixel 3"], truth: Float[Tensor, "pixel 3"]) -> ImageLoss:
    """The losses of an image of which only these pixels, all missing, are looked at; 0 where there are none."""
    if not len(truth):
        zero = predicted.sum()
        return ImageLoss(zero, zero, zero)
    squares = (predicted - truth).square().mean()
    return ImageLoss((predicted - truth).abs().mean(), torch.zeros_like(squares), (squares + LEAST_SQUARE).log10())


def mean_loss(losses: Sequence[ImageLoss]) -> ImageLoss:
    """The mean of each term."""
    terms = zip(*((loss.inside, loss.outside, loss.log_error) for loss in losses), strict=True)
    return ImageLoss(*(torch.stack(term).mean() for term in terms))
