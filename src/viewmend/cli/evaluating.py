"""What the commands that evaluate share: their options, the scenes that these mean, and the run."""

from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from viewmend.cli.checks import check_device

if TYPE_CHECKING:
    from collections.abc import Iterator

    from viewmend.evaluation.cells import Cell, CellStore
    from viewmend.evaluation.report import Report
    from viewmend.evaluation.scene_run import RunSettings
    from viewmend.leave_one_out.scenes import LeaveOneOutScene

WRITTEN = (*(f"{n}.*" for n in ("report", "table1", "table2", "table3", "ablation")), "sheets/*.png")
"""What is written besides cells, models and samples."""
LONG_SETS = ("P-long", "Q-long", "P-turn")
POSITIVE = ("frames", "every", "scenes", "size", "jobs", "closest", "shown")


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Scenes, and how they are run."""

    out: Path
    """Folder for the results."""
    weights: Path | None = None
    """Folder of published weights, looked in first; what lacks its weights is n/a (see viewmend weights)."""
    performers: Path | None = None
    """Folder of the people of Q: glTF characters in it or in its test/, BVH motions in its motions/test/, motions/ or
    beside them."""
    motions: Path | None = None
    """Folder of BVH motions, if they are elsewhere."""
    kind: str | None = None
    """The capture's format, as docs/formats.md names it; by default it is recognised."""
    inputs: str = "all"
    """How many cameras of a capture are looked at: all, or a number of them, evenly around; several with commas."""
    closest: int = 3
    """How many of these colour a view: the closest to it."""
    error_rule: str | None = None
    """What all methods are asked to mend: 'unseen', the pixels that no camera colours; 'all' of the subject, which is
    for methods that keep by themselves what is right; 'wrong', what a model takes for wrong; or FILE.py:NAME. By
    default each is asked for what it is made for. Scores in the holes are of the same pixels by every rule."""
    wrong_fraction: float = 0.15
    """Error rule 'wrong': at most this part of the subject is mended, beside what no camera colours."""
    frames: int | None = None
    """Frames of each scene, from the first. By default 10 of P and Q, all of a capture. Long sets have 41, of which the
    last 10 are scored."""
    every: int = 1
    """Only every n-th scene of each set is taken: a quick look at all kinds of scenes."""
    scenes: int | None = None
    """Only so many scenes of each set are taken, after `every`."""
    size: int = 512
    """Width and height of the views of P, Q and the long sets."""
    background: Literal["black", "stage"] = "black"
    """What stands behind the people of P: a stage for models that are not given masks."""
    score_background: Literal["black", "white"] = "black"
    """What views and truth lie upon when they are scored. The paper's figures are upon white; figures of whole images
    upon one and the other do not compare."""
    ssim: Literal["gaussian", "uniform7"] = "gaussian"
    """Windows of SSIM: Gaussian of 11 x 11 pixels, or uniform of 7 x 7."""
    jobs: int = 1
    """Processes that share the work. Milliseconds are only comparable within a run."""
    ray: str | None = None
    """Address of a Ray cluster that does the work instead: HOST:PORT, auto, or local (needs viewmend[ray])."""
    device: str = "cpu"
    """Where to compute: cpu, or cuda."""
    precision: Literal["float32", "bfloat16", "auto"] = "float32"
    """Numbers that our networks compute with."""
    shown: int = 12
    """How many scenes of each set the report's page shows in pictures; sheets/ has them all."""
    video: bool = True
    """Put short videos into the report's page (needs viewmend[video]; pictures side by side without)."""


@dataclass(frozen=True)
class Evaluated:
    """What came out."""

    report: "Report"
    cells: "list[Cell]"
    store: "CellStore"

    @property
    def failed(self) -> bool:
        """Whether any cell failed."""
        return any(cell.error is not None for cell in self.cells)


@contextmanager
def report_folder(out: Path) -> "Iterator[None]":
    """OUT for this run alone; a folder of cells from before there were manifests is ours.

    Raises:
        ValueError: another run writes there, or somebody else's file has the name of one that will be written.
    """
    from viewmend.atomic_writes import remove_halves
    from viewmend.output_folder import OutputFolder

    cells = any((out / "cells").glob("*--*--*.json"))
    with OutputFolder(out) as folder:
        if folder.listed or not cells:
            folder.demand_own(*WRITTEN)
        folder.made(*WRITTEN, changing=True)  # killed in the middle, they are ours to the next run
        for place in ("cells", "sheets"):
            remove_halves(out / place)
        try:
            yield
        finally:
            folder.made(*WRITTEN)


