"""Against scikit-image and torchmetrics, and against arithmetic."""

import math

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import peak_signal_noise_ratio as peak_signal_noise_ratio_torch
from torchmetrics.functional.image import structural_similarity_index_measure as structural_similarity_torch

from viewmend.metrics.image_quality import MAX_PSNR_DB, mask_iou, psnr, ssim_map


def ssim(image, truth, window="gaussian"):
    similarity = ssim_map(image, truth, window)
    assert similarity is not None
    return float(similarity.mean())


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


def test_uniform_windows_are_scikit_images(rng):
    truth, noise = torch.rand(2, 3, 70, 80, generator=rng)
    image = (truth + 0.2 * noise).clamp(0, 1)
    expected = structural_similarity(
        image.double().numpy(), truth.double().numpy(), channel_axis=0, data_range=1, win_size=7
    )
    assert ssim(image, truth, window="uniform7") == pytest.approx(float(expected), abs=1e-9)
    assert ssim(image, truth) != pytest.approx(float(expected), abs=1e-4)


def test_psnr_and_ssim_are_torchmetrics(pair):
    image, truth = (t[None].double() for t in pair)
    expected = peak_signal_noise_ratio_torch(image, truth, data_range=1.0)
    assert psnr(*pair) == pytest.approx(float(expected), abs=1e-5)
    # Its window is as wide as sigma 1.5 makes it, 11 pixels; its mean takes in windows over a mirrored border, too.
    _, full = structural_similarity_torch(image, truth, sigma=1.5, data_range=1.0, return_full_image=True)
    seen = ssim_map(*pair)
    assert seen is not None
    torch.testing.assert_close(seen, full[0, :, 5:-5, 5:-5].mean(0), rtol=0, atol=1e-5)
    assert ssim(*pair) == pytest.approx(float(full[0, :, 5:-5, 5:-5].mean()), abs=1e-5)


def test_the_map_is_where_it_says(pair):
    truth = pair[1]
    spoilt = truth.clone()
    spoilt[:, 20, 30] = 1 - spoilt[:, 20, 30]
    for window, half in (("gaussian", 5), ("uniform7", 3)):
        seen = ssim_map(spoilt, truth, window)
        assert seen is not None and seen.shape == (40 - 2 * half, 48 - 2 * half)
        changed = (seen < 1 - 1e-12).nonzero() + half
        assert changed.amin(0).tolist() == [20 - half, 30 - half]
        assert changed.amax(0).tolist() == [20 + half, 30 + half]


def test_no_pixels_give_none(pair):
    none = torch.zeros(pair[0].shape[1:], dtype=torch.bool)
    assert psnr(*pair, none) is None
    assert ssim_map(pair[0][:, :10], pair[1][:, :10]) is None
    assert mask_iou(none, none) is None


def test_mask_iou_counts_pixels():
    a, b = torch.zeros(2, 10, 10, dtype=torch.bool)
    a[:, :6] = True
    b[:, 4:] = True
    assert mask_iou(a, b) == pytest.approx(0.2)
    assert mask_iou(a, a) == 1
    assert math.isclose(mask_iou(a, ~a) or 0, 0)


def test_what_is_not_a_number_scores_nothing(pair):
    image, truth = pair
    image[0, 3, 4] = math.nan
    assert math.isnan(psnr(image, truth))
    assert psnr(image, truth, ~image.isnan().any(0)) > 10, "where it is not looked at it does no harm"
    assert psnr(torch.full_like(truth, math.inf), truth) == -math.inf
