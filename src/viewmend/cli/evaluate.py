"""`viewmend evaluate`: compare methods on synthetic scenes and captures, in tables and images."""

import itertools
import math
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from viewmend.cli.checks import (
    Geometry,
    Precision,
    PreparationOptions,
    ViewOptions,
    check_device,
    check_least,
)
from viewmend.utils.options import FLAT

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from viewmend.evaluation.report import Report
    from viewmend.evaluation.result_cache import CellStore
    from viewmend.scenes.held_out import LeaveOneOutScene
    from viewmend.scenes.studio_scenes import StudioScene

WRITTEN = (*(f"{n}.*" for n in ("report", "table1", "table2", "table3")), "sheets/*.png")
"""Files in OUT besides cells."""
LONG_SETS = ("P-long", "Q-long", "P-turn")
SYNTHETIC_SETS = ("P", "Q", *LONG_SETS, "R48", "R34")


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of all commands that evaluate."""

    out: Path
    """Folder for the results."""
    weights: Path | None = None
    """Folder of published weights, searched before the others (viewmend weights). Methods and
    metrics whose weights are not found are n/a."""
    performers: Path | None = None
    """Folder of the people of set Q: glTF characters in it or in test/; BVH motions in
    motions/test/, in motions/, or next to the characters."""
    motions: Path | None = None
    """Folder of BVH motions, if they are elsewhere."""
    format: str | None = None
    """Format of the captures (docs/formats.md); recognised by default."""
    inputs: str = "all"
    """Input cameras of a capture: all, or a number of evenly spaced ones; several values are
    separated by commas."""
    protocol: Literal["strict", "predicted-mask", "target-mask", "hull-with-target-mask"] = "strict"
    """How the mask of the held-out camera is used. 'strict': not at all. 'predicted-mask': not at
    all, and the alpha that 'views' predicts replaces it. 'target-mask': to cut out and composite
    the view, as in the paper. 'hull-with-target-mask': only to carve the hull."""
    view: Annotated[ViewOptions, FLAT] = field(default_factory=ViewOptions)
    preparation: Annotated[PreparationOptions, FLAT] = field(default_factory=PreparationOptions)
    frames: int | None = None
    """Number of frames of each scene; by default 10 of P and Q, and all of a capture. Long sets
    have 41, of which the last 10 are scored."""
    every: int = 1
    """Use only every n-th scene of each set, and every n-th camera of a capture, for a quick run."""
    scenes: int | None = None
    """Use at most this many scenes of each set, after --every."""
    size: int = 512
    """Width and height of the views of P, Q and the long sets, in pixels."""
    background: Literal["black", "stage"] = "black"
    """Background behind the people of P; 'stage' is for models without masks."""
    score_background: Literal["black", "white"] = "black"
    """Background on which views and truth are scored. The paper uses white; whole-image scores on different
    backgrounds are not comparable."""
    ssim: Literal["gaussian", "uniform7"] = "gaussian"
    """Window of SSIM: Gaussian of 11 x 11 pixels, or uniform of 7 x 7."""
    jobs: int = 1
    """Number of processes. Times are comparable only within a run."""
    ray: str | None = None
    """Address of a Ray cluster to run on instead: HOST:PORT, auto, or local (needs viewmend[ray])."""
    device: str = "cpu"
    """Device to compute on: cpu or cuda."""
    geometry: Geometry = "hull"
    """Geometry proxy: the visual 'hull' of the masks, or 'fused', the hull tightened by depth that
    the model 'views' predicts all around the subject. Fusing adds 3 to 7 seconds to each
    frame."""
    precision: Precision = "auto"
    """Number format of viewmend's own networks. 'auto' is bfloat16 if the model was
    trained in it and the device computes in it natively, otherwise float32."""
    top_k: int | None = None
    """Number of context tokens that the paper's model keeps when pruning; by default the model's own."""
    shown: int = 12
    """Number of scenes of each set whose images are in report.html; sheets/ has those of all scenes."""


@dataclass(frozen=True, kw_only=True)
class Options(RunOptions):
    """Compare methods on views of held-out cameras, and write tables and images to --out.

    OUT gets report.html, report.md, report.csv, report.json, sheets/ with one image per scene, and
    cells/ with all results: an interrupted run resumes from there, and only new methods and scenes
    are computed. docs/evaluation.md defines the scores.
    """

    sets: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SET|CAPTURE...")]
    """P: 30 procedural scenes. Q: photo-textured people (needs --performers). P-long, Q-long: the
    same with 41 frames, of which the last ten are scored. P-turn: people who turn. R48, R34: rigs
    of 48 and 34 cameras, as in the paper; one frame with a full window is scored, also of glTF
    people with --performers. CAPTURE: each camera of a capture is held out in turn; or a file of
    `viewmend splits`, whose test scenes are used."""
    methods: str = "all"
    """Names separated by commas: telea, navier-stokes, nearest, smooth, reprojection, unfilled,
    rgvi, a shipped model, a model's folder, a baseline such as dstt-o-def, FILE.py:NAME; 'all' for
    all shipped methods, 'baselines' for those of the paper's Table 1."""
    json: bool = False
    """Write the report to standard output as JSON, in place of the tables."""


