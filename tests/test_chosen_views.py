"""Cameras chosen by reference are the cameras that were copied."""

from dataclasses import replace

import pytest
import torch

from viewmend import Stream, make_method
from viewmend.chosen_views import ChosenFrame, ChosenViews, each
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.views import ContextViews


@pytest.fixture(scope="module")
def frame():
    """A rig whose first camera has smaller images than the others."""
    frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
    sizes = frame.cameras.size_px.clone()
    sizes[[0, 2]] = torch.tensor([60, 50])
    return replace(frame, cameras=replace(frame.cameras, size_px=sizes), depth=None)


def test_it_is_what_a_copy_is(frame):
    names = tuple(frame.cameras.names[n] for n in (2, 0))
    chosen, copied = ChosenFrame.of(frame, names), frame.select(names)
    assert copied.rgb.shape[2:] == (50, 60), "cut to the largest of them"
    assert chosen.cameras.names == names and chosen.time == frame.time and chosen.depth is None
    for field in ("rgb", "mask"):
        parts = each(chosen, field)
        assert [part.data_ptr() for part in parts] == [getattr(frame, field)[n].data_ptr() for n in (2, 0)]
        assert torch.equal(torch.stack(tuple(parts)), getattr(copied, field))
        stack = getattr(chosen, field)
        assert torch.equal(stack, getattr(copied, field)) and getattr(chosen, field) is stack, "made once"
    assert replace(chosen, time=7).rgb is chosen.rgb
    with pytest.raises(ValueError, match="expected cameras among"):
        ChosenFrame.of(frame, ("nobody",))
    with pytest.raises(AttributeError, match="has no size"):
        _ = chosen.size


def test_what_has_no_masks_has_none_chosen(frame):
    bare = replace(frame, mask=None)
    chosen = ChosenFrame.of(bare, bare.cameras.names[1:3])
    assert chosen.mask is None and not each(chosen, "mask") and len(each(chosen, "rgb")) == 2
    assert torch.equal(ChosenFrame.of(chosen, bare.cameras.names[2:3]).rgb, bare.rgb[2:3, :, :50, :60])


def test_an_observation_gives_references(frame):
    now = Stream(make_method("telea")).push(frame)
    first, second, third = (frame.cameras.names[n] for n in (2, 0, 1))
    seen = now.context((first, second, "nobody"))
    assert isinstance(seen, ChosenViews) and seen.frame.cameras.names == (first, second)
    assert [part.data_ptr() for part in each(seen, "depth")] == [now.depths[n].data_ptr() for n in (first, second)]
    copied = ContextViews(frame.select((first, second)), now.depth((first, second)))
    assert torch.equal(seen.depth, copied.depth) and torch.equal(seen.frame.rgb, copied.frame.rgb)
    one, other = seen.select(("nobody", second)), copied.select(("nobody", second))
    assert torch.equal(one.depth, other.depth) and torch.equal(one.frame.mask, other.frame.mask)
    assert each(one, "depth")[0].data_ptr() == now.depths[second].data_ptr()
    assert now.context(("nobody",)) is None and third not in now.depths, "what nobody asked for is not rendered"
