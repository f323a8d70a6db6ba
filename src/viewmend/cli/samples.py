"""`viewmend samples`: make training samples ahead of a run."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated

from viewmend.cli import recipe_options
from viewmend.training.plan import FLAT, Recipe


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write training samples as tar shards: viewmend samples RECIPE --out DIR [options].

    They are the recipe's own kind of samples (small by default), made once for many runs of `viewmend train --shards`.
    Of a recipe that trains rays alone, some pixels' rays are written, looked up: thousands of scenes fit in memory.
    Every value of the recipe is an option, as in `viewmend train`.
    """

    recipe: Annotated[Recipe, FLAT]
    out: Path
    """Folder for shard-00000.tar and on."""
    count: int = 960
    """How many samples."""


def parse(arguments: Sequence[str], prog: str) -> Options:
    """The options of a command line that begins with a recipe."""
    return recipe_options.parse(partial(Options, out=Path("out/samples")), arguments, prog)


def run(options: Options) -> int:
    """Make them, and say how fast that went."""
    import time

    from viewmend.cli.console import say, track
    from viewmend.training.replay import samples_in_order
    from viewmend.training.sample_files import write_shards
    from viewmend.training.sources import training_source

    if options.count < 1:
        raise ValueError(f"expected a count of at least 1, got {options.count}")
    if any(options.out.glob("shard-*.tar")):
        raise ValueError(f"{options.out}: expected no samples yet, found shards; choose another --out, or remove them")
    recipe = options.recipe
    source = training_source(recipe, f"{recipe.seed}/0")
    began = time.monotonic()
    samples = islice((s for _, _, s in samples_in_order(source, 0, recipe.workers)), options.count)
    shards = list(write_shards(track(samples, "samples", options.count), options.out))
    rate = options.count / (time.monotonic() - began)
    size_mb = sum(path.stat().st_size for path in shards) / 1e6
    say(f"wrote {options.count} samples, {len(shards)} shards, {size_mb:.0f} MB to {options.out}: {rate:.1f} samples/s")
    return 0
