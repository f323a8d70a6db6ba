"""The ablation of the paper's model at small widths: what each part of the method is worth.

    python research/ablation.py --out out/ablation

Samples are made once. Every variant is trained on them with several seeds and the same number of steps, and evaluated
on the first scenes of the procedural test set, on white. OUT gets samples/, models/, cells/, ablation.md, .json and
.svg. The same command resumes an interrupted run.
"""

import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import tyro

from viewmend.cli.console import say, show, track
from viewmend.cli.evaluate import report_folder
from viewmend.data.holdout.studio_scenes import procedural_set
from viewmend.evaluation.averages import Records, Row, gains, mean, records, tables
from viewmend.evaluation.result_cache import Cell, CellStore
from viewmend.evaluation.runner import process_pool, run_evaluation
from viewmend.evaluation.scene_run import RunSettings
from viewmend.models.checkpoint import load_network, save_inpainter
from viewmend.models.paper.config import paper_small
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.training.config import SceneConfig, TrainConfig
from viewmend.training.loop import train
from viewmend.training.paper import SAMPLING, PaperObjectiveConfig
from viewmend.training.replay import samples_in_order
from viewmend.training.scenes import sample_scenes
from viewmend.training.shards import write_shards
from viewmend.utils.atomic_writes import write_text

VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "no-rope": {"rope": False},
    "no-past": {"n_c": 0, "n_w": 0},
    "single-camera": {"num_source_views": 1},
    "single-camera-no-masks": {"num_source_views": 1, "use_mask": False},
    "no-depth": {"use_depth": False},
    "no-pruning": {"top_k": None},
    "black": {"background": "black"},
    "two-cameras": {"num_source_views": 2},
    "four-cameras": {"num_source_views": 4},
    "five-cameras": {"num_source_views": 5},
}
"""What each variant changes in the model; the first five are those of the paper's Table 3."""
MAX_SOURCE_VIEWS = 5
"""Source views of the samples, so that one set of samples serves all variants."""
TOP_K = (64, 128, 256, 512, 1024)
"""Numbers of context tokens with which the full model is also evaluated."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Train and evaluate all variants."""

    out: Path
    """Folder for all files."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Variants to compare with the full model."""
    seeds: int = 2
    """Trainings of each variant."""
    samples: int = 480
    """Number of samples."""
    steps: int = 300
    """Steps of each training."""
    scenes: int = 12
    """Scenes of the evaluation."""
    frames: int = 4
    """Frames of each scene."""
    size: int = 320
    """Width and height of the evaluated views."""
    performers: Path | None = None
    """Folder of glTF characters for half of the samples."""
    motions: Path | None = None
    """Folder of BVH motions for them."""
    jobs: int = 2
    """Processes that make samples, train and evaluate."""


@dataclass(frozen=True)
class Trained:
    """A model of the ablation."""

    variant: str
    seed: int
    folder: Path
    top_k: int | None = None
    """Context tokens kept by pruning, if not the variant's own number."""


@dataclass(frozen=True)
class Line:
    """The results of a variant, or of the full model with another top-k. Tuples have one value per seed."""

    name: str
    holes: tuple[float | None, ...]
    """PSNR in the holes, dB."""
    whole: tuple[float | None, ...]
    """PSNR of whole images, dB."""
    ms: float | None
    """Median time of a step."""
    loss: tuple[float | None, ...]
    """Loss in the holes against the full model of the same seed, dB."""
    loss_by_style: dict[str, float | None]
    """The same by style of the scenes, mean over the seeds."""


@dataclass(frozen=True)
class Ablation:
    """All results."""

    telea: float | None
    """PSNR of OpenCV's Telea in the holes, dB."""
    scenes: int
    variants: tuple[Line, ...]
    top_k: tuple[Line, ...]
    """The full model, from the fewest context tokens to its own number."""


def variant_recipe(name: str, options: Options, seed: int) -> TrainConfig:
    """The training of a variant, on rigs of few cameras, whose views have large holes."""
    return TrainConfig(
        name=name,
        objective=PaperObjectiveConfig(
            model=replace(paper_small(), **VARIANTS[name]),
            sampling=replace(SAMPLING, min_context_views=MAX_SOURCE_VIEWS, min_hole_px=250),
        ),
        scenes=SceneConfig(
            cameras=(5, 9),
            sizes_px=(192,),
            imperfect_fraction=0.0,
            performers=options.performers,
            motions=options.motions,
        ),
        shards=options.out / "samples",
        steps=options.steps,
        batch=4,
        new_per_batch=4,
        replay_size=1,
        learning_rate=4e-4,
        ema=0.998,
        workers=0,
        validate_every=0,
        seed=seed,
    )


