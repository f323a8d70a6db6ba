"""Metrics against scikit-image, torchmetrics and arithmetic."""

import math

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure

from viewmend.metrics.image_quality import MAX_PSNR_DB, change, mask_iou, psnr, ssim_map


@pytest.fixture
def pair(rng):
    truth = torch.nn.functional.avg_pool2d(torch.rand(1, 3, 44, 52, generator=rng), 5, 1)[0]
    return (truth + 0.1 * torch.randn(truth.shape, generator=rng)).clamp(0, 1), truth


def test_psnr_matches_scikit_image(pair):
    image, truth = pair
    expected = peak_signal_noise_ratio(truth.double().numpy(), image.double().numpy(), data_range=1)
    assert psnr(image, truth) == pytest.approx(expected, abs=1e-9)
    assert psnr(truth, truth) == MAX_PSNR_DB


def test_psnr_over_pixels_ignores_all_others(pair):
    image, truth = pair
    pixels = torch.zeros(image.shape[1:], dtype=torch.bool)
    pixels[4:9, 7:20] = True
    image = torch.where(pixels, truth + 0.2, image)
    assert psnr(image, truth, pixels) == pytest.approx(-20 * math.log10(0.2), abs=1e-4)
    assert psnr(image, truth, ~pixels) > 19


def test_colours_that_are_not_finite_are_not_hidden(pair):
    image, truth = pair
    image[0, 3, 4] = math.nan
    assert math.isnan(psnr(image, truth))
    assert psnr(image, truth, ~image.isnan().any(0)) > 10
    assert psnr(torch.full_like(truth, math.inf), truth) == -math.inf


@pytest.mark.parametrize(
    ("window", "options"),
    [
        ("gaussian", {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}),
        ("uniform7", {}),
    ],
)
def test_ssim_matches_scikit_image(pair, window, options):
    image, truth = (t.double().numpy() for t in pair)
    win_size = 7 if window == "uniform7" else None
    expected = structural_similarity(image, truth, channel_axis=0, data_range=1, win_size=win_size, **options)
    assert float(ssim_map(*pair, window).nanmean()) == pytest.approx(float(expected), abs=1e-9)


def test_the_ssim_map_matches_torchmetrics(pair):
    image, truth = (t[None].double() for t in pair)
    # torchmetrics also returns windows over a mirrored border.
    _, full = structural_similarity_index_measure(
        image, truth, sigma=1.5, data_range=1.0, return_full_image=True
    )
    own = ssim_map(*pair)
    torch.testing.assert_close(own[5:-5, 5:-5], full[0, :, 5:-5, 5:-5].mean(0), rtol=0, atol=1e-5)
    assert int(own.isfinite().sum()) == 30 * 38, "windows inside the image"


@pytest.mark.parametrize("window", ["gaussian", "uniform7"])
@pytest.mark.parametrize("changed", [(0, 1, 0, 1), (36, 40, 42, 48), (0, 40, 0, 48), (5, 20, 30, 31)])
def test_ssim_computed_where_images_differ_is_complete(pair, window, changed):
    truth = pair[1]
    top, bottom, left, right = changed
    image = truth.clone()
    image[:, top:bottom, left:right] = 0.3
    faint = image + 1e-12 * torch.ones_like(image, dtype=torch.double)  # differs everywhere
    torch.testing.assert_close(
        ssim_map(image, truth, window), ssim_map(faint, truth, window), rtol=0, atol=1e-9, equal_nan=True
    )


def test_no_pixels_give_none(pair):
    none = torch.zeros(pair[0].shape[1:], dtype=torch.bool)
    assert psnr(*pair, none) is None
    assert ssim_map(pair[0][:, :10], pair[1][:, :10]) is None
    assert mask_iou(none, none) is None


def test_changes_up_and_down_do_not_cancel():
    previous = torch.full((3, 4, 4), 0.5)
    image = previous.clone()
    image[:, :2] += 0.1
    image[:, 2:] -= 0.1
    pixels = torch.zeros(4, 4, dtype=torch.bool)
    pixels[1:3] = True
    assert change(image, previous, pixels, min_px=8) == pytest.approx(0.1)
    assert change(image, previous, pixels, min_px=9) is None


def test_mask_iou_counts_pixels():
    a, b = torch.zeros(2, 10, 10, dtype=torch.bool)
    a[:, :6] = True
    b[:, 4:] = True
    assert (mask_iou(a, b), mask_iou(a, a), mask_iou(a, ~a)) == (pytest.approx(0.2), 1, 0)
