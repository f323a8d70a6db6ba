"""`viewmend samples`: make training samples ahead of a run."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

from viewmend.cli import recipe_options
from viewmend.training.plan import FLAT, Recipe, WholeViewRecipe

if TYPE_CHECKING:
    from viewmend.training.sample_files import Stored

SAMPLES_A_SHARD, SCENES_A_SHARD = 48, 16
PLAN = "plan.txt"
"""What the scenes of a folder are made by."""
POSITION = "next.json"
"""Where samples of scenes that have several go on."""
Item = TypeVar("Item")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write training samples as tar shards: viewmend samples RECIPE --out DIR [options].

    They are the recipe's own kind of samples (small by default), made once for many runs of `viewmend train --shards`.
    Of a recipe that trains rays alone, some pixels' rays are written, looked up: thousands of scenes fit in memory.
    Of one that trains whole views (views), scenes are written, compressed. Of tokens, windows whose context --encoder
    encodes, made anew or taken from --shards, all before any again. A run that was stopped goes on.
    Every value of the recipe is an option, as in `viewmend train`.
    """

    recipe: Annotated[Recipe, FLAT]
    out: Path
    """Folder for shard-00000.tar and on."""
    count: int = 960
    """How many samples."""
    encoder: str | None = None
    """Name or folder of a model: context is written as its encoder makes it, for viewmend train tokens --from it."""


def parse(arguments: Sequence[str], prog: str) -> Options:
    """The options of a command line that begins with a recipe."""
    return recipe_options.parse(partial(Options, out=Path("out/samples")), arguments, prog)


def run(options: Options) -> int:
    """Make them, and say how fast that went."""
    from viewmend.output_folder import OutputFolder

    if options.count < 1:
        raise ValueError(f"expected a count of at least 1, got {options.count}")
    with OutputFolder(options.out) as folder:
        code = _make(options)
        folder.made("shard-*.tar", PLAN, POSITION)
    return code


def _make(options: Options) -> int:
    import json
    import time

    from viewmend.atomic_writes import write_text
    from viewmend.cli.console import say, track
    from viewmend.training.replay import samples_in_order
    from viewmend.training.sample_files import write_shards
    from viewmend.training.sources import stored_source, training_source

    recipe, encoding = options.recipe, _encoding(options)
    whole = isinstance(recipe, WholeViewRecipe)
    per_shard = SCENES_A_SHARD if whole else SAMPLES_A_SHARD
    at = _position(options.out, per_shard if whole else None)
    _demand_same(options.out, recipe, options.encoder)
    count = options.count - at.samples
    if count <= 0:
        say(f"{options.out}: {at.samples} samples are there already")
        return 0
    seed = f"{recipe.seed}/0"
    source = stored_source(recipe, seed) if whole else training_source(recipe, seed)
    began = time.monotonic()
    samples = map(encoding, islice(_from(at, samples_in_order(source, at.scene, recipe.workers)), count))
    shards = []
    for shard in write_shards(track(samples, "samples", count), options.out, per_shard, at.shards):
        shards.append(shard)
        at.shards += 1
        if not whole:
            write_text(options.out / POSITION, json.dumps(asdict(at)))
    rate = count / (time.monotonic() - began)
    size_mb = sum(path.stat().st_size for path in shards) / 1e6
    say(f"wrote {count} samples, {len(shards)} shards, {size_mb:.0f} MB to {options.out}: {rate:.1f} samples/s")
    return 0


def _encoding(options: Options) -> "Callable[[Stored], Stored]":
    """What is done to each sample before it is written.

    Raises:
        ValueError: a recipe wants what another encodes, and nothing says what; or what is said encodes no patches.
    """
    if (options.recipe.part == "tokens") != (options.encoder is not None):
        raise ValueError(
            f"expected --encoder MODEL for tokens, and for nothing else, got {options.encoder or 'none'} for "
            f"{options.recipe.name}"
        )
    if options.encoder is None:
        return lambda sample: sample
    import torch

    from viewmend.inpainting.checkpoint import load_network
    from viewmend.inpainting.network import set_compute_dtype
    from viewmend.inpainting.patch_transformer import PatchTransformer
    from viewmend.training.from_tokens import encoded
    from viewmend.training.samples import Sample

    net = load_network(options.encoder)
    if not isinstance(net, PatchTransformer):
        raise ValueError(f"expected a model of patches alone to encode with, got {options.encoder}; train copies")
    set_compute_dtype(net.eval(), torch.bfloat16 if options.recipe.bfloat16 else torch.float32)
    return lambda sample: encoded(net, sample) if isinstance(sample, Sample) else sample


@dataclass(kw_only=True)
class Position:
    """Where a folder's samples end."""

    shards: int = 0
    samples: int = 0
    scene: int = 0
    """The scene to go on with."""
    sample: int = 0
    """How many of its samples are there."""


def _from(at: Position, numbered: Iterator[tuple[int, int, Item]]) -> Iterator[Item]:
    """The samples that are not there yet; `at` moves on with them."""
    skipped = at.sample
    for scene, number, sample in numbered:
        if scene > at.scene:
            at.scene, at.sample, skipped = scene, 0, 0
        if number >= skipped:
            at.sample, at.samples = number + 1, at.samples + 1
            yield sample


def _position(out: Path, per_shard: int | None) -> Position:
    """Where the folder's samples end: a scene each, so many a shard; or by what was written down, for None.

    A shard beyond what was written down is made again.

    Raises:
        ValueError: there are shards of which nothing was written down, or fewer; or one is missing between others.
    """
    from viewmend.foreign_input import bounded_bytes
    from viewmend.json_input import read_json, typed

    there, file = _count_there(out), out / POSITION
    if per_shard is not None:
        return Position(shards=there, samples=there * per_shard, scene=there * per_shard)
    if not there:
        return Position()
    if not file.exists():
        raise ValueError(f"{out}: expected no samples yet, found shards; choose another --out, or remove them")
    at = typed(read_json(bounded_bytes(file)), Position, f"remove {out}")
    if not (0 <= at.shards <= there and min(at.samples, at.scene, at.sample) >= 0):
        raise ValueError(f"{file}: expected {at.shards} shards, found {there}; choose another --out, or remove them")
    return at


def _count_there(out: Path) -> int:
    """How many shards there are.

    Raises:
        ValueError: one is missing between others, so that the next would take another's name.
    """
    from viewmend.training.sample_files import shards_of

    names = [path.name for path in shards_of(out) if path.name.startswith("shard-")]
    for number, name in enumerate(names):
        if name != f"shard-{number:05d}.tar":
            raise ValueError(
                f"{out}: expected shard-{number:05d}.tar before {name}, found none; rename those behind it, or choose "
                "another --out"
            )
    return len(names)


def _demand_same(out: Path, recipe: Recipe, encoder: str | None) -> None:
    """Write down what the folder's scenes are made by, or compare with what was.

    Raises:
        ValueError: they are made by another plan or seed.
    """
    from viewmend.atomic_writes import write_text

    by = "" if encoder is None else f", encoded by {encoder}"
    plan, file = f"seed {recipe.seed}, {recipe.data}{by}\n", out / PLAN
    if not file.exists():
        write_text(file, plan)
    elif file.read_text() != plan:
        raise ValueError(
            f"{out}: expected scenes of the same plan and seed, got {file.read_text().strip()}; give the options that "
            "they were begun with, or choose another --out"
        )
