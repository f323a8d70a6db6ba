"""How soft alpha must be on a rig: found again where it is known, and what it does to colours."""

import pytest
import torch

from viewmend.inpainting.sweep.alpha_fit import SLOPES, fitted_slope, recomposed, with_slope


def test_a_slope_of_one_changes_nothing_and_none_changes_what_is_sure_or_even():
    alpha = torch.linspace(0, 1, 101)
    assert (with_slope(alpha, 1.0) - alpha).abs().max() < 2e-4
    softer = with_slope(alpha, 0.5)
    assert softer[0] == 0 and softer[50] == pytest.approx(0.5, abs=1e-6)
    assert (softer[1:50] > alpha[1:50]).all() and (softer[51:100] < alpha[51:100]).all()
    assert softer[20] == pytest.approx(1 / 3, abs=1e-5)  # logit of 0.2 is log(1 / 4); half of it is log(1 / 2)


def test_colours_keep_what_they_are_without_black():
    straight = torch.rand(3, 50)
    alpha = torch.linspace(0.05, 1, 50)
    changed = with_slope(alpha, 0.6)
    torch.testing.assert_close(recomposed(alpha * straight, alpha, changed), changed * straight)


@pytest.mark.parametrize("slope", [0.55, 1.0, 1.15])
def test_the_slope_by_which_alpha_was_too_sure_is_found(slope):
    generator = torch.Generator().manual_seed(3)
    true = torch.rand(4000, generator=generator).clamp(0.02, 0.98)
    told = (true.logit() / slope).sigmoid()
    straight = torch.rand(3, 4000, generator=generator)
    noise = 0.05 * torch.randn(3, 4000, generator=generator)
    found = fitted_slope([(told * straight, told, true * straight + noise)])
    assert found == pytest.approx(slope, abs=1e-9) and found in SLOPES


def test_views_count_alike_whatever_their_size():
    straight, told = torch.ones(3, 1000), torch.full((1000,), 0.8)
    soft, sure = with_slope(told, 0.5), with_slope(told, 1.2)
    few = (told[:10] * straight[:, :10], told[:10], sure[:10] * straight[:, :10])
    many = (told * straight, told, soft * straight)
    assert fitted_slope([few, many]) == fitted_slope([few, (many[0][:, :10], told[:10], many[2][:, :10])])


def test_without_views_alpha_stays():
    assert fitted_slope([]) == 1.0
    assert fitted_slope([(torch.zeros(3, 0), torch.zeros(0), torch.zeros(3, 0))]) == 1.0