def run(options: Options) -> int:
    """Run the command; 1 if a cell failed, else 0."""
    from viewmend.cli.console import show
    from viewmend.evaluation.report import markdown, report_json, summary

    with report_folder(options.out):
        report = evaluate(options, options.sets, options.methods)
    text = report_json(report) if options.json else markdown(summary(report))
    show(*text.rstrip().split("\n"))
    return exit_code(report)


def exit_code(report: "Report") -> int:
    """1 if a cell failed, else 0."""
    return int(any(cell.error is not None for cell in report.cells))


@contextmanager
def report_folder(out: Path) -> "Iterator[None]":
    """Lock OUT for this run, and record its files.

    Raises:
        ValueError: another run writes there, or a foreign file has the name of one that will be written.
    """
    from viewmend.utils.atomic_writes import remove_partial_files
    from viewmend.utils.output_folder import OutputFolder

    cells = any((out / "cells").glob("*--*--*.json"))
    with OutputFolder(out) as folder:
        if folder.listed or not cells:  # a folder of cells without a manifest is of an early version
            folder.check_own_files(*WRITTEN)
        folder.record(*WRITTEN, changing=True)  # a run that is killed leaves files that the next may replace
        for place in ("cells", "sheets"):
            remove_partial_files(out / place)
        try:
            yield
        finally:
            folder.record(*WRITTEN)


def evaluate(options: RunOptions, sets: tuple[str, ...], methods: str) -> "Report":
    """Run the methods on the sets, and write the report to OUT; cells are in the order of sets and methods.

    Raises:
        ValueError: an option is not valid.
    """
    check_least(options, frames=1, every=1, scenes=1, size=1, jobs=1, shown=1, top_k=1)
    if not sets:
        raise ValueError("expected at least one set, got no set; P needs no data")
    _check_used(options, sets)
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(
            f"{options.out}: expected a folder for the results, got a file; choose another --out"
        )
    check_device(options.device)
    from viewmend.cli.console import say, track
    from viewmend.evaluation.report import make_report
    from viewmend.evaluation.result_cache import CellStore
    from viewmend.evaluation.runner import run_evaluation
    from viewmend.evaluation.scene_run import RunSettings
    from viewmend.evaluation.scores import available_networks
    from viewmend.models.registry import method_names, split_missing
    from viewmend.stream import StreamConfig

    if options.weights is not None:
        _search_first(options.weights)
    scenes = [scene for name in sets for scene in scenes_of(name, options)]
    names = method_names(methods)
    available, missing = split_missing(names, options.device)
    networks, missing_networks = available_networks()
    same = {name: getattr(options, name) for name in ("device", "precision", "ssim", "protocol", "top_k")}
    stream = StreamConfig(geometry=options.geometry, render=options.view.config(), memory_mb=None)
    settings = RunSettings(stream=stream, background=options.score_background, networks=networks, **same)
    if missing or missing_networks:
        say(f"n/a (the report has the reasons): {', '.join(missing | missing_networks)}")
    store = CellStore(options.out / "cells")
    cells = []
    steps = run_evaluation(scenes, available, store, settings, options.jobs, options.ray)
    for cell in track(
        (cell for found in steps for cell in found), "evaluating", len(scenes) * len(available)
    ):
        cells.append(cell)
        if cell.error is not None:
            say(f"{cell.key.scene}, {cell.key.method}: failed: {cell.error}")
    order = {key: n for n, key in enumerate((s.name, m) for s in scenes for m in names)}
    cells.sort(key=lambda cell: order[cell.key.scene, cell.key.method])
    report = make_report(
        cells, names, settings, missing, missing_networks, preparation=asdict(options.preparation)
    )
    _write(options, report, store)
    return report


