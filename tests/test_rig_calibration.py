"""Calibration of an inpainter to a rig, by views of the rig's own cameras."""

from dataclasses import dataclass, field

import pytest
import torch
from reference.ball import photograph, ring

from viewmend.geometry.hull import HullConfig
from viewmend.models.base import Inpainter
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig

RIG = ring(12)
CONFIG = StreamConfig(hull=HullConfig(resolution=32))


@dataclass
class Learner(Inpainter):
    """Keeps the held-out views that it is given."""

    held: list = field(default_factory=list)
    error_rule: str = "all"

    def calibrate_to_rig(self, held_out):
        return Learner([*self.held, *held_out])


def calibrated(frame, learner=None):
    stream = Stream(learner or Learner(), CONFIG)
    stream.calibrate(frame)
    return stream


def test_cameras_are_held_out_in_turn():
    learner = Learner()
    held = calibrated(photograph(RIG, 4), learner).inpainter.held
    assert not learner.held and len(held) == 3
    for own, name in zip(held, ("c0", "c4", "c8"), strict=True):
        assert own.view.time == 4
        assert name not in own.view.candidate_views
        assert own.context(4, [name]) is None and own.context(4, ["c1"]) is not None
        assert (own.view.error > 0).sum() > own.view.holes.sum(), "the inpainter's own error rule"
        image = photograph(RIG.select([name])).rgb[0] / 255
        assert own.truth.shape[1:] == own.view.mask.shape and own.truth.max() > 0.3
        error = (own.view.rgb - own.truth).abs().amax(0)[(own.view.mask > 0) & ~own.view.holes]
        assert error.median() < 0.1, "the view is rendered at that camera"
        assert own.truth.sum() == pytest.approx(float(image.sum()), rel=1e-4), "the crop contains the subject"


def test_the_truth_is_black_outside_the_mask():
    frame = photograph(RIG)
    frame.rgb[:, :, :4] = 255  # a bright background
    assert all(own.truth[:, :2].max() < 1 for own in calibrated(frame).inpainter.held)


def test_streams_with_another_render_config_keep_the_calibration():
    stream = calibrated(photograph(RIG))
    other = stream.with_render_config(RenderConfig(error_rule="holes"))
    assert other.inpainter is stream.inpainter and len(stream.inpainter.held) == 3


def test_small_rigs_are_not_calibrated():
    learner = Learner()
    assert calibrated(photograph(RIG.select(["c0", "c1", "c2"])), learner).inpainter is learner


def test_a_camera_without_foreground_is_no_error():
    frame = photograph(RIG)
    frame.mask[:1] = 0
    assert all(torch.isfinite(own.truth).all() for own in calibrated(frame).inpainter.held)
