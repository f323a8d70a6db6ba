"""How views of any size meet a network of one: every hole is covered, windows meet without a seam."""

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from viewmend.contrib.baselines.framing import dilated, resized_canvas, stitch, window_canvas, windows_over

SIZE = (24, 40)


@settings(max_examples=60, deadline=None)
@given(st.integers(24, 100), st.integers(40, 130), st.integers(0, 23), st.integers(0, 2**31))
def test_windows_cover_every_hole_and_stitch_to_one_picture(height, width, overlap, seed):
    generator = torch.Generator().manual_seed(seed)
    holes = torch.rand(height, width, generator=generator) < 0.002
    windows = windows_over(holes, SIZE, overlap)
    assert len(windows) == len(set(windows)) and bool(windows) == bool(holes.any())
    if not windows:
        return
    picture = torch.rand(3, height, width, generator=generator)
    pieces = [window.of(picture, SIZE) for window in windows]
    assert all(piece.shape[1:] == SIZE for piece in pieces), "windows stay on the canvas"
    # Windows that agree with one another give what they agree on: all weights are shares.
    stitched = stitch(pieces, windows, (height, width), overlap)
    assert torch.allclose(stitched[:, holes], picture[:, holes], atol=1e-5)


@given(st.integers(24, 200), st.integers(40, 200), st.integers(0, 23))
def test_neighbouring_windows_overlap_by_what_is_asked_and_there_are_no_more_than_needed(
    height, width, overlap
):
    windows = windows_over(torch.ones(height, width, dtype=torch.bool), SIZE, overlap)
    for starts, length, side in (
        (sorted({w.top for w in windows}), height, SIZE[0]),
        (sorted({w.left for w in windows}), width, SIZE[1]),
    ):
        assert starts[0] == 0 and starts[-1] + side == length
        assert all(a + side - b >= overlap for a, b in pairwise(starts))
        assert len(starts) == 1 or (len(starts) - 1) * (side - overlap) + overlap < length, (
            "one fewer is too few"
        )


def test_where_windows_meet_one_fades_into_the_other():
    holes = torch.ones(24, 70, dtype=torch.bool)
    windows = windows_over(holes, SIZE, 10)
    assert [w.left for w in windows] == [0, 30]
    pieces = [torch.full((3, *SIZE), value) for value in (0.0, 1.0)]
    line = stitch(pieces, windows, (24, 70), 10)[0, 12]
    assert bool((line[:30] == 0).all()) and bool((line[40:] == 1).all())
    assert bool((line.diff() >= 0).all()) and float(line.diff().max()) < 0.11


def test_a_hole_in_one_corner_needs_one_window():
    holes = torch.zeros(100, 130, dtype=torch.bool)
    holes[3, 5] = True
    [window] = windows_over(holes, SIZE, 8)
    assert (window.top, window.left) == (0, 0)


def test_small_views_are_padded_and_seen_in_their_own_resolution(rng):
    rgb, holes = torch.rand(3, 17, 60, generator=rng), torch.zeros(17, 60, dtype=torch.bool)
    holes[4, 9] = True
    canvas = window_canvas(rgb, holes, SIZE, dilation_px=0)
    assert canvas.image.shape == (3, 24, 60) and canvas.holes.shape == (24, 60)
    assert torch.equal(canvas.image[:, :17][:, ~holes], 2 * rgb[:, ~holes] - 1)
    assert bool((canvas.image[:, 17:] == -1).all()), "black"
    assert not canvas.image[:, 4, 9].any(), "holes are 0, which is grey"


@pytest.mark.parametrize("steps", [0, 1, 4])
def test_holes_are_widened_by_a_cross(steps):
    holes = torch.zeros(15, 15, dtype=torch.bool)
    holes[7, 7] = True
    y, x = torch.meshgrid(torch.arange(15), torch.arange(15), indexing="ij")
    assert torch.equal(dilated(holes, steps), (y - 7).abs() + (x - 7).abs() <= steps)


def test_the_whole_view_is_resized_whatever_its_aspect(rng):
    rgb = torch.rand(3, 96, 80, generator=rng)
    holes = torch.zeros(96, 80, dtype=torch.bool)
    holes[:48, :40] = True
    canvas = resized_canvas(rgb, holes, SIZE, dilation_px=1)
    assert canvas.image.shape == (3, *SIZE)
    assert not canvas.image[:, :12, :20].any() and not canvas.image[:, 12, :20].any()
    assert bool((canvas.image[:, 13:].abs().sum(0) > 0).all())
