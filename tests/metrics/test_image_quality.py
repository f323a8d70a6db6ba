"""Against scikit-image, and against arithmetic."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from viewmend.metrics.image_quality import MAX_PSNR_DB, mask_iou, psnr, ssim


@pytest.fixture
def pair(rng):
    truth = torch.nn.functional.avg_pool2d(torch.rand(1, 3, 44, 52, generator=rng), 5, 1)[0]
    return (truth + 0.1 * torch.randn(truth.shape, generator=rng)).clamp(0, 1), truth


def test_psnr_is_scikit_images(pair):
    image, truth = pair
    expected = peak_signal_noise_ratio(truth.double().numpy(), image.double().numpy(), data_range=1)
    assert psnr(image, truth) == pytest.approx(expected, abs=1e-9)


def test_psnr_over_pixels_ignores_all_others(pair):
    image, truth = pair
    pixels = torch.zeros(image.shape[1:], dtype=torch.bool)
    pixels[4:9, 7:20] = True
    image = torch.where(pixels, truth + 0.2, image)
    assert psnr(image, truth, pixels) == pytest.approx(-20 * math.log10(0.2), abs=1e-4)
    assert psnr(image, truth, ~pixels) > 19


def test_psnr_of_equal_images_is_finite(pair):
    assert psnr(pair[1], pair[1]) == MAX_PSNR_DB


def test_ssim_is_scikit_images(pair):
    image, truth = (t.double().numpy() for t in pair)
    # scikit-image pads, then cuts the border off again: the same places as ours.
    expected = structural_similarity(
        image, truth, channel_axis=0, data_range=1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert ssim(*pair) == pytest.approx(float(expected), abs=1e-9)


def test_ssim_over_pixels_is_that_of_blackened_images(pair):
    image, truth = pair
    pixels = torch.zeros(image.shape[1:], dtype=torch.bool)
    pixels[10:30, 10:30] = True
    worse = torch.where(pixels, image, 1 - truth)
    black = (np.where(pixels.numpy(), t.double().numpy(), 0) for t in (image, truth))
    expected = structural_similarity(
        *black, channel_axis=0, data_range=1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert ssim(worse, truth, pixels) == pytest.approx(float(expected), abs=1e-9)


def test_no_pixels_give_none(pair):
    none = torch.zeros(pair[0].shape[1:], dtype=torch.bool)
    assert psnr(*pair, none) is None
    assert ssim(*pair, none) is None
    assert ssim(pair[0][:, :10], pair[1][:, :10]) is None
    assert mask_iou(none, none) is None


def test_mask_iou_counts_pixels():
    a, b = torch.zeros(2, 10, 10, dtype=torch.bool)
    a[:, :6] = True
    b[:, 4:] = True
    assert mask_iou(a, b) == pytest.approx(0.2)
    assert mask_iou(a, a) == 1
    assert math.isclose(mask_iou(a, ~a) or 0, 0)
