"""Runs that take a second: tiny scenes and tiny models."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from reference.computed_once import compute_once
from reference.shared_scenes import make_once

from viewmend.models.paper.config import paper_small
from viewmend.models.views.config import ViewsConfig
from viewmend.rendering.view import RenderConfig
from viewmend.training.config import SamplingConfig, SceneConfig, TrainConfig
from viewmend.training.paper import PaperObjectiveConfig
from viewmend.training.scenes import SampleScenes, StudioRigs
from viewmend.training.shards import write_shards

SCENES = SceneConfig(sizes_px=(96,), cameras=(5, 5), num_holdout_views=2, hull_resolution=48)
SAMPLING = SamplingConfig(frames=(0, 1), with_context=True, num_ray_views=3, min_hole_px=5)
MODEL = replace(paper_small(), widths=(8,) * 9, dim=32, heads=2, groups=1, blocks=2)
VIEWS_SCENES = replace(SCENES, cameras=(5, 6))
VIEWS_SAMPLING = SamplingConfig(num_ray_views=4)
VIEWS_MODEL = ViewsConfig(
    num_views=4, width=8, sample_channels=4, features=8, fine_features=8, error_features=8
)
VIEWS_RENDER = RenderConfig(error_rule="all")
RUN: dict[str, Any] = {
    **{"steps": 4, "batch": 2, "new_per_batch": 1, "replay_size": 3, "warmup": 1, "workers": 0, "ema": 0.5},
    **{"precision": "float32", "checkpoint_minutes": 1e9, "validate_every": 0, "validation_views": 2},
}


@pytest.fixture(autouse=True)
def _computed_once(monkeypatch):
    """Checks of a capture and people of the studio are computed once, not in each test; hulls are coarse."""
    compute_once(monkeypatch, coarsely=True)


def studio_samples(seed: str = "0", scenes: SceneConfig = SCENES, **sampling: Any) -> SampleScenes:
    """Samples of small studio scenes."""
    own = replace(SAMPLING, **sampling)
    return SampleScenes(StudioRigs(scenes, own.frames, seed), scenes, own)


def log_of(out: Path) -> list[dict[str, Any]]:
    """The whole lines of a run's log."""
    log = out / "log.jsonl"
    lines = log.read_text().splitlines(keepends=True) if log.exists() else []
    return [json.loads(line) for line in lines if line.endswith("\n")]


@pytest.fixture(scope="session")
def shards(tmp_path_factory) -> Path:
    """Clips of two frames, made once for all runs."""

    def write(folder: Path) -> None:
        source = studio_samples("tests", clip_length=2)
        samples = (sample for number in range(3) for sample in source.scene(number))
        list(write_shards(samples, folder, shard_size=2))

    return make_once(tmp_path_factory, "shards", write)


@pytest.fixture(scope="session")
def tiny(shards) -> TrainConfig:
    objective = PaperObjectiveConfig(model=MODEL, sampling=SAMPLING, adversarial=0.0)
    return TrainConfig(name="tiny", objective=objective, scenes=SCENES, shards=shards, **RUN)