def _check_used(options: RunOptions, sets: tuple[str, ...]) -> None:
    """Raise a ValueError for an option that none of the sets uses, or a background that one lacks."""
    captures = [name for name in sets if name not in SYNTHETIC_SETS]
    people = [name for name in sets if name in SYNTHETIC_SETS and name[0] in "QR"]
    default = RunOptions(out=options.out)
    used = {
        "background": set(sets) <= {"P", "P-long"},
        "size": len(captures) < len(sets),
        **dict.fromkeys(("performers", "motions"), bool(people)),
        **dict.fromkeys(("format", "inputs", *vars(default.preparation)), bool(captures)),
    }
    given = vars(options) | vars(options.preparation)
    usual = vars(default) | vars(default.preparation)
    for name, is_used in used.items():
        if given[name] != usual[name] and not is_used:
            option = f"--{'no-' if given[name] is False else ''}{name.replace('_', '-')}"
            raise ValueError(
                f"expected sets that {option} can change, got {', '.join(sets)}; leave it out, or see --help"
            )


def _write(options: RunOptions, report: "Report", store: "CellStore") -> None:
    from viewmend.cli.console import say
    from viewmend.evaluation.report import blocks, markdown, report_csv, report_json
    from viewmend.evaluation.report_page import page, write_sheets
    from viewmend.utils.atomic_writes import write_text

    if not report.cells and (options.out / "report.json").exists():
        raise ValueError(
            f"{options.out}: expected at least one result, got none; the report there is kept. Check --methods and sets"
        )
    forms = {"md": markdown(blocks(report)), "csv": report_csv(report), "json": report_json(report)}
    forms["html"] = page(report, store, options.shown)
    for name, text in forms.items():
        write_text(options.out / f"report.{name}", text)
    write_sheets(report.cells, store, options.out / "sheets")
    say(f"wrote {options.out}")


def scenes_of(name: str, options: RunOptions) -> "list[LeaveOneOutScene]":
    """The scenes of a synthetic set, of a capture, or of a file of splits.

    Raises:
        ValueError: the options do not fit the set.
    """
    from viewmend.scenes import studio_scenes as studio
    from viewmend.scenes.capture_scenes import capture_set, is_splits, split_scenes

    part = slice(None, options.scenes and options.every * options.scenes, options.every)
    if name in LONG_SETS and options.frames not in (None, studio.LONG_FRAMES):
        raise ValueError(
            f"expected no --frames with {name}, whose {studio.LONG_FRAMES} frames make a full window, got "
            f"{options.frames}; leave it out, or use P or Q"
        )
    frames = studio.LONG_FRAMES if name in LONG_SETS else options.frames or studio.FRAMES
    if name == "R48" or name == "R34":
        if options.frames is not None:
            raise ValueError(f"expected no --frames with {name}, which scores one frame; leave it out")
        return _one_in(options, studio.rig_set(name, options.performers, options.motions, options.size))
    if name == "P-turn":
        return _one_in(options, studio.turning_set(options.size))
    if name in ("P", "P-long", "Q", "Q-long"):
        if name[0] == "P":
            scenes = studio.procedural_set(frames, options.size, options.background)
        elif options.performers is None:
            raise ValueError(f"expected --performers DIR for set {name}, got none; P needs no data")
        else:
            scenes = studio.performer_set(options.performers, options.motions, frames, options.size)
        return _one_in(options, studio.lengthen(scenes) if name in LONG_SETS else scenes)
    prepared = asdict(options.preparation)
    if is_splits(Path(name)):
        if options.inputs != "all" or options.format is not None:
            raise ValueError(
                f"expected neither --inputs nor --format with {name}, which says which cameras and format to use, got "
                "them; leave them out"
            )
        return [replace(s, **prepared) for s in split_scenes(Path(name), options.frames)[part]]
    inputs = dict.fromkeys(number.strip() for number in options.inputs.split(",") if number.strip())
    if not inputs:
        raise ValueError("expected --inputs all or a number of cameras, got none; leave it out for all")
    captured = [
        s for number in inputs for s in capture_set(Path(name), number, options.frames, options.format)[part]
    ]
    return [replace(scene, **prepared) for scene in captured]


def _one_in(options: RunOptions, scenes: "Sequence[StudioScene]") -> "list[LeaveOneOutScene]":
    """One scene in `options.every`, and not every n-th: rigs alternate, and tempos have a period of three."""
    stride = next(n for n in itertools.count(options.every) if math.gcd(n, 6 * len(scenes)) == 1)
    numbers = sorted(n * stride % len(scenes) for n in range(math.ceil(len(scenes) / options.every)))
    return [scenes[number] for number in numbers[: options.scenes]]


def _search_first(folder: Path) -> None:
    """Search this folder for weights first, also in worker processes."""
    import os

    from viewmend.metrics.weights import FOLDERS_VARIABLE

    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of weights, found none; check --weights")
    others = os.environ.get(FOLDERS_VARIABLE)
    os.environ[FOLDERS_VARIABLE] = os.pathsep.join([str(folder.resolve()), *([others] if others else [])])
