"""Patch grid, split and merge."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.patches_reference import any_in_patch_reference, merge_reference, split_reference

from viewmend.models.paper.patches import (
    PATCH_PX,
    STEP_PX,
    any_in_patch,
    centers_px,
    crop,
    grid_shape,
    merge,
    padded_size,
    split,
)


def all_places(views, rows, cols):
    return torch.cartesian_prod(torch.arange(views), torch.arange(rows), torch.arange(cols))


def test_a_patch_is_28_pixels_and_steps_by_16():
    assert (PATCH_PX, STEP_PX) == (28, 16)
    assert centers_px(torch.tensor([[0, 0, 0], [0, 1, 2]])).tolist() == [[14, 14], [46, 30]]


@given(height=st.integers(1, 200), width=st.integers(1, 200))
@settings(deadline=None, max_examples=50)
def test_the_grid_covers_the_image_and_has_no_spare_row(height, width):
    rows, cols = grid_shape(height, width)
    full_height, full_width = padded_size(rows, cols)
    assert full_height >= height and full_width >= width
    assert rows == 1 or padded_size(rows - 1, cols)[0] < height
    assert cols == 1 or padded_size(rows, cols - 1)[1] < width


@given(height=st.integers(5, 90), width=st.integers(5, 90), seed=st.integers(0, 99))
@settings(deadline=None, max_examples=20)
def test_merge_after_split_is_the_identity(height, width, seed):
    rng = torch.Generator().manual_seed(seed)
    rows, cols = grid_shape(height, width)
    full_height, full_width = padded_size(rows, cols)
    image = torch.zeros(2, 3, full_height, full_width)
    image[..., :height, :width] = torch.rand(2, 3, height, width, generator=rng)
    places = all_places(2, rows, cols)
    merged, coverage = merge(split(image, places, PATCH_PX, STEP_PX), places, (2, height, width), STEP_PX)
    assert torch.allclose(merged, image[..., :height, :width], atol=1e-6)
    assert bool((coverage == 1).all())


def test_split_merge_and_kept_patches_equal_the_references(rng):
    maps = torch.rand(2, 3, 15, 19, generator=rng)
    places = torch.tensor([[0, 0, 0], [1, 2, 3], [1, 0, 2], [0, 1, 1]])
    patches = split(maps, places, 7, 4)
    assert torch.equal(patches, split_reference(maps, places, 7, 4))
    for shape in ((2, 15, 19), (2, 13, 14)):
        fast, slow = merge(patches, places, shape, 4), merge_reference(patches, places, shape, 4)
        assert torch.allclose(fast[0], slow[0], atol=1e-5) and torch.equal(fast[1], slow[1])
    pixels = torch.rand(2, 70, 90, generator=rng) > 0.999
    assert torch.equal(any_in_patch(pixels), any_in_patch_reference(pixels, *grid_shape(70, 90)))


@pytest.mark.parametrize(("top", "left"), [(-5, -3), (4, 6), (50, 2), (-40, 0), (3, 17)])
def test_a_crop_is_zero_outside_of_the_image(top, left, rng):
    image = torch.rand(2, 20, 18, generator=rng)
    padded = torch.nn.functional.pad(image, (60, 60, 60, 60))
    expected = padded[:, 60 + top : 72 + top, 60 + left : 70 + left]
    assert torch.equal(crop(image, top, left, (12, 10)), expected)
