"""`viewmend train`: run a recipe."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Train a model on the studio; the averaged weights and a log are written to --out."""

    recipe: Annotated[str, tyro.conf.Positional] = "small"
    """Name of the recipe."""
    out: Path = Path("out/train")
    """Folder for model.safetensors, config.json and log.jsonl."""
    performers: Path | None = None
    """Folder of glTF characters for a share of the scenes; never one that is kept for tests."""
    motions: Path | None = None
    """Folder of BVH motions for them."""
    start: str | None = None
    """Name or folder of a model to go on from."""
    steps: int | None = None
    """Instead of the recipe's."""
    minutes: float | None = None
    """Instead of the recipe's."""
    log_error_weight: float | None = None
    """Weight of the logarithm of the squared error in the holes, instead of the recipe's."""
    seed: int = 0
    """Of weights and scenes."""


def run(options: Options) -> int:
    """Train, with a line on standard error every twenty steps."""
    from viewmend.cli.console import say
    from viewmend.inpainting.checkpoint import load_inpainter
    from viewmend.training.loop import Progress, train
    from viewmend.training.recipes import RECIPES

    if options.recipe not in RECIPES:
        raise ValueError(f"expected a recipe among {', '.join(RECIPES)}, got '{options.recipe}'")
    recipe = RECIPES[options.recipe](options.performers, options.motions)
    recipe = replace(
        recipe,
        seed=options.seed,
        steps=options.steps or recipe.steps,
        minutes=options.minutes or recipe.minutes,
        log_error_weight=recipe.log_error_weight if options.log_error_weight is None else options.log_error_weight,
    )

    def report(entry: Progress) -> None:
        if entry.step % 20 == 19:
            rate = (entry.step + 1) * recipe.batch / entry.elapsed_s
            say(
                f"step {entry.step + 1}, {100 * entry.progress:.0f} %: L_in {entry.inside:.4f}, "
                f"L_out {entry.outside:.4f}, {rate:.2f} samples/s"
            )

    start = load_inpainter(options.start) if options.start is not None else None
    train(recipe, options.out, start, report)
    say(f"wrote {options.out}")
    return 0
