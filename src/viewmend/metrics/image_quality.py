"""PSNR, SSIM and mask overlap of images in [0, 1], whole or over some of their pixels.

One contract: a metric over no pixels is None (not a number that could be averaged), and higher is better.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

SSIM_SIGMA_PX = 1.5
SSIM_REACH_PX = 5
"""The Gaussian window of Wang et al. 2004: 11 x 11 pixels."""
MAX_PSNR_DB = 100.0
"""What equal pixels score, so that means stay finite."""


def psnr(
    image: Float[Tensor, "channel height width"],
    truth: Float[Tensor, "channel height width"],
    pixels: Bool[Tensor, "height width"] | None = None,
) -> float | None:
    """Peak signal to noise ratio in dB over all pixels, or over `pixels` alone (the paper's PSNR in the holes).

    The squared error is averaged over pixels and channels, the peak is 1. Equal pixels give `MAX_PSNR_DB`, no pixels
    None.
    """
    squared = (image - truth).double().square().mean(0)
    chosen = squared if pixels is None else squared[pixels]
    if not chosen.numel():
        return None
    return min(MAX_PSNR_DB, -10 * math.log10(max(float(chosen.mean()), 1e-30)))


def ssim(
    image: Float[Tensor, "channel height width"],
    truth: Float[Tensor, "channel height width"],
    pixels: Bool[Tensor, "height width"] | None = None,
) -> float | None:
    """Structural similarity (Wang et al. 2004), in [-1, 1]: Gaussian window of sigma 1.5, the mean of the channels.

    As published, only places whose window lies in the image count, and the variances are those of the population.
    With `pixels` both images are blackened outside them first, then compared as a whole: the paper's SSIM in the holes.
    No pixels, or an image smaller than the window, give None.
    """
    if pixels is not None:
        if not bool(pixels.any()):
            return None
        image, truth = image * pixels, truth * pixels
    if min(image.shape[1:]) < 2 * SSIM_REACH_PX + 1:
        return None
    x, y = image.double(), truth.double()
    mean_x, mean_y = _windowed(x), _windowed(y)
    variance_x = _windowed(x * x) - mean_x**2
    variance_y = _windowed(y * y) - mean_y**2
    covariance = _windowed(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity /= (mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)
    return float(similarity.mean())


def mask_iou(a: Bool[Tensor, "height width"], b: Bool[Tensor, "height width"]) -> float | None:
    """Pixels in both masks as a share of those in either; None where both are empty."""
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else None


def _windowed(image: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel inner_height inner_width"]:
    """Gaussian means of the windows that lie in the image."""
    offset = torch.arange(-SSIM_REACH_PX, SSIM_REACH_PX + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (offset / SSIM_SIGMA_PX) ** 2)
    kernel = kernel / kernel.sum()
    rows = torch.nn.functional.conv2d(image[:, None], kernel.view(1, 1, 1, -1))
    return torch.nn.functional.conv2d(rows, kernel.view(1, 1, -1, 1))[:, 0]
