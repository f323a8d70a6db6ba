"""A run that takes a second: tiny scenes, a tiny model."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from viewmend.inpainting.config import small as small_model
from viewmend.training.plan import DataPlan, Recipe
from viewmend.training.sample_files import write_shards
from viewmend.training.scenes import StudioScenes

PLAN = DataPlan(
    sizes_px=(96,),
    cameras=(5, 5),
    times=(0, 1),
    held_cameras=2,
    targets_per_camera=1,
    min_hole_px=5,
    ray_views=3,
    hull_resolution=48,
)
MODEL = replace(small_model(), widths=(8,) * 9, dim=32, heads=2, groups=1, blocks=2, num_ray_views=3)

RUN: dict[str, Any] = {
    "steps": 4,
    "batch": 2,
    "new_per_batch": 1,
    "replay_size": 3,
    "warmup": 1,
    "workers": 0,
    "ema": 0.5,
    "bfloat16": False,
    "checkpoint_every": 2,
}


@pytest.fixture
def plan() -> DataPlan:
    return PLAN


@pytest.fixture(scope="session")
def shards(tmp_path_factory) -> Path:
    """Clips of two frames, made once for all runs."""
    folder = tmp_path_factory.mktemp("shards")
    scenes = StudioScenes(replace(PLAN, clip_length=2), "tests")
    list(write_shards((sample for number in range(3) for sample in scenes.scene(number)), folder, per_shard=2))
    return folder


@pytest.fixture
def tiny(shards) -> Recipe:
    return Recipe(
        name="tiny",
        model=MODEL,
        data=replace(PLAN, shards=shards, clip_length=2),
        **RUN,
        validate_every=0,
        validation_views=2,
    )
