"""Selecting cameras of a frame: nothing is copied until a stack is read."""

import pickle
from dataclasses import replace

import pytest
import torch
from reference.ball import photograph, ring

from viewmend.data.synthetic.stage import Studio, StudioConfig


@pytest.fixture(scope="module")
def frame():
    """A frame of four cameras of two sizes."""
    frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
    sizes = frame.cameras.size_px.clone()
    sizes[[0, 2]] = torch.tensor([60, 50])
    return replace(frame, cameras=replace(frame.cameras, size_px=sizes))


def test_a_selection_refers_to_the_images_and_is_stacked_once(frame):
    names = tuple(frame.cameras.names[n] for n in (2, 0))
    chosen = frame.select(names)
    assert chosen.cameras.names == names and chosen.time == frame.time
    assert torch.equal(chosen.depth, frame.depth[[2, 0], :50, :60])
    for field in ("rgb", "mask"):
        images = getattr(frame, field)
        assert [part.data_ptr() for part in chosen.per_camera(field)] == [images[n].data_ptr() for n in (2, 0)]
        stack = getattr(chosen, field)
        assert torch.equal(stack, images[[2, 0], ..., :50, :60]) and getattr(chosen, field) is stack
    assert replace(chosen, time=7).rgb is chosen.rgb
    assert torch.equal(pickle.loads(pickle.dumps(frame.select(names))).rgb, chosen.rgb)
    with pytest.raises(ValueError, match="expected cameras among"):
        frame.select(("unknown",))
    with pytest.raises(AttributeError, match="has no attribute size"):
        _ = chosen.size


def test_a_selection_without_masks_has_none(frame):
    bare = replace(frame, mask=None)
    chosen = bare.select(bare.cameras.names[1:3])
    assert chosen.mask is None and not chosen.per_camera("mask") and len(chosen.per_camera("rgb")) == 2
    assert torch.equal(chosen.select(bare.cameras.names[2:3]).rgb, bare.rgb[2:3, :, :50, :60])


def test_all_cameras_of_a_frame_are_the_frame_itself():
    frame = photograph(ring(3, 16))
    assert frame.select(frame.cameras.names) is frame and frame.without([]) is frame
    turned = frame.select(frame.cameras.names[::-1])
    assert turned.cameras.names == ("c2", "c1", "c0") and torch.equal(turned.rgb[0], frame.rgb[2])
    assert len(frame.select([]).cameras) == 0 == len(frame.select([]).rgb)
