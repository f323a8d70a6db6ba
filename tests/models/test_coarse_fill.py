"""The smooth fill against its slow reference."""

import pytest
import torch
from reference.prefill_twin import pull_push_twin

from viewmend.models.smooth_fill import fill, pull_push


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (13, 9), (5, 30)])
@pytest.mark.parametrize("share", [0.9, 0.3, 0.02])
def test_pull_push_equals_its_reference_and_keeps_known_pixels(size, share, rng):
    rgb, known = torch.rand(3, *size, generator=rng), torch.rand(size, generator=rng) < share
    filled = pull_push(rgb, known)
    assert torch.equal(filled[:, known], rgb[:, known])
    assert torch.allclose(filled[:, ~known], pull_push_twin(rgb * known, known)[:, ~known], atol=1e-5)


def test_a_hole_in_a_uniform_image_takes_its_colour():
    rgb, known = torch.full((3, 20, 33), 0.7), torch.ones(20, 33, dtype=torch.bool)
    known[4:15, 3:30] = False
    assert torch.allclose(pull_push(rgb * known, known), rgb, atol=1e-6)
    assert not pull_push(rgb, torch.zeros_like(known)).any()


def test_fill_treats_thin_and_wide_holes_differently():
    """Of a grey subject on black, with a thin hole along its right edge and a wide one at its left edge."""
    subject, missing = torch.zeros(2, 40, 40, dtype=torch.bool)
    subject[5:35, 8:32] = True
    missing[10:30, 31], missing[10:30, 8:20] = True, True
    rgb = 0.8 * (subject & ~missing).expand(3, -1, -1).float()
    filled = fill(rgb, missing, subject)
    assert torch.equal(filled[:, ~missing], rgb[:, ~missing])
    thin, wide = filled[:, 15:25, 31], filled[:, 12:28, 8:20]
    assert float(thin.max()) < 0.6 and float(thin.min()) > 0.2, "half background"
    assert torch.allclose(wide, torch.tensor(0.8), atol=1e-5), "background does not bleed into wide holes"
