"""The final blend, and the fills that use the view alone: against OpenCV and a search."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from viewmend.geometry.cameras import Cameras
from viewmend.models.base import ContextProvider, Inpainter, State
from viewmend.models.classical import NavierStokes, NearestColour, Telea, Unfilled
from viewmend.models.compositing import blend
from viewmend.models.smooth_fill import SmoothFill
from viewmend.types import IncompleteView

HEIGHT, WIDTH = 24, 30
ALL = (Telea, NavierStokes, NearestColour, SmoothFill, Unfilled)


@ContextProvider
def no_context(time, names):
    raise AssertionError("these know no cameras")


@pytest.fixture
def view(rng):
    """A subject on black, with a hole inside, one at its edge, and a soft rim."""
    mask = torch.zeros(HEIGHT, WIDTH)
    mask[3:21, 4:26] = 1
    rgb = torch.rand(3, HEIGHT, WIDTH, generator=rng) * mask
    error = torch.zeros(HEIGHT, WIDTH)
    error[8:14, 10:16], error[3:6, 20:26], error[14, 10:16] = 1, 1, 0.5
    camera = Cameras(("c",), torch.eye(3)[None], torch.eye(4)[None], torch.tensor([[WIDTH, HEIGHT]]))
    return IncompleteView(camera, rgb * (error < 1), mask, error, mask, (), torch.zeros(0, HEIGHT, WIDTH), 0)


def filled(inpainter, view):
    completed, state = inpainter.step(view, no_context, inpainter.initial_state())
    assert state == State() and completed.view is view
    return completed.rgb


def test_the_blend_is_the_formula_inside_and_a_copy_outside(rng):
    F, filled = torch.rand(2, 3, 6, 6, generator=rng)
    E = torch.rand(6, 6, generator=rng) * (torch.rand(6, 6, generator=rng) > 0.5)
    coverage = (torch.rand(6, 6, generator=rng) > 0.2).float()
    completed = blend(F, E, filled, coverage)
    assert torch.allclose(
        completed[:, coverage == 1], (E * filled + (1 - E) * F)[:, coverage == 1], atol=1e-6
    )
    untouched = (E == 0) | (coverage == 0)
    assert torch.equal(completed[:, untouched], F[:, untouched])
    known, half, bright = torch.zeros(3, 2, 2), torch.full((2, 2), 0.5), torch.full((3, 2, 2), 1.6)
    assert float(blend(known, half, bright, half).max()) == pytest.approx(0.5)
    assert float(blend(known, half, bright, half, clamp=False).max()) == pytest.approx(0.8), "as in the paper"


@pytest.mark.parametrize("kind", ALL)
def test_all_are_inpainters_that_change_nothing_but_holes(kind, view):
    assert isinstance(kind(), Inpainter)
    rgb = filled(kind(), view)
    known = view.error == 0
    assert torch.equal(rgb[:, known], view.rgb[:, known]) and rgb.isfinite().all()
    assert bool((rgb[:, 9, 12] > 0).any()) == (kind is not Unfilled)
    whole = replace(view, error=torch.zeros(HEIGHT, WIDTH))
    assert filled(kind(), whole) is whole.rgb


@pytest.mark.parametrize(("kind", "method"), [(Telea, cv2.INPAINT_TELEA), (NavierStokes, cv2.INPAINT_NS)])
def test_opencvs_fills_are_opencvs(kind, method, view):
    image = (view.rgb * 255).round().byte().movedim(0, -1).numpy()
    expected = cv2.inpaint(np.ascontiguousarray(image), (view.error > 0).byte().numpy(), 3.0, method)
    expected = torch.from_numpy(expected).movedim(-1, 0).float() / 255
    got = filled(kind(), view)
    inside, soft = view.error == 1, view.error == 0.5
    torch.testing.assert_close(got[:, inside], expected[:, inside])
    torch.testing.assert_close(got[:, soft], (expected[:, soft] + view.rgb[:, soft]) / 2)


def test_the_nearest_colour_is_that_of_a_nearest_pixel_of_the_subject(view):
    got = filled(NearestColour(), view)
    right = ((view.error == 0) & (view.mask > 0)).nonzero().float()
    for place in (view.error == 1).nonzero():
        distance = (right - place).norm(dim=1)
        nearest = right[
            distance < distance.min() + 0.1
        ].long()  # OpenCV's distances are good to a twentieth of a pixel
        colours = view.rgb[:, nearest[:, 0], nearest[:, 1]]
        assert (colours - got[:, place[0], place[1]][:, None]).abs().amax(0).min() < 1e-6


def test_without_anything_right_nearest_and_smooth_leave_black(view):
    lost = replace(view, error=torch.ones(HEIGHT, WIDTH), rgb=torch.zeros(3, HEIGHT, WIDTH))
    assert not filled(NearestColour(), lost).any() and not filled(SmoothFill(), lost).any()