def run(options: Options) -> int:
    """Run the ablation; returns 1 if an evaluation failed, else 0."""
    import matplotlib  # noqa: F401 (before days of training)

    if unknown := [name for name in options.variants if name not in VARIANTS]:
        raise ValueError(f"expected variants among {', '.join(VARIANTS)}, got {', '.join(unknown)}; see --help")
    names = dict.fromkeys(["full", *options.variants])
    recipes = [variant_recipe(name, options, seed) for seed in range(options.seeds) for name in names]
    with report_folder(options.out):
        _make_samples(options, recipes[0])
        trained = _train(options, recipes)
        cells = _evaluate(options, trained)
        ablation = summarise(trained, cells)
        texts = {
            "md": markdown(ablation),
            "json": json.dumps(asdict(ablation), indent=1) + "\n",
            "svg": plots(ablation),
        }
        for suffix, text in texts.items():
            write_text(options.out / f"ablation.{suffix}", text)
    say(f"wrote {options.out}")
    show(*texts["md"].rstrip().split("\n"))
    return 1 if any(cell.error is not None for cell in cells) else 0


def _make_samples(options: Options, recipe: TrainConfig) -> None:
    """Write the samples, unless they are complete."""
    folder, done = options.out / "samples", options.out / "samples/done"
    made_of = f"{options.samples} samples, {recipe.scenes}"
    if done.exists():
        if done.read_text() != made_of:
            raise ValueError(f"{folder}: expected {made_of}, found {done.read_text()!r}; choose another --out")
        return
    source = sample_scenes(recipe.scenes, recipe.objective.sampling, "ablation")
    samples = (sample for _, _, sample in islice(samples_in_order(source, 0, options.jobs), options.samples))
    for _ in write_shards(track(samples, "samples", options.samples), folder):
        pass
    write_text(done, made_of)


def _train(options: Options, recipes: Sequence[TrainConfig]) -> list[Trained]:
    """Train all variants, and add the full models with other values of top-k."""
    jobs = [(recipe, options.out / "models" / f"{recipe.name}-s{recipe.seed}") for recipe in recipes]
    with process_pool(options.jobs, threads=1) as pool:
        for _ in track(pool.map(train, *zip(*jobs, strict=True)), "training", len(jobs)):
            pass
    trained = [Trained(recipe.name, recipe.seed, folder) for recipe, folder in jobs]
    for full in [one for one in trained if one.variant == "full"]:
        for top_k in TOP_K:
            folder = full.folder.with_name(f"{full.folder.name}-k{top_k}")
            model = load_network(full.folder)
            assert isinstance(model, PatchTransformer)
            model.config = replace(model.config, top_k=top_k)
            save_inpainter(model, folder, f"# {folder.name}\n\n{full.folder.name} with top_k {top_k}.\n")
            trained.append(Trained("full", full.seed, folder, top_k))
    return trained


def _evaluate(options: Options, trained: Sequence[Trained]) -> list[Cell]:
    scenes = procedural_set(options.frames, options.size)[: options.scenes]
    methods = ("telea", *(str(one.folder) for one in trained))
    settings = RunSettings(background="white")
    steps = run_evaluation(scenes, methods, CellStore(options.out / "cells"), settings, options.jobs)
    cells = list(track((cell for found in steps for cell in found), "evaluating", len(scenes) * len(methods)))
    for cell in cells:
        if cell.error is not None:
            say(f"{cell.key.scene}, {cell.key.method}: failed: {cell.error}")
    return cells


def summarise(trained: Sequence[Trained], cells: Sequence[Cell]) -> Ablation:
    """The results from the cells of all models and of Telea."""
    methods = ["telea", *(str(one.folder) for one in trained)]
    scores = records(cells)
    rows = {row.method: row for row in tables(cells, methods)[0].rows}
    own_k = [one for one in trained if one.top_k is None]
    full = [one for one in trained if one.variant == "full"]
    counts = sorted({one.top_k for one in full if one.top_k is not None})
    return Ablation(
        telea=rows["telea"].scores.mean("psnr", "holes"),
        scenes=len({cell.key.scene for cell in cells}),
        variants=tuple(
            _line(name, [one for one in own_k if one.variant == name], own_k, rows, scores)
            for name in dict.fromkeys(one.variant for one in own_k)
        ),
        top_k=tuple(
            _line("own" if k is None else str(k), [one for one in full if one.top_k == k], own_k, rows, scores)
            for k in (*counts, None)
        ),
    )


