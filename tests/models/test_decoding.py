"""The final blend, and classical fills."""

import numpy as np
import pytest
import torch
from models.plates import Rig, view

from viewmend.models.classical import NearestColour, Telea
from viewmend.models.compositing import blend


def test_the_blend_is_the_formula_inside_and_a_copy_outside(rng):
    F, filled = torch.rand(2, 3, 6, 6, generator=rng)
    E = torch.rand(6, 6, generator=rng) * (torch.rand(6, 6, generator=rng) > 0.5)
    coverage = (torch.rand(6, 6, generator=rng) > 0.2).float()
    completed = blend(F, E, filled, coverage)
    assert torch.allclose(completed[:, coverage == 1], (E * filled + (1 - E) * F)[:, coverage == 1], atol=1e-6)
    untouched = (E == 0) | (coverage == 0)
    assert torch.equal(completed[:, untouched], F[:, untouched])


@pytest.mark.parametrize("fill", [Telea(), NearestColour()])
def test_classical_fills_change_holes_only_and_request_no_camera(fill):
    incomplete, rig = view(5), Rig()
    completed, _ = fill.step(incomplete, rig, fill.initial_state())
    known = incomplete.error == 0
    assert torch.equal(completed.rgb[:, known], incomplete.rgb[:, known])
    assert (completed.rgb[:, incomplete.error == 1].sum(0) > 0).float().mean() > 0.9
    assert not rig.asked
    whole = view(5, None)
    assert fill.step(whole, rig, fill.initial_state())[0].rgb is whole.rgb


def test_the_nearest_colour_is_the_nearest():
    incomplete = view(5)
    completed, _ = NearestColour().step(incomplete, Rig(), NearestColour().initial_state())
    right = torch.nonzero((incomplete.error == 0) & (incomplete.mask > 0.5))
    for y, x in torch.nonzero(incomplete.error == 1)[::17].tolist():
        distance = (right - torch.tensor([y, x])).float().norm(dim=1)
        candidates = right[distance <= distance.min() + 0.35]  # OpenCV's 5 x 5 mask is that exact
        colours = incomplete.rgb[:, candidates[:, 0], candidates[:, 1]]
        assert np.isclose((colours - completed.rgb[:, y, x, None]).abs().sum(0).min(), 0, atol=1e-6)
