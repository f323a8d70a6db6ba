"""`viewmend evaluate`: methods on fixed scenes and on captures, in tables and pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from viewmend.evaluation.cells import Cell, CellStore
    from viewmend.evaluation.report import Report
    from viewmend.evaluation.scenes import EvaluationScene


@dataclass(frozen=True, kw_only=True)
class Options:
    """Compare methods on views of cameras that are left out, and write tables and pictures to --out.

    OUT gets report.md, report.csv, report.json, sheets/ with a picture of each scene, and cells/ with what was
    computed: a run that was stopped goes on from there, and another method or scene costs only itself.
    """

    sets: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="P|Q|CAPTURE...")]
    """P: 30 procedural scenes. Q: photo-textured people (needs --performers). Anything else is a capture's folder:
    each of its cameras is left out in turn."""
    out: Path
    """Folder for the results."""
    methods: str = "all"
    """Names with commas: telea, navier-stokes, nearest, smooth, reprojection, unfilled, a shipped model's name, a
    model's folder, a baseline like dstt-o-def, FILE.py:NAME; all for everything that is shipped, baselines for those
    of the paper's first table."""
    weights: Path | None = None
    """Folder of published weights, looked in first; without theirs, baselines are n/a."""
    performers: Path | None = None
    """Folder of the people of Q: glTF characters in it or in its test/, BVH motions in its motions/test/, motions/ or
    beside them."""
    motions: Path | None = None
    """Folder of BVH motions, if they are elsewhere."""
    inputs: str = "all"
    """How many cameras of a capture are looked at: all, or a number of them, evenly around; several with commas."""
    frames: int | None = None
    """Of each scene, from the first. 10 for P and Q by default, all of a capture."""
    scenes: int | None = None
    """Only the first so many of each set, for a quick look."""
    size: int = 512
    """Width and height of the views of P and Q."""
    jobs: int = 1
    """Processes that share the work. Milliseconds are only comparable within a run."""
    device: str = "cpu"
    """Where to compute: cpu, or cuda."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of our networks."""
    json: bool = False
    """Write the report as JSON to standard output, too."""


def run(options: Options) -> int:
    """Run the command; 1 if a cell failed, else 0."""
    wrong = [n for n in ("frames", "scenes", "size", "jobs") if (v := getattr(options, n)) is not None and v < 1]
    if wrong or not options.sets:
        name = wrong[0] if wrong else "sets"
        raise ValueError(f"expected at least one set, and positive numbers, got {name} {getattr(options, name)}")
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(f"{options.out}: expected a folder for the results, got a file; choose another --out")
    from viewmend.cli.console import say, track
    from viewmend.evaluation.cells import CellStore
    from viewmend.evaluation.methods import method_names, split_missing
    from viewmend.evaluation.report import make_report
    from viewmend.evaluation.runner import run_evaluation
    from viewmend.evaluation.scene_run import RunSettings

    _check_device(options.device)
    if options.weights is not None:
        _look_first_in(options.weights)
    methods, settings = method_names(options.methods), RunSettings(device=options.device, precision=options.precision)
    available, missing = split_missing(methods, options.device)
    if missing:
        say(f"n/a, as the report explains: {', '.join(missing)}")
    scenes = [scene for name in options.sets for scene in _set(name, options)]
    store = CellStore(options.out / "cells")
    total, cells = len(scenes) * len(available), []
    steps = run_evaluation(scenes, available, store, settings, options.jobs)
    for cell in track((cell for found in steps for cell in found), "evaluating", total):
        cells.append(cell)
        if cell.error is not None:
            say(f"{cell.key.scene}, {cell.key.method}: failed: {cell.error}")
    order = {key: n for n, key in enumerate((s.name, m) for s in scenes for m in methods)}
    cells.sort(key=lambda cell: order[cell.key.scene, cell.key.method])
    _write(options, make_report(cells, methods, settings, missing), cells, store)
    return 1 if any(cell.error is not None for cell in cells) else 0


def _write(options: Options, report: "Report", cells: "list[Cell]", store: "CellStore") -> None:
    from viewmend.cli.console import say
    from viewmend.evaluation.report_data import report_csv, report_json
    from viewmend.evaluation.report_markdown import markdown, summary
    from viewmend.evaluation.report_sheets import write_sheets

    for name, text in (("md", markdown(report)), ("csv", report_csv(report)), ("json", report_json(report))):
        (options.out / f"report.{name}").write_text(text, encoding="utf-8")
    write_sheets(cells, store, options.out / "sheets")
    say(f"wrote {options.out}")
    print(report_json(report) if options.json else summary(report), end="")


def _set(name: str, options: Options) -> "list[EvaluationScene]":
    """The scenes of P, of Q, or of a capture."""
    from viewmend.evaluation.capture_scenes import capture_set
    from viewmend.evaluation.scenes import FRAMES, performer_set, procedural_set

    frames = options.frames or FRAMES
    if name == "P":
        return list(procedural_set(frames, options.size)[: options.scenes])
    if name == "Q":
        if options.performers is None:
            raise ValueError("expected --performers DIR for set Q, got none; P needs nothing")
        return list(performer_set(options.performers, options.motions, frames, options.size)[: options.scenes])
    inputs = [part.strip() for part in options.inputs.split(",") if part.strip()]
    return [s for number in inputs for s in capture_set(Path(name), number, options.frames)[: options.scenes]]


def _look_first_in(folder: Path) -> None:
    """For weights, also in the processes that this one starts."""
    import os

    from viewmend.metrics.weights import PLACES_VARIABLE

    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of weights, found none; check --weights")
    others = os.environ.get(PLACES_VARIABLE)
    os.environ[PLACES_VARIABLE] = os.pathsep.join([str(folder.resolve()), *([others] if others else [])])


def _check_device(device: str) -> None:
    import torch

    if device != "cpu" and not (device.startswith("cuda") and torch.cuda.is_available()):
        raise ValueError(f"expected a device that is there, got '{device}'; use --device cpu")
