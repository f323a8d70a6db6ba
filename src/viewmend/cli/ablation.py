"""`viewmend ablation`: train every variant by equal budgets, evaluate all on one set, write table and plots."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viewmend.evaluation.ablation_report import Trained
    from viewmend.evaluation.cells import Cell
    from viewmend.training.plan import Recipe

TOP_K = (64, 128, 256, 512, 1024)
"""Numbers of context tokens at which the full model is tried besides all."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """The ablation: what each part of the method is worth.

    Samples are made once; every variant of the paper's model, at small widths, is trained on them from every seed by
    the same number of steps, and evaluated on the first scenes of P, upon white. OUT gets samples/, models/, cells/,
    ablation.md, .json and .svg. The same command goes on with what was stopped.
    """

    out: Path
    """Folder for all that is written."""
    variants: str = "all"
    """Names with commas, or all; full is always among them."""
    seeds: int = 2
    """How many times each is trained."""
    samples: int = 480
    """How many samples are made."""
    steps: int | None = None
    """Steps of each training, instead of the recipe's."""
    scenes: int = 12
    """How many scenes of P are evaluated."""
    frames: int = 4
    """Frames of each scene."""
    size: int = 320
    """Width and height of their views."""
    performers: Path | None = None
    """Folder of glTF characters for half of the samples; never one that is kept for tests."""
    motions: Path | None = None
    """Folder of BVH motions for them."""
    jobs: int = 2
    """Processes that make samples, train and evaluate."""


def run(options: Options) -> int:
    """Run the command; 1 if an evaluation failed, else 0."""
    from viewmend.atomic_writes import write_text
    from viewmend.cli.console import say, show
    from viewmend.cli.evaluating import report_folder
    from viewmend.evaluation.ablation_report import Ablation, markdown, plots, to_json
    from viewmend.evaluation.report_plot import require_matplotlib

    require_matplotlib()  # now, and not after days of training
    recipes = _recipes(options)
    with report_folder(options.out):
        _make_samples(options, next(iter(recipes.values())))
        trained = _train(options, recipes)
        cells = _evaluate(options, trained)
        ablation = Ablation.of(trained, cells)
        for suffix, text in {"md": markdown(ablation), "json": to_json(ablation), "svg": plots(ablation)}.items():
            write_text(options.out / f"ablation.{suffix}", text)
    say(f"wrote {options.out}")
    show(*markdown(ablation).rstrip().split("\n"))
    return 1 if any(cell.error is not None for cell in cells) else 0


def _recipes(options: Options) -> "dict[str, Recipe]":
    """Variant and seed -> recipe."""
    from viewmend.cli.checks import check_people
    from viewmend.training.ablations import ABLATIONS
    from viewmend.training.plan import DataPlan

    names = list(ABLATIONS) if options.variants == "all" else [n.strip() for n in options.variants.split(",")]
    unknown = [n for n in names if n not in ABLATIONS]
    wrong = [n for n in ("seeds", "samples", "scenes", "frames", "size", "jobs") if getattr(options, n) < 1]
    if unknown or wrong:
        raise ValueError(
            f"expected variants among {', '.join(ABLATIONS)} and positive numbers, got {', '.join(unknown + wrong)}; "
            "see --help"
        )
    check_people(options.performers, options.motions)
    data = DataPlan(performers=options.performers, motions=options.motions)
    found = {}
    for seed in range(options.seeds):
        for name in dict.fromkeys(["full", *names]):
            recipe = replace(ABLATIONS[name](data), seed=seed)
            steps = recipe.steps if options.steps is None else options.steps
            found[f"{name}-s{seed}"] = replace(recipe, steps=steps)
    return found


def _make_samples(options: Options, recipe: "Recipe") -> None:
    """Write the samples, unless all are there."""
    from itertools import islice

    from viewmend.atomic_writes import write_text
    from viewmend.cli.console import track
    from viewmend.training.replay import samples_in_order
    from viewmend.training.sample_files import write_shards
    from viewmend.training.sources import scene_source

    folder, done = options.out / "samples", options.out / "samples/done"
    made_of = f"{options.samples} samples, {options.performers}, {options.motions}"
    if done.exists():
        if done.read_text() != made_of:
            raise ValueError(
                f"{folder}: expected {made_of}, got {done.read_text()[:200]!r}; give the options that they were made "
                "with, or choose another --out"
            )
        return
    made = samples_in_order(scene_source(recipe.data, "ablation"), 0, options.jobs)
    samples = (sample for _, _, sample in islice(made, options.samples))
    for _ in write_shards(track(samples, "samples", options.samples), folder):
        pass
    write_text(done, made_of)


def _train(options: Options, recipes: "dict[str, Recipe]") -> "list[Trained]":
    """Train what is not trained yet; the full models come with one folder more for each top-k."""
    from viewmend.cli.console import track
    from viewmend.evaluation.ablation_report import Trained
    from viewmend.evaluation.runner import process_pool

    jobs = [
        (replace(recipe, data=replace(recipe.data, shards=options.out / "samples")), options.out / "models" / name)
        for name, recipe in recipes.items()
    ]
    with process_pool(options.jobs, threads=1) as pool:
        for _ in track(pool.map(_train_one, jobs), "training", len(jobs)):
            pass
    trained = [Trained(recipe.name, recipe.seed, folder) for recipe, folder in jobs]
    for full in [one for one in trained if one.variant == "full"]:
        for top_k in TOP_K:
            folder = full.folder.with_name(f"{full.folder.name}-k{top_k}")
            _with_top_k(full.folder, folder, top_k)
            trained.append(Trained("full", full.seed, folder, top_k))
    return trained


def _train_one(job: "tuple[Recipe, Path]") -> None:
    from viewmend.training.loop import train

    train(*job)


def _with_top_k(source: Path, target: Path, top_k: int) -> None:
    """The same model that prunes its context to `top_k` tokens."""
    from viewmend.inpainting.checkpoint import load_network, save_inpainter
    from viewmend.training.loop import NETWORKS

    model = load_network(source)
    assert isinstance(model, NETWORKS), "variants have a transformer"
    model.config = replace(model.config, top_k=top_k)
    save_inpainter(model, target, f"# {target.name}\n\n{source.name} with top_k {top_k}.\n")


def _evaluate(options: Options, trained: "list[Trained]") -> "list[Cell]":
    from viewmend.cli.console import say, track
    from viewmend.evaluation.cells import CellStore
    from viewmend.evaluation.runner import run_evaluation
    from viewmend.evaluation.scene_run import RunSettings
    from viewmend.leave_one_out.studio_scenes import procedural_set

    scenes = procedural_set(options.frames, options.size)[: options.scenes]
    methods = ("telea", *(str(one.folder) for one in trained))
    settings = RunSettings(background="white")
    steps = run_evaluation(scenes, methods, CellStore(options.out / "cells"), settings, options.jobs)
    cells = list(track((cell for found in steps for cell in found), "evaluating", len(scenes) * len(methods)))
    for cell in cells:
        if cell.error is not None:
            say(f"{cell.key.scene}, {cell.key.method}: failed: {cell.error}")
    return cells
