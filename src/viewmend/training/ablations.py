"""The ablations: Table 3's and ours. Each is the full model but for the difference that it states."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from viewmend.inpainting.config import small as small_model
from viewmend.training.plan import DataPlan, LossWeights, Recipe

TABLE_3: dict[str, dict[str, Any]] = {
    "full": {},
    "no-rope": {"rope": False, "rope_values": False},
    "no-past": {"n_c": 0, "n_w": 0},
    "single-camera": {"context_cameras": 1},
    "single-camera-no-masks": {"context_cameras": 1, "use_mask": False, "black_background": False},
}
"""The paper's: what changes in the model's config."""
OURS: dict[str, dict[str, Any]] = {
    "current-geometry": {"past_geometry": "current"},
    "no-validity": {"use_validity": False},
    "no-depth": {"use_depth": False},
    "no-masks-no-depth": {**TABLE_3["single-camera-no-masks"], "use_depth": False},
    "two-cameras": {"context_cameras": 2},
    "four-cameras": {"context_cameras": 4},
    "five-cameras": {"context_cameras": 5},
}
DIFFERENCES = TABLE_3 | OURS
MOST_CAMERAS = 5
"""Context cameras of the samples, so that one set of them serves all."""


def ablation(name: str, data: DataPlan) -> Recipe:
    """The paper's transformer at the small size, without fill, so that all that it knows it has from its context.

    Colours travel with the patches, and it starts as a copier, else no budget of two CPU cores would teach it anything.
    Holes are large: rigs of few cameras, views that miss much. The window is t, t - 1 and t - 10. A stage stands behind
    the people: before black, colours alone would tell the background, and masks be worth nothing.
    """
    model = replace(small_model(), coarse_fill="none", n_c=1, n_w=1)
    few = replace(data, cameras=(5, 9), sizes_px=(192,), min_hole_px=250, context_cameras=(3,), context_weights=(1,))
    few = replace(few, imperfect_fraction=0.0, staged=True)
    return Recipe(
        name=name,
        model=replace(model, **DIFFERENCES[name]),
        data=replace(few, least_context=MOST_CAMERAS, times=(0, 1, 10, 11), past=(99,)),
        loss=LossWeights(log_error=0.5),
        steps=300,
        batch=4,
        new_per_batch=4,
        replay_size=1,
        workers=0,
        validate_every=0,
    )


ABLATIONS: dict[str, Callable[[DataPlan], Recipe]] = {name: partial(ablation, name) for name in DIFFERENCES}
"""The ablations by name."""
