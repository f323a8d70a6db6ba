"""The comparison in the holes: nothing of the camera left out leaks, and every method completes the same view."""

from dataclasses import replace

from viewmend.capture.studio.stage import Studio, StudioConfig
from viewmend.evaluation.holes import leave_one_out
from viewmend.inpainting.classical import NearestColour, Telea
from viewmend.pipeline import PipelineConfig


def test_all_methods_fill_the_same_holes_and_the_held_camera_does_not_matter():
    studio = Studio(StudioConfig(seed=1, cameras=7, frames=1, size_px=192))
    held = studio.cameras.names[1]
    frame, truth = studio.read(0), studio.truth(studio.true_cameras.select([held]), 0)
    vandalised = replace(frame, rgb=frame.rgb.clone())
    vandalised.rgb[1] = 200
    methods = {"Telea": Telea(), "nearest": NearestColour()}
    runs = [leave_one_out("s", [(f, truth)], None, methods, PipelineConfig()) for f in (frame, vandalised)]
    assert runs[0] == runs[1]
    telea, nearest = runs[0]
    assert telea.hole_px == nearest.hole_px > 50
    assert telea.holes is not None and telea.holes != nearest.holes


def test_frames_that_miss_hardly_anything_do_not_count():
    studio = Studio(StudioConfig(seed=1, cameras=12, frames=1, size_px=32))
    held = studio.cameras.names[0]
    pairs = [(studio.read(0), studio.truth(studio.true_cameras.select([held]), 0))]
    (scores,) = leave_one_out("s", pairs, None, {"Telea": Telea()}, PipelineConfig())
    assert scores.hole_px < 50 and scores.holes is None and scores.whole is not None