def evaluate(options: RunOptions, sets: tuple[str, ...], methods: str) -> Evaluated:
    """Run the methods on the sets, saying what fails and what cannot be had; cells in the order of the sets.

    Raises:
        ValueError: an option cannot be met.
    """
    _check(options, sets)
    from viewmend.cli.console import say, track
    from viewmend.evaluation.cells import CellStore
    from viewmend.evaluation.report import make_report
    from viewmend.evaluation.runner import run_evaluation
    from viewmend.evaluation.scorers import available_networks
    from viewmend.methods import method_names, split_missing

    if options.weights is not None:
        _look_first_in(options.weights)
    scenes = [scene for name in sets for scene in scenes_of(name, options)]
    names = method_names(methods)
    available, missing = split_missing(names, options.device)
    networks, missing_networks = available_networks()
    settings = _settings(options, networks)
    if missing or missing_networks:
        say(f"n/a, as the report explains: {', '.join(missing | missing_networks)}")
    store, cells = CellStore(options.out / "cells"), []
    steps = run_evaluation(scenes, available, store, settings, options.jobs, options.ray)
    total = len(scenes) * len(available)
    for cell in track((cell for found in steps for cell in found), "evaluating", total):
        cells.append(cell)
        if cell.error is not None:
            say(f"{cell.key.scene}, {cell.key.method}: failed: {cell.error}")
    order = {key: n for n, key in enumerate((s.name, m) for s in scenes for m in names)}
    cells.sort(key=lambda cell: order[cell.key.scene, cell.key.method])
    return Evaluated(make_report(cells, names, settings, missing, missing_networks), cells, store)


def write_report(options: RunOptions, found: Evaluated) -> None:
    """OUT/report.md, .csv, .json and .html, and OUT/sheets/."""
    from viewmend.atomic_writes import write_text
    from viewmend.cli.console import say
    from viewmend.evaluation.report_data import report_csv, report_json
    from viewmend.evaluation.report_markdown import markdown
    from viewmend.evaluation.report_page import page
    from viewmend.evaluation.report_sheets import write_sheets

    report, cells, store = found.report, found.cells, found.store
    if not cells and (options.out / "report.json").exists():
        raise ValueError(f"{options.out}: expected results for the report there, got none; it stays as it was")
    forms = {"md": markdown(report), "csv": report_csv(report), "json": report_json(report)}
    forms["html"] = page(report, cells, store, options.shown, options.video)
    for name, text in forms.items():
        write_text(options.out / f"report.{name}", text)
    write_sheets(cells, store, options.out / "sheets")
    say(f"wrote {options.out}")


def scenes_of(name: str, options: RunOptions) -> "list[LeaveOneOutScene]":
    """The scenes of P, of Q, of the same with a whole past, of P-turn, of a capture, or of a file's splits.

    Raises:
        ValueError: the options do not fit the set.
    """
    from viewmend.leave_one_out.capture_scenes import capture_set
    from viewmend.leave_one_out.capture_splits import is_splits, split_scenes
    from viewmend.leave_one_out.studio_scenes import (
        FRAMES,
        LONG_FRAMES,
        lengthened,
        performer_set,
        procedural_set,
        turning_set,
    )

    frames = options.frames or FRAMES
    part = slice(None, options.scenes and options.every * options.scenes, options.every)
    if name in LONG_SETS and options.frames not in (None, LONG_FRAMES):
        raise ValueError(
            f"expected no --frames with {name}, whose {LONG_FRAMES} frames make a whole window, got {options.frames}; "
            "leave it away, or take P or Q"
        )
    if name == "P":
        return list(procedural_set(frames, options.size, options.background)[part])
    if name == "P-turn":
        return list(turning_set(options.size)[part])
    if name == "P-long":
        return list(lengthened(procedural_set(LONG_FRAMES, options.size, options.background))[part])
    if name in ("Q", "Q-long"):
        if options.performers is None:
            raise ValueError(f"expected --performers DIR for set {name}, got none; P needs nothing")
        frames = LONG_FRAMES if name == "Q-long" else frames
        people = performer_set(options.performers, options.motions, frames, options.size)
        return list((lengthened(people) if name == "Q-long" else people)[part])
    if is_splits(Path(name)):
        return list(split_scenes(Path(name), options.frames)[part])
    inputs = dict.fromkeys(number.strip() for number in options.inputs.split(",") if number.strip())
    if not inputs:
        raise ValueError("expected --inputs all or a number of cameras, got none; leave it away for all")
    return [s for number in inputs for s in capture_set(Path(name), number, options.frames, options.kind)[part]]


def _settings(options: RunOptions, networks: tuple[str, ...]) -> "RunSettings":
    from viewmend.evaluation.scene_run import RunSettings
    from viewmend.rendering.view import RenderConfig
    from viewmend.stream import StreamConfig

    return RunSettings(
        device=options.device,
        precision=options.precision,
        stream=StreamConfig(
            render=RenderConfig(
                cameras=options.closest, error_rule=options.error_rule, wrong_fraction=options.wrong_fraction
            ),
            memory_mb=None,
        ),
        ssim=options.ssim,
        background=options.score_background,
        networks=networks,
    )


def _check(options: RunOptions, sets: tuple[str, ...]) -> None:
    wrong = [n for n in POSITIVE if (v := getattr(options, n)) is not None and v < 1]
    if wrong or not sets:
        got = f"--{wrong[0]} {getattr(options, wrong[0])}" if wrong else "no set"
        raise ValueError(f"expected at least one set, and positive numbers, got {got}; P needs nothing")
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(f"{options.out}: expected a folder for the results, got a file; choose another --out")
    check_device(options.device)


def _look_first_in(folder: Path) -> None:
    """Look for weights in this folder first, also in the processes that this one starts."""
    import os

    from viewmend.metrics.weights import PLACES_VARIABLE

    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of weights, found none; check --weights")
    others = os.environ.get(PLACES_VARIABLE)
    os.environ[PLACES_VARIABLE] = os.pathsep.join([str(folder.resolve()), *([others] if others else [])])
