"""The ablations: Table 3's and ours. Each is the paper's model but for the difference that it states."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from viewmend.inpainting.config import paper_small
from viewmend.training.plan import DataPlan, Recipe
from viewmend.training.recipes import as_the_paper
from viewmend.training.recipes import paper_small as paper_small_recipe

TABLE_3: dict[str, dict[str, Any]] = {
    "full": {},
    "no-rope": {"rope": False},
    "no-past": {"n_c": 0, "n_w": 0},
    "single-camera": {"context_cameras": 1},
    "single-camera-no-masks": {"context_cameras": 1, "use_mask": False},
}
"""The paper's: what is taken away from its model."""
OURS: dict[str, dict[str, Any]] = {
    "no-depth": {"use_depth": False},
    "no-pruning": {"top_k": None},
    "own-geometry": {"past_geometry": "own"},
    "validity": {"use_validity": True},
    "black": {"background": "black"},
    "token-norms": {"token_norms": True},
    "patch-positions": {"rope_unit": "patch"},
    "copier": {"identity_init": True, "token_norms": True, "colour_skip": True, "rope_values": True},
    "two-cameras": {"context_cameras": 2},
    "four-cameras": {"context_cameras": 4},
    "five-cameras": {"context_cameras": 5},
}
"""Ours: what is changed in it, or added; the copier is made of four parts that mean nothing each alone."""
DIFFERENCES = TABLE_3 | OURS
MOST_CAMERAS = 5
"""Context cameras of the samples, so that one set of them serves all."""


def ablation(name: str, data: DataPlan) -> Recipe:
    """The paper's model at small widths, with its objective and its window, less one thing.

    Nothing else fills holes, and nothing is accumulated over time: all that it knows it has from its context. Holes are
    large: rigs of few cameras, views that miss much.
    """
    few = replace(as_the_paper(data), cameras=(5, 9), sizes_px=(192,), min_hole_px=250, imperfect_fraction=0.0)
    return replace(
        paper_small_recipe(data),
        name=name,
        model=replace(paper_small(), **DIFFERENCES[name]),
        data=replace(few, least_context=MOST_CAMERAS),
        steps=300,
        batch=4,
        new_per_batch=4,
        replay_size=1,
        warmup=60,
        workers=0,
        validate_every=0,
    )


ABLATIONS: dict[str, Callable[[DataPlan], Recipe]] = {name: partial(ablation, name) for name in DIFFERENCES}
"""The ablations by name."""
