"""A report as Markdown tables."""

from collections.abc import Sequence

from viewmend.evaluation.averages import Row, Scores, Table
from viewmend.evaluation.methods import REFERENCE
from viewmend.evaluation.report import RULES, Report

COLUMNS = (
    ("holes, dB", "psnr_holes", 1, 2),
    ("in mask", "psnr_holes_fg", 1, 2),
    ("masked", "psnr_masked", 1, 2),
    ("SSIM masked", "ssim_masked", 1, 5),
    ("whole, dB", "psnr_whole", 1, 2),
    ("SSIM whole", "ssim_whole", 1, 4),
    ("flicker", "flicker", 255, 2),
    ("warp", "warp_error", 255, 2),
    ("change", "change", 255, 2),
)
"""Heading, field of `Scores`, factor, decimals."""


def markdown(report: Report) -> str:
    """The whole report."""
    parts = ["# Evaluation", _setting(report)]
    parts += [_full(table) for table in report.tables]
    if report.missing:
        parts += ["## Not available", "\n".join(f"* {name}: {reason}" for name, reason in report.missing.items())]
    if report.kinds:
        parts += ["## By rig and style", "PSNR in the holes, dB; gain over " + REFERENCE + ".", _kinds(report)]
    parts += ["## Scenes", "PSNR in the holes, dB.", _scenes(report)]
    failed = [c.cell for c in report.cells if c.cell.error is not None]
    if failed:
        lines = [f"* {cell.key.scene}, {cell.key.method}: {cell.error}" for cell in failed]
        parts += ["## Failed", "\n".join(lines)]
    parts += ["## What the figures mean", "\n".join(f"* {rule}" for rule in RULES)]
    parts += ["## Methods", "\n".join(f"* {name}: `{report.identities.get(name, '?')}`" for name in report.methods)]
    return "\n\n".join(parts) + "\n"


def summary(report: Report) -> str:
    """The main tables alone, for a terminal."""
    return "\n\n".join(_full(table) for table in report.tables) + "\n"


def _setting(report: Report) -> str:
    lines = [f"Protocol {report.protocol}; {report.settings.device}, {report.settings.precision}."]
    lines += [
        f"Computed by viewmend {o.viewmend}, commit {o.commit}, Python {o.python}, torch {o.torch}, on {o.device}; "
        f"{o.jobs} process{'es' if o.jobs > 1 else ''} of {o.threads} threads, load {o.load}."
        for o in report.origins
    ]
    return "\n".join(lines)


def _full(table: Table) -> str:
    heads = ["method", f"over {REFERENCE}", *(c[0] for c in COLUMNS), "FPS", "ms", "ms p95", "scenes", "failed"]
    rows = [_method_row(row, len(heads)) for row in table.rows]
    rows.append(_truth_row([row.scores for row in table.rows], len(heads)))
    return f"## {table.title}\n\n{_holes(table)}\n\n{_grid(heads, rows)}"


def _method_row(row: Row, width: int) -> list[str]:
    if not row.scenes:
        return [row.method, *["n/a"] * (width - 1)]
    return [
        row.method,
        _signed(row.over_reference),
        *(_number(getattr(row.scores, field), factor, digits) for _, field, factor, digits in COLUMNS),
        *(_number(getattr(row.speed, name, None), 1, 1) for name in ("fps", "ms_p50", "ms_p95")),
        _scene_count(row),
        f"**{row.failed}**" if row.failed else "0",
    ]


def _holes(table: Table) -> str:
    of_hull = next((r.scores.holes_of_hull for r in table.rows if r.scores.holes_of_hull is not None), None)
    of_image = next((r.scores.holes_of_image for r in table.rows if r.scores.holes_of_image is not None), None)
    return (
        f"{table.frames} frames; holes {_number(of_hull, 100, 2)} % of the hull, {_number(of_image, 100, 3)} % of the "
        "image; "
        f"{table.thin_frames} frames with too few hole pixels left out, {table.empty_frames} of them with none."
    )


def _truth_row(scores: Sequence[Scores], width: int) -> list[str]:
    """The truth's own change, which a perfect method would show."""
    of = {name: next((v for s in scores if (v := getattr(s, f"{name}_truth")) is not None), None) for name in CHANGES}
    shown = [_number(of[field], factor, digits) if field in of else "" for _, field, factor, digits in COLUMNS]
    return ["*truth*", "", *shown, *[""] * (width - 2 - len(shown))]


CHANGES = ("warp_error", "change")


def _kinds(report: Report) -> str:
    rows = [
        [table.title, *(f"{_number(r.scores.psnr_holes, 1, 2)} ({_signed(r.over_reference)})" for r in table.rows)]
        for table in report.kinds
    ]
    return _grid(["kind", *report.methods], rows)


def _scenes(report: Report) -> str:
    of = {(c.cell.key.scene, c.cell.key.method): c for c in report.cells}
    rows = []
    for scene in dict.fromkeys(c.cell.key.scene for c in report.cells):
        own = [of.get((scene, method)) for method in report.methods]
        shown = [
            "n/a" if c is None else "**failed**" if c.cell.error is not None else _number(c.scores.psnr_holes, 1, 2)
            for c in own
        ]
        share = next((c.scores.holes_of_hull for c in own if c is not None and c.cell.error is None), None)
        rows.append([scene, _number(share, 100, 2), *shown])
    return _grid(["scene", "holes, % of the hull", *report.methods], rows)


def _scene_count(row: Row) -> str:
    return str(row.scenes) if row.scored_scenes == row.scenes else f"{row.scored_scenes} of {row.scenes}"


def _grid(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _number(value: float | None, factor: int, digits: int) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _signed(value: float | None) -> str:
    return "-" if value is None else f"{value:+.2f}"
