"""PSNR, SSIM and mask overlap of images in [0, 1], whole or over some of their pixels.

One contract: a metric over no pixels is None (not a number that could be averaged), and higher is better.
"""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

SsimWindow = Literal["gaussian", "uniform7"]
"""Wang et al.'s Gaussian (11 x 11, sigma 1.5), or means over 7 x 7 pixels (scikit-image's default)."""
SSIM_SIZE_PX: dict[str, int] = {"gaussian": 11, "uniform7": 7}
SSIM_SIGMA_PX = 1.5
MAX_PSNR_DB = 100.0
"""What equal pixels score, so that means stay finite."""


def psnr(
    image: Float[Tensor, "channel height width"],
    truth: Float[Tensor, "channel height width"],
    pixels: Bool[Tensor, "height width"] | None = None,
) -> float | None:
    """Peak signal to noise ratio in dB over all pixels, or over `pixels` alone (the paper's PSNR in the holes).

    The squared error is averaged over pixels and channels, the peak is 1. Equal pixels give `MAX_PSNR_DB`, no pixels
    None, and a colour that is not a number gives NaN.
    """
    squared = (image - truth).double().square().mean(0)
    chosen = squared if pixels is None else squared[pixels]
    if not chosen.numel():
        return None
    error = float(chosen.mean())
    return error if math.isnan(error) else min(MAX_PSNR_DB, -10 * math.log10(max(error, 1e-30)))


def ssim_map(
    image: Float[Tensor, "channel height width"],
    truth: Float[Tensor, "channel height width"],
    window: SsimWindow = "gaussian",
) -> Float[Tensor, "inner_height inner_width"] | None:
    """The similarity of each window that lies in the image, mean of the channels; None where the image is smaller.

    The first is centred half a window (5 or 3 pixels) from the top and from the left. As published, the Gaussian
    window takes the variances of the population, the uniform one (scikit-image's) those of a sample.
    """
    size = SSIM_SIZE_PX[window]
    if min(image.shape[1:]) < size:
        return None
    x, y = image.double(), truth.double()
    mean_x, mean_y, square_x, square_y, product = _windowed(torch.cat([x, y, x * x, y * y, x * y]), window).chunk(5)
    sample = 1.0 if window == "gaussian" else size**2 / (size**2 - 1)
    variance_x = sample * (square_x - mean_x**2)
    variance_y = sample * (square_y - mean_y**2)
    covariance = sample * (product - mean_x * mean_y)
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return (similarity / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))).mean(0)


def mask_iou(a: Bool[Tensor, "height width"], b: Bool[Tensor, "height width"]) -> float | None:
    """Pixels in both masks as a share of those in either; None where both are empty."""
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else None


def _windowed(
    image: Float[Tensor, "channel height width"], window: SsimWindow
) -> Float[Tensor, "channel inner_height inner_width"]:
    """Means over the windows that lie in the image."""
    size = SSIM_SIZE_PX[window]
    offset = torch.arange(size, device=image.device, dtype=image.dtype) - size // 2
    kernel = torch.exp(-0.5 * (offset / SSIM_SIGMA_PX) ** 2) if window == "gaussian" else torch.ones_like(offset)
    kernel = kernel / kernel.sum()
    across, down = (kernel.view(shape).expand(len(image), 1, -1, -1) for shape in ((1, 1, 1, -1), (1, 1, -1, 1)))
    return F.conv2d(F.conv2d(image[None], across, groups=len(image)), down, groups=len(image))[0]
