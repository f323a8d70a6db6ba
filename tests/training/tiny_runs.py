"""What tiny runs have in common: how they go, and the plan and net of those that read whole views."""

from typing import Any

from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.rendering.view import RenderConfig
from viewmend.training.plan import DataPlan

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
VIEW_PLAN = DataPlan(sizes_px=(96,), cameras=(5, 6), times=(0,), held_cameras=2, ray_views=4, hull_resolution=48)
VIEW_MODEL = SweepConfig(num_views=4, width=8, place_channels=4, features=8, fine_features=8, error_features=8)
VIEW_RULE = RenderConfig(error_rule="all")
