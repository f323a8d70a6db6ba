"""`viewmend make-dataset`: write training samples ahead of a run."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from viewmend.cli.checks import check_least
from viewmend.cli.train import check_scenes, split_recipe
from viewmend.training.config import ObjectiveConfig, SceneConfig
from viewmend.utils.options import FLAT, HIDDEN

PLAN = "plan.txt"
"""File with everything that determines the samples of a folder."""
POSITION = "next.json"
"""File with the position at which the samples of a folder end."""
Item = TypeVar("Item")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write training samples as tar files, for viewmend train RECIPE --shards: viewmend make-dataset RECIPE --out DIR.

    Samples are of the recipe's kind (views by default): compressed scenes for views, sampled rays
    of single pixels for rays, views with their context for the others. The same command resumes a
    run that was stopped.
    """

    recipe: Annotated[str, HIDDEN]
    objective: Annotated[ObjectiveConfig, HIDDEN]
    scenes: Annotated[SceneConfig, FLAT]
    out: Path = Path("out/dataset")
    """Folder for shard-00000.tar and so on."""
    count: int = 960
    """Number of samples, or of scenes for views."""
    workers: int = 1
    """Processes that generate samples."""
    seed: int = 0
    """Seed of the scenes and the samples."""


def parse(arguments: Sequence[str], prog: str) -> Options:
    """The options of a command line that begins with a recipe.

    Raises:
        ValueError: there is no such recipe, or an option has an impossible value.
    """
    import tyro

    from viewmend.training.recipes import make_recipe

    name, rest = split_recipe(arguments)
    config = make_recipe(name)
    default = Options(recipe=name, objective=config.objective, scenes=config.scenes, workers=config.workers)
    flags = (tyro.conf.FlagCreatePairsOff, tyro.conf.AvoidSubcommands)
    options = tyro.cli(Options, args=list(rest), default=default, prog=f"{prog} {name}", config=flags)
    check_least(options, count=1, workers=0)
    check_scenes(options.scenes)
    return options


def run(options: Options) -> int:
    """Write the samples that are missing, and print the rate."""
    from viewmend.utils.output_folder import OutputFolder

    with OutputFolder(options.out) as folder:
        _make(options)
        folder.record("shard-*.tar", PLAN, POSITION)
    return 0


def _make(options: Options) -> None:
    import json
    import time
    from itertools import islice

    from viewmend.cli.console import say, track
    from viewmend.training.replay import samples_in_order
    from viewmend.training.shards import write_shards
    from viewmend.utils.atomic_writes import write_text

    at = _position(options.out)
    source = options.objective.make_scenes(options.scenes, f"{options.seed}/0")
    _check_plan(options)
    count = options.count - at.samples
    if count <= 0:
        say(f"{options.out}: already holds {at.samples} samples")
        return
    began = time.monotonic()
    shards = []
    samples = islice(_missing(at, samples_in_order(source, at.scene, options.workers)), count)
    for shard in write_shards(
        track(samples, "samples", count), options.out, options.objective.shard_size, at.shards
    ):
        shards.append(shard)
        at.shards += 1
        write_text(options.out / POSITION, json.dumps(asdict(at)))
    rate = count / (time.monotonic() - began)
    size_mb = sum(path.stat().st_size for path in shards) / 1e6
    say(
        f"wrote {count} samples in {len(shards)} shards, {size_mb:.0f} MB, to {options.out}: {rate:.1f} samples/s"
    )


@dataclass(kw_only=True)
class Position:
    """Where the samples of a folder end."""

    shards: int = 0
    samples: int = 0
    scene: int = 0
    """Number of the next scene."""
    sample: int = 0
    """Samples of that scene that are already written."""


def _missing(at: Position, numbered: Iterator[tuple[int, int, Item]]) -> Iterator[Item]:
    """The samples that are not written yet; advances `at` with them."""
    skipped = at.sample
    for scene, number, sample in numbered:
        if scene > at.scene:
            at.scene = scene
            at.sample = 0
            skipped = 0
        if number >= skipped:
            at.sample = number + 1
            at.samples = at.samples + 1
            yield sample


def _position(out: Path) -> Position:
    """Where the folder's samples end, as recorded; a shard beyond that is written again.

    Raises:
        ValueError: there are shards without a record, fewer than recorded, or with a gap in their numbers.
    """
    from viewmend.training.shards import shards_of
    from viewmend.utils.untrusted_input import bounded_bytes, read_json, typed

    names = [path.name for path in shards_of(out) if path.name.startswith("shard-")]
    file = out / POSITION
    for number, name in enumerate(names):
        if name != f"shard-{number:05d}.tar":
            raise ValueError(
                f"{out}: expected shard-{number:05d}.tar before {name}, found none; restore it, or choose another --out"
            )
    if not names:
        return Position()
    if not file.exists():
        raise ValueError(f"{out}: expected no shards without {POSITION}, found some; choose another --out")
    at = typed(read_json(bounded_bytes(file)), Position, f"remove {out}")
    if not (0 <= at.shards <= len(names) and min(at.samples, at.scene, at.sample) >= 0):
        raise ValueError(f"{file}: expected {at.shards} shards, found {len(names)}; choose another --out")
    return at


def _check_plan(options: Options) -> None:
    """Write the plan of a new folder, or compare it with the one that is there.

    Raises:
        ValueError: the folder's samples were made with other options.
    """
    from viewmend.utils.atomic_writes import write_text

    file = options.out / PLAN
    plan = f"{options.recipe}, seed {options.seed}, {options.scenes}, {options.objective.sampling}\n"
    if not file.exists():
        write_text(file, plan)
    elif (found := file.read_text("utf-8", "replace")) != plan:
        raise ValueError(
            f"{options.out}: expected samples with the same options and seed, found {found.strip()}; pass the options "
            "that the folder was begun with, or choose another --out"
        )
