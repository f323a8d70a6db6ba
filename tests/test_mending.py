"""`Mender` and its summary: each figure under its own name, for the right frame, on the background of the truth."""

from dataclasses import replace

import pytest
import torch
from reference.ball import BallCapture, camera_at, ring

from viewmend.cli.mend_output import MendOutput, as_text, sheet_row
from viewmend.data.images import read_rgb
from viewmend.mending import Mender, MendSummary
from viewmend.metrics.image_quality import psnr, ssim_map
from viewmend.models.base import ContextProvider, State
from viewmend.models.classical import Telea
from viewmend.models.compositing import painted_alpha
from viewmend.models.smooth_fill import SmoothFill
from viewmend.rendering.view import RenderConfig
from viewmend.stream import StreamConfig
from viewmend.types import CompletedView
from viewmend.utils.timing import StageTimes

TARGET = camera_at(75, "t", height_m=0.3)


def test_each_view_shows_its_own_frame():
    source, mender = BallCapture(ring(6), 3), Mender(SmoothFill())
    means = [float(mender.mend(source.read(time), TARGET, None).completed.rgb.mean()) for time in range(3)]
    dimmed = [float(source.read(time).rgb.float().mean()) for time in range(3)]
    assert [m / means[0] for m in means] == pytest.approx([d / dimmed[0] for d in dimmed], abs=0.02)
    assert means[2] < 0.9 * means[0]


class Snow(SmoothFill):
    """Paints all of E white."""

    background = "white"

    def step(self, view, context, state):
        return CompletedView(view, view.error + (1 - view.error) * view.rgb, painted_alpha(view)), state


@pytest.fixture
def snow():
    truth = BallCapture(TARGET, 1).read(0)
    mender = Mender(Snow(), StreamConfig(render=RenderConfig(cameras=2)))
    return mender.mend(BallCapture(ring(6), 1).read(0), TARGET, truth), truth


def test_a_model_that_paints_on_white_is_scored_on_white(snow):
    step, truth = snow
    view, subject, scores = step.completed.view, truth.mask[0] > 127, step.scores
    assert step.background == "white" and view.holes.sum() > 3
    for image in (step.completed_rgb, step.rendered, step.truth):
        assert float(image[:, ~subject & (view.mask == 0)].min()) == 1
    assert (
        float(step.completed_rgb[:, view.holes].min()) == 1 and float(step.rendered[:, view.holes].max()) == 0
    )
    torch.testing.assert_close(step.completed_rgb, torch.where(view.error > 0, 1.0, step.rendered))
    assert scores.ours.psnr_whole == pytest.approx(psnr(step.completed_rgb, step.truth))
    assert scores.ours.ssim_whole == pytest.approx(float(ssim_map(step.completed_rgb, step.truth).nanmean()))
    assert scores.unfilled.psnr_whole == pytest.approx(psnr(step.rendered, step.truth))
    telea = Telea().step(replace(view, rgb=step.rendered), ContextProvider(lambda *_: None), State())[0].rgb
    assert scores.telea.psnr_holes == pytest.approx(psnr(telea, step.truth, view.holes), abs=0.01)
    summary = MendSummary()
    summary.add(step)
    assert summary.as_json()["background"] == "white"
    assert "views are scored" not in "\n".join(as_text(summary))
    summary.add(replace(step, truth=None, scores=None))
    assert "; 1 of 2 views are scored" in "\n".join(as_text(summary))


def test_the_time_of_a_stage_is_over_the_views_in_which_it_ran(snow):
    step, _ = snow
    summary = MendSummary()
    for geometry in (80.0, 0.0, 0.0, 90.0, 0.0):  # two frames, of three views and of two
        summary.add(replace(step, times=StageTimes(geometry=geometry, rendering=2.0)))
    assert summary.stage_ms() == {"geometry": 85.0, "context": 0.0, "rendering": 2.0, "inpainting": 0.0}


def test_a_model_that_paints_on_white_is_shown_on_white(snow, tmp_path):
    step, _ = snow
    with MendOutput(tmp_path, 15.0) as output:
        output.add(step)
    for name in ("completed", "rendered", "true"):
        assert (read_rgb(tmp_path / name / "000000.png", name)[:3, :3] == 255).all(), name
    tiles = {tile.label.split(",")[0]: tile.image for tile in sheet_row(step)}
    height, width = step.completed.view.mask.shape
    for name in ("rendered", "holes", "completed", "true"):
        assert tiles[name].shape[0] < height and tiles[name].shape[1] < width, "cropped to the subject"
        assert tiles[name][0, 0].tolist() == [255, 255, 255]
    assert tiles["rendered - true"][0, 0].tolist() == [0, 0, 0], "white minus white"
