"""Holes from whichever camera saw the surface."""

from dataclasses import replace

import torch
from models.plates import Rig, camera, context, look, view

from viewmend.models.base import Inpainter
from viewmend.models.classical import ReprojectionFill
from viewmend.models.smooth_fill import fill
from viewmend.models.views.pyramids import SourceCameras
from viewmend.types import Silhouettes


def test_it_finds_the_true_colours_where_a_camera_sees_the_surface():
    incomplete, inpainter = replace(view(5), candidate_views=("third", "left", "right")), ReprojectionFill()
    assert isinstance(inpainter, Inpainter)
    completed, _ = inpainter.step(incomplete, Rig(), inpainter.initial_state())
    truth, mask = look(camera("novel"), 5)
    inner = (incomplete.error == 1) & (mask > 0)
    assert float((completed.rgb - truth)[:, inner].abs().mean()) < 0.02
    known = incomplete.error == 0
    assert torch.equal(completed.rgb[:, known], incomplete.rgb[:, known])


def test_the_past_is_asked_where_the_present_is_silent():
    rig = Rig(silent=frozenset({("left", 5), ("right", 5), ("left", 4)}))
    inpainter = ReprojectionFill()
    completed, _ = inpainter.step(view(5), rig, inpainter.initial_state())
    assert [time for time, _ in rig.asked] == [5, 4]
    past, _ = look(camera("novel"), 4)
    inner = view(5).error == 1
    assert float((completed.rgb - past)[:, inner].abs().mean()) < 0.05


def test_without_cameras_it_fills_smoothly_and_without_holes_it_asks_nobody():
    inpainter, rig, incomplete = ReprojectionFill(), Rig(start=1000), view(5)
    completed, _ = inpainter.step(incomplete, rig, inpainter.initial_state())
    hard = incomplete.error == 1
    assert torch.equal(
        completed.rgb[:, hard], fill(incomplete.rgb, incomplete.error > 0, incomplete.mask > 0)[:, hard]
    )
    rig.asked.clear()
    whole = view(5, hole=None)
    assert inpainter.step(whole, rig, inpainter.initial_state())[0].rgb is whole.rgb and not rig.asked


def test_silhouettes_of_past_frames_are_their_own():
    """The view has masks of its own frame, and its holes are filled from a past one."""
    rig = Rig(silent=frozenset({("left", 5), ("right", 5)}))
    now = context(5)
    empty = Silhouettes(torch.zeros_like(now.frame.mask), now.frame.cameras)
    inpainter = ReprojectionFill()
    inpainter.step(replace(view(5), silhouettes=empty), rig, inpainter.initial_state())
    past = SourceCameras.of(context(4), None, rig)
    assert all(pyramid.mask_sum > 0 for pyramid in past.silhouette_pyramids)
