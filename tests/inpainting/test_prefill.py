"""The first guess for the holes."""

import pytest
import torch
from reference.prefill_twin import pull_push_twin

from viewmend.inpainting.prefill import pull_push


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (13, 9), (5, 30)])
@pytest.mark.parametrize("share", [0.9, 0.3, 0.02])
def test_it_equals_its_twin_and_keeps_what_is_known(size, share, rng):
    rgb, known = torch.rand(3, *size, generator=rng), torch.rand(size, generator=rng) < share
    filled = pull_push(rgb, known)
    assert torch.equal(filled[:, known], rgb[:, known])
    assert torch.allclose(filled[:, ~known], pull_push_twin(rgb * known, known)[:, ~known], atol=1e-5)


def test_a_hole_in_one_colour_takes_that_colour_and_nothing_known_is_black():
    rgb, known = torch.full((3, 20, 33), 0.7), torch.ones(20, 33, dtype=torch.bool)
    known[4:15, 3:30] = False
    assert torch.allclose(pull_push(rgb * known, known), rgb, atol=1e-6)
    assert not pull_push(rgb, torch.zeros_like(known)).any()
