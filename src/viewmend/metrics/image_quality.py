"""PSNR, SSIM, mask overlap and temporal stability of images in [0, 1], over all or some of their pixels.

A metric over no pixels is None, so that it cannot be averaged by mistake.
"""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.sampling import sample_bilinear

SsimWindow = Literal["gaussian", "uniform7"]
"""Gaussian window of Wang et al. (11 x 11 pixels, sigma 1.5), or mean over 7 x 7 pixels
(scikit-image's default)."""
SSIM_SIZE_PX: dict[str, int] = {"gaussian": 11, "uniform7": 7}
SSIM_SIGMA_PX = 1.5
MAX_PSNR_DB = 100.0
"""PSNR of equal images; it keeps means finite."""


def psnr(
    image: Float[Tensor, "channel height width"],
    truth: Float[Tensor, "channel height width"],
    pixels: Bool[Tensor, "height width"] | None = None,
) -> float | None:
    """Peak signal-to-noise ratio in dB over all pixels, or over `pixels` only (the paper's PSNR of inpainted regions).

    The squared error is averaged over pixels and channels; the peak is 1. Returns `MAX_PSNR_DB` for
    equal pixels, None for no pixels, and NaN if a colour is NaN.
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
) -> Float[Tensor, "height width"] | None:
    """SSIM of the window around each pixel, averaged over channels.

    Pixels whose window extends beyond the image are NaN. None if the image is smaller than the
    window. As published, the Gaussian window uses population variances and the uniform one
    (scikit-image) sample variances. Only the part in which the images differ is computed: equal
    windows have an SSIM of exactly 1.
    """
    size = SSIM_SIZE_PX[window]
    height, width = image.shape[1:]
    if min(height, width) < size:
        return None
    found = torch.full((height, width), torch.nan, dtype=torch.float64, device=image.device)
    half = size // 2
    inner = found[half : height - half, half : width - half]
    inner.fill_(1.0)
    differ = (image != truth).any(0)
    if bool(differ.any()):
        rows, columns = (
            _affected_windows(torch.nonzero(differ.any(axis)), length, size)
            for axis, length in ((1, height), (0, width))
        )
        part = _ssim_of_windows(image[:, rows, columns].double(), truth[:, rows, columns].double(), window)
        inner[rows.start : rows.stop - 2 * half, columns.start : columns.stop - 2 * half] = part
    return found


def mask_iou(a: Bool[Tensor, "height width"], b: Bool[Tensor, "height width"]) -> float | None:
    """Intersection over union of two masks; None if both are empty."""
    union = int((a | b).sum())
    return int((a & b).sum()) / union if union else None


def change(
    image: Float[Tensor, "channel height width"],
    previous: Float[Tensor, "channel height width"],
    pixels: Bool[Tensor, "height width"],
    min_px: int = 1,
) -> float | None:
    """Mean absolute difference between an image and the previous one at `pixels`; None for fewer than `min_px`."""
    return float((image - previous)[:, pixels].abs().mean()) if int(pixels.sum()) >= min_px else None


def warp_error(
    image: Float[Tensor, "channel height width"],
    previous: Float[Tensor, "channel height width"],
    backward_flow_px: Float[Tensor, "height width 2"],
    pixels: Bool[Tensor, "height width"],
    min_px: int = 1,
) -> float | None:
    """Mean absolute difference between an image and the previous one warped by the true motion, over `pixels`.

    `backward_flow_px` is the position of each pixel's surface point in the previous image, not
    finite where it was not visible; such pixels are skipped. None if fewer than `min_px` are left.
    Bilinear sampling gives the true images an error above 0, too: compare with theirs.
    """
    counted = pixels & backward_flow_px.isfinite().all(-1)
    if int(counted.sum()) < min_px:
        return None
    warped = sample_bilinear(previous[None], backward_flow_px[counted][None], "border")[0]
    return float((image[:, counted] - warped.T).abs().mean())


def _affected_windows(positions: Tensor, length: int, size: int) -> slice:
    """The range along one axis that is covered by all windows containing one of these positions."""
    start = max(0, int(positions.min()) - size + 1)
    stop = min(length, int(positions.max()) + size)
    return slice(min(start, length - size), max(stop, size))


def _ssim_of_windows(
    x: Float[Tensor, "channel height width"], y: Float[Tensor, "channel height width"], window: SsimWindow
) -> Float[Tensor, "inner_height inner_width"]:
    size = SSIM_SIZE_PX[window]
    mean_x, mean_y, square_x, square_y, product = _windowed(
        torch.cat([x, y, x * x, y * y, x * y]), window
    ).chunk(5)
    sample = 1.0 if window == "gaussian" else size**2 / (size**2 - 1)
    variance_x = sample * (square_x - mean_x**2)
    variance_y = sample * (square_y - mean_y**2)
    covariance = sample * (product - mean_x * mean_y)
    c1 = 0.01**2
    c2 = 0.03**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return (similarity / ((mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2))).mean(0)


def _windowed(
    image: Float[Tensor, "channel height width"], window: SsimWindow
) -> Float[Tensor, "channel inner_height inner_width"]:
    """Weighted means over all windows that lie inside the image."""
    size = SSIM_SIZE_PX[window]
    offset = torch.arange(size, device=image.device, dtype=image.dtype) - size // 2
    kernel = (
        torch.exp(-0.5 * (offset / SSIM_SIGMA_PX) ** 2) if window == "gaussian" else torch.ones_like(offset)
    )
    kernel = kernel / kernel.sum()
    across, down = (
        kernel.view(shape).expand(len(image), 1, -1, -1) for shape in ((1, 1, 1, -1), (1, 1, -1, 1))
    )
    return F.conv2d(F.conv2d(image[None], across, groups=len(image)), down, groups=len(image))[0]
