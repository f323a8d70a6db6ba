"""What is learned of a rig: from cameras that nobody looks at meanwhile, once, and by those alone who ask for it."""

from dataclasses import dataclass, field

import pytest
import torch
from reference.ball import photograph, proxy, ring

from viewmend.geometry.hull import HullConfig
from viewmend.inpainting.protocol import State
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.views import CompletedView

RIG = ring(12)
CONFIG = StreamConfig(hull=HullConfig(resolution=32))


@dataclass
class Learner:
    """Remembers what it was given."""

    held: list = field(default_factory=list)
    error_rule: str = "all"

    def initial_state(self):
        return State()

    def step(self, view, context, state):
        return CompletedView(view, view.rgb), state

    def fitted_to_rig(self, held):
        return Learner([*self.held, *held])


def test_cameras_are_left_out_in_turn_and_the_first_frame_is_all_that_counts():
    learner = Learner()
    stream = Stream(learner, CONFIG)
    stream.push(photograph(RIG, 4))
    stream.push(photograph(RIG, 5))
    held = stream.inpainter.held
    assert not learner.held and len(held) == 3
    for own, name in zip(held, ("c0", "c4", "c8"), strict=True):
        assert own.view.time == 4
        assert name not in own.view.candidate_views
        assert own.context(4, [name]) is None and own.context(4, ["c1"]) is not None
        assert (own.view.error > 0).sum() > own.view.holes.sum(), "all is asked, as the inpainter is made for"
        seen = photograph(RIG.select([name])).rgb[0] / 255
        assert own.truth.shape[1:] == own.view.mask.shape and own.truth.max() > 0.3
        error = (own.view.rgb - own.truth).abs().amax(0)[(own.view.mask > 0) & ~own.view.holes]
        assert error.median() < 0.1, "the view is from that camera"
        assert own.truth.sum() == pytest.approx(float(seen.sum()), rel=1e-4), "the crop has all of the subject"


def test_black_lies_where_the_mask_is():
    frame = photograph(RIG)
    frame.rgb[:, :, :4] = 255  # a bright stage beyond the mask
    stream = Stream(Learner(), CONFIG)
    stream.push(frame)
    assert all(own.truth[:, :2].max() < 1 for own in stream.inpainter.held)


def test_streams_of_a_rig_share_what_was_learned():
    first = Stream(Learner(), CONFIG)
    other = first.rendered_by(RenderConfig(error_rule="unseen"))
    other.push(photograph(RIG))
    assert first.inpainter is other.inpainter and len(first.inpainter.held) == 3


@pytest.mark.parametrize("why", ["geometry", "three cameras", "switched off"])
def test_nothing_is_learned_where_nothing_can_be(why):
    learner, rig = Learner(), RIG.select(["c0", "c1", "c2"]) if why == "three cameras" else RIG
    config = StreamConfig(hull=HullConfig(resolution=32), fit_rig=why != "switched off")
    stream = Stream(learner, config)
    stream.push(photograph(rig), proxy() if why == "geometry" else None)
    assert stream.inpainter is learner


def test_a_camera_that_sees_nobody_is_no_mistake():
    frame = photograph(RIG)
    frame.mask[:1] = 0
    stream = Stream(Learner(), CONFIG)
    stream.push(frame)
    assert all(torch.isfinite(own.truth).all() for own in stream.inpainter.held)
