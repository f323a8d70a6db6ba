"""`viewmend samples`: make training samples ahead of a run."""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from viewmend.cli.train import Options as TrainOptions


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write training samples as tar shards, for `viewmend train --shards`; a recipe's own, made once for many runs.

    Of a recipe that trains rays alone, some pixels' rays are written, looked up: thousands of scenes fit in memory.
    """

    out: Path
    """Folder for shard-00000.tar and on."""
    count: int = 960
    """How many samples."""
    recipe: str = "small"
    """Whose kind of samples."""
    clip: int | None = None
    """Consecutive times in a sample, instead of the recipe's."""
    performers: Path | None = None
    """Folder of glTF characters for a share of the scenes; never one that is kept for tests."""
    motions: Path | None = None
    """Folder of BVH motions for them."""
    capture: tuple[Path, ...] = ()
    """Folders of captures of your own."""
    cameras: tuple[int, int] | None = None
    """Fewest and most cameras of the studio's rigs; 4 to 60."""
    workers: int = 2
    """Processes that make samples."""
    seed: int = 0
    """Of the scenes."""


def run(options: Options) -> int:
    """Make them, and say how fast that went."""
    import time

    from viewmend.cli.console import say, track
    from viewmend.cli.train import chosen_recipe
    from viewmend.training.replay import samples_in_order
    from viewmend.training.sample_files import write_shards
    from viewmend.training.sources import training_source

    if options.count < 1:
        raise ValueError(f"expected a count of at least 1, got {options.count}")
    if any(options.out.glob("shard-*.tar")):
        raise ValueError(f"{options.out}: expected no samples yet, found shards; choose another --out, or remove them")
    recipe = chosen_recipe(
        TrainOptions(
            recipe=options.recipe,
            clip=options.clip,
            performers=options.performers,
            motions=options.motions,
            capture=options.capture,
            cameras=options.cameras,
        ),
        None,
    )
    source = training_source(recipe, f"{options.seed}/0")
    began = time.monotonic()
    samples = islice((s for _, _, s in samples_in_order(source, 0, options.workers)), options.count)
    shards = list(write_shards(track(samples, "samples", options.count), options.out))
    rate = options.count / (time.monotonic() - began)
    size_mb = sum(path.stat().st_size for path in shards) / 1e6
    say(f"wrote {options.count} samples, {len(shards)} shards, {size_mb:.0f} MB to {options.out}: {rate:.1f} samples/s")
    return 0
