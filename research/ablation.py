"""The models of the paper's Table 3: the same training, each time without one part of the method.

    viewmend make-dataset paper-small --count 2000 --out SHARDS
    python research/pretrain_paper.py --shards SHARDS --out AUTOENCODER
    python research/ablation.py --shards SHARDS --start AUTOENCODER --out MODELS
    viewmend evaluate paper-table 3 P-long --models MODELS --protocol target-mask --score-background white --out TABLE

Repeat the third command to resume it.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from viewmend.models.checkpoint import load_network, save_inpainter
from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.training.config import TrainConfig
from viewmend.training.loop import train
from viewmend.training.paper import PaperObjectiveConfig
from viewmend.training.recipes import make_recipe

VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "no-rope": {"rope": False},
    "no-past": {"n_c": 0, "n_w": 0},
    "single-camera": {"num_source_views": 1},
    "single-camera-no-masks": {"num_source_views": 1, "use_mask": False},
}
"""What each variant changes in the model."""
MASK_CHANNEL = 3
FIRST_WEIGHT = "tokeniser.encoder.layers.0.weight"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Train all variants of `paper-small` from the same encoder and decoder."""

    shards: Path
    """Folder of samples by `viewmend make-dataset paper-small`."""
    start: Path
    """Folder of the patch autoencoder by research/pretrain_paper.py."""
    out: Path
    """Folder for the models: full-s0, no-rope-s0 ..."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings of each variant."""
    steps: int = 150
    """Steps of each training, of four samples."""


def variant_recipe(name: str, options: Options, seed: int) -> TrainConfig:
    """The training of a variant: the recipe `paper-small`, but short."""
    recipe = make_recipe("paper-small")
    assert isinstance(recipe.objective, PaperObjectiveConfig)
    model = replace(recipe.objective.model, **VARIANTS[name])
    return replace(
        recipe,
        name=name,
        objective=replace(recipe.objective, model=model),
        start=str(options.start if model.use_mask else start_without_masks(options.start, model)),
        shards=options.shards,
        steps=options.steps,
        batch=4,
        new_per_batch=4,
        replay_size=4,
        learning_rate=4e-4,
        warmup=20,
        ema=0.98,
        workers=0,
        validate_every=0,
        seed=seed,
    )


def start_without_masks(start: Path, config: PaperConfig) -> Path:
    """A copy of the autoencoder, next to it, whose encoder has no mask among its input channels."""
    folder = start.with_name(f"{start.name}-no-masks")
    weights = load_network(start).state_dict()
    first = weights[FIRST_WEIGHT]
    weights[FIRST_WEIGHT] = first[:, [n for n in range(first.shape[1]) if n != MASK_CHANNEL]]
    model = PatchTransformer(config)
    model.load_state_dict(weights)
    save_inpainter(model, folder, f"# {folder.name}\n\n{start.name} without the mask's input channel.\n")
    return folder


def run(options: Options) -> None:
    """Train all variants, the first seed of each before the second."""
    for seed in options.seeds:
        for name in VARIANTS:
            train(variant_recipe(name, options, seed), options.out / f"{name}-s{seed}")


if __name__ == "__main__":
    run(tyro.cli(Options))
