"""An untrained inpainter with a colour path copies what it sees, rightly shifted."""

import math

import torch
from inpainting.plates import TINY, Rig, view

from viewmend.baselines.classical import NearestColour
from viewmend.inpainting import rope
from viewmend.inpainting.chain import build
from viewmend.inpainting.config import small
from viewmend.inpainting.identity_init import analysis, synthesis


def test_waves_explain_smooth_cells(rng):
    coarse = torch.rand(1, 1, 3, 3, generator=rng)
    cells = torch.nn.functional.interpolate(coarse, 7, mode="bicubic", align_corners=True).flatten()
    error = synthesis(32) @ (analysis(32) @ cells) - cells
    assert float(error.square().mean()) < 0.1 * float((cells - cells.mean()).square().mean())


def test_turned_waves_are_a_shifted_picture():
    """The shift theorem: a pattern at a context patch 6 px to the right is 6 px to the right in the query."""
    offset_px, f = 6.0, rope.value_frequencies(32)
    x = (torch.arange(7) - 3) * 4.0
    pattern = lambda x: 0.5 + 0.3 * torch.cos(2 * math.pi * x / 40 - 0.4)  # noqa: E731
    seen = pattern(x)[None].expand(7, 7).flatten()
    value = analysis(32) @ seen
    turned = rope.rotate(value, rope.cos_sin(rope.angles(torch.tensor([offset_px / 16, 0.0, 0.0]), f)))
    arrived = (synthesis(32) @ turned).unflatten(0, (7, 7))[3]
    assert torch.allclose(arrived, pattern(x - offset_px), atol=0.05)
    assert not torch.allclose(arrived, pattern(x), atol=0.1)


def test_an_untrained_model_beats_the_nearest_colour():
    """On a patterned plate whose hole the other cameras see, before any training."""
    torch.manual_seed(0)
    net = build(small()).eval()
    size = {"width": 180, "height": 150}
    incomplete = view(0, (55, 100, 70, 110), **size)
    truth = view(0, None, **size).rgb
    holes = incomplete.error > 0
    errors = [
        float((fill.step(incomplete, Rig(**size), fill.initial_state())[0].rgb - truth)[:, holes].square().mean())
        for fill in (net, NearestColour())
    ]
    assert errors[0] < errors[1]
    assert TINY.colour_skip
