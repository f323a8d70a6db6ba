"""Samples come from the production pipeline and know nothing of the camera that is left out; a run mends its model."""

import json
from dataclasses import replace
from random import Random

import pytest
import torch

from viewmend.capture.studio.stage import Studio, StudioConfig
from viewmend.geometry.hull import HullConfig
from viewmend.inpainting.checkpoint import load_inpainter
from viewmend.inpainting.config import small as small_model
from viewmend.inpainting.inpainter import Inpainter
from viewmend.rendering.view import RenderConfig
from viewmend.training.loop import learning_rate_factor, train
from viewmend.training.recipes import DataPlan, Recipe
from viewmend.training.samples import LeaveOneOut
from viewmend.training.scenes import FIRST_TEST_SEED, random_studio, scene_samples

PLAN = DataPlan(
    sizes_px=(96,),
    cameras=(5, 5),
    times=(0, 1),
    held_cameras=2,
    targets_per_camera=1,
    min_hole_px=5,
    rays=3,
    hull_resolution=48,
)


@pytest.fixture(scope="module")
def studio() -> Studio:
    return Studio(StudioConfig(seed=3, cameras=5, frames=2, size_px=96))


def test_a_sample_does_not_depend_on_what_the_camera_left_out_sees(studio):
    held = studio.cameras.names[2]
    frame = studio.read(1)
    vandalised = replace(frame, rgb=frame.rgb.clone(), mask=frame.mask.clone())
    vandalised.rgb[2] = 255
    vandalised.mask[2] = 255
    truth = studio.truth(studio.true_cameras.select([held]), 1)
    samples = [
        LeaveOneOut({1: f}, held, None, HullConfig(resolution=48)).sample(1, (), truth, RenderConfig(), 0)
        for f in (frame, vandalised)
    ]
    first, second = samples
    assert first is not None and second is not None
    assert torch.equal(first.view.rgb, second.view.rgb) and torch.equal(first.view.error, second.view.error)
    assert held not in first.view.chosen
    assert all(held not in views.frame.cameras.names for views in first.context)


def test_truth_is_black_where_the_mask_is_and_context_is_past(studio):
    samples = list(scene_samples(studio, PLAN, Random(0)))
    assert samples
    for sample in samples:
        times = [views.frame.time for views in sample.context]
        assert times[0] == sample.view.time and times == sorted(times, reverse=True)
        assert float(sample.view.error.sum()) >= PLAN.min_hole_px
        assert not sample.truth[:, 0].any(), "the top row is background"


def test_no_stage_takes_a_seed_that_is_kept_for_tests():
    random = Random(1)
    seeds = [random_studio(replace(PLAN, times=(0,)), random).config.seed for _ in range(6)]
    assert max(seeds) < FIRST_TEST_SEED and len(set(seeds)) > 1


def test_the_learning_rate_warms_up_and_ends_at_zero():
    assert learning_rate_factor(0, 0.0, 10) == pytest.approx(0.1)
    assert learning_rate_factor(100, 0.5, 10) == pytest.approx(0.5)
    assert learning_rate_factor(100, 1.0, 10) == pytest.approx(0.0)


@pytest.mark.parametrize("part", ["all", "rays", "patches"])
def test_a_short_run_trains_its_part_and_writes_a_model_that_loads_and_a_log(part, tmp_path):
    model = replace(small_model(), widths=(8,) * 9, dim=32, heads=2, groups=1, blocks=2)
    recipe = Recipe(
        name="tiny", model=model, data=PLAN, steps=3, batch=2, fresh=1, warmup=1, workers=0, part=part, ema=0.0
    )
    reported = []
    train(recipe, tmp_path / "run", report=reported.append)
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [entry["step"] for entry in log] == [0, 1, 2] == [entry.step for entry in reported]
    inpainter = load_inpainter(tmp_path / "run")
    assert inpainter.config == model
    torch.manual_seed(recipe.seed)
    untrained = Inpainter(model).state_dict()
    moved = {n.startswith("ray_reader.") for n, w in inpainter.state_dict().items() if not torch.equal(w, untrained[n])}
    assert moved == {"all": {True, False}, "rays": {True}, "patches": {False}}[part]
    assert "tiny" in (tmp_path / "run" / "README.md").read_text()