def _line(
    name: str, models: Sequence[Trained], own_k: Sequence[Trained], rows: dict[str, Row], scores: Records
) -> Line:
    own = [rows[str(one.folder)] for one in models]
    full = {one.seed: str(one.folder) for one in own_k if one.variant == "full"}
    losses = [_losses(str(one.folder), full[one.seed], scores) for one in models]
    styles = sorted({record.style for record in scores})
    return Line(
        name=name,
        holes=tuple(row.scores.mean("psnr", "holes") for row in own),
        whole=tuple(row.scores.mean("psnr", "whole") for row in own),
        ms=mean([row.speed.ms_p50 if row.speed else None for row in own]),
        loss=tuple(mean([loss for _, loss in each]) for each in losses),
        loss_by_style={
            style: mean([mean([loss for s, loss in each if s == style]) for each in losses]) for style in styles
        },
    )


def _losses(method: str, full: str, scores: Records) -> list[tuple[str, float]]:
    """Style and loss of each scene that both methods have."""
    own = scores.where(method=method)
    styles = {record.scene: record.style for record in own}
    return [(styles[scene], loss) for scene, loss in gains(scores.where(method=full), own).items()]


def markdown(ablation: Ablation) -> str:
    """Two tables: the variants, and the full model by top-k."""
    styles = list(ablation.variants[0].loss_by_style)
    header = ["variant", "holes, dB", "loss against full", *(f"loss, {style}" for style in styles), "whole, dB", "ms"]
    lines = [
        f"{ablation.scenes} scenes of P, on white. Telea: {_number(ablation.telea)} dB in the holes. Values of the "
        "seeds after their mean.",
        "",
    ]
    lines += _table(header, [_cells(line, styles) for line in ablation.variants])
    lines += ["", "The full model by the number of context tokens that pruning keeps:", ""]
    lines += _table(["top-k", *header[1:]], [_cells(line, styles) for line in ablation.top_k])
    return "\n".join(lines) + "\n"


def _cells(line: Line, styles: Sequence[str]) -> list[str]:
    by_style = [_number(line.loss_by_style.get(style)) for style in styles]
    return [line.name, _per_seed(line.holes), _per_seed(line.loss), *by_style, _per_seed(line.whole), _number(line.ms)]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]


def _per_seed(values: Sequence[float | None]) -> str:
    return f"{_number(mean(values))} ({', '.join(map(_number, values))})"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def plots(ablation: Ablation) -> str:
    """An SVG of two plots: the loss of each variant, a dot per seed, and quality against time by top-k."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    variants = ablation.variants[1:]
    points = [(line.name, line.ms, mean(line.holes)) for line in ablation.top_k]
    points = [(name, ms, db) for name, ms, db in points if ms is not None and db is not None]
    with rc_context({"svg.hashsalt": "viewmend", "svg.fonttype": "none", "font.size": 12}):
        figure = Figure((12, 2 + 0.35 * len(variants)), dpi=72, layout="constrained")
        left, right = figure.subplots(1, 2)
        left.set(title="loss in the holes against full, dB", xlabel="dB", yticks=range(len(variants)))
        left.set_yticklabels([line.name for line in variants])
        left.invert_yaxis()
        left.axvline(0, color="#888888", linewidth=1)
        for n, line in enumerate(variants):
            values = [value for value in line.loss if value is not None]
            left.plot(values, [n] * len(values), "o", color="#d33333", gid=f"variant{n}")
        right.set(title="full by top-k", xlabel="milliseconds of a step, median", ylabel="PSNR in the holes, dB")
        right.plot([ms for _, ms, _ in points], [db for _, _, db in points], "o-", color="#3366cc", gid="top-k")
        for name, ms, db in points:
            right.annotate(name, (ms, db), (6, 6), textcoords="offset points")
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return file.getvalue()[file.getvalue().index("<svg ") :]


if __name__ == "__main__":
    raise SystemExit(run(tyro.cli(Options)))
