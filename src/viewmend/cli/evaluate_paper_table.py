"""`viewmend evaluate paper-table`: the tables of the paper on other data, with the paper's own figures."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from viewmend.cli.evaluate import RunOptions

if TYPE_CHECKING:
    from viewmend.evaluation.paper_tables import PaperRow
    from viewmend.evaluation.report import Report

EXTRA_ROWS = ("telea", "navier-stokes", "nearest", "reprojection")
"""Rows that the paper does not have."""


@dataclass(frozen=True, kw_only=True)
class Options(RunOptions):
    """Make one of the paper's tables: 1, all methods; 2, on captures without retraining; 3, the ablation.

    The paper's figures have columns of their own: its data, image size and GPU are
    different. Rows without weights are n/a. OUT gets table1.md, .csv and .json (or 2, 3),
    and all files of viewmend evaluate.
    """

    table: Annotated[Literal[1, 2, 3], tyro.conf.Positional]
    """Number of the table."""
    sets: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[P|Q|CAPTURE...]")] = ()
    """Sets as for viewmend evaluate; by default P, and Q with --performers. Table 2 needs captures."""
    ours: str = "paper-small"
    """Models to add, by name or folder, separated by commas. The first that was trained by
    the recipe paper or paper-small takes the row of the paper's model; all others have rows
    of their own."""
    models: Path | None = None
    """Table 3: a folder of models named full, no-rope, no-past, single-camera,
    single-camera-no-masks; with -s0, -s1 ... appended for several seeds, as research/ablation.py
    leaves them."""


def run(options: Options) -> int:
    """Run the command; 1 if a cell failed, else 0."""
    from viewmend.cli.console import show
    from viewmend.cli.evaluate import evaluate, exit_code, report_folder
    from viewmend.evaluation import paper_tables as paper
    from viewmend.evaluation.report import csv_text, markdown_table
    from viewmend.models.registry import method_names
    from viewmend.utils.atomic_writes import write_text

    options = replace(options, view=replace(options.view, error_rule=options.view.error_rule or "holes"))
    sets = options.sets or (("P", "Q") if options.performers else ("P",))
    rows = paper.paper_rows(options.table)
    if options.table == 3:
        if options.models is None:
            raise ValueError("expected --models DIR for table 3, got none; research/ablation.py trains them")
        methods = paper.ablation_models(options.models)
    else:
        if options.table == 2 and not options.sets:
            raise ValueError(
                "expected captures for table 2, got none; give their folders: paper-table 2 CAPTURE ..."
            )
        if not options.ours.strip():
            raise ValueError(
                "expected --ours with a model's name or folder, got none; leave it out for the default"
            )
        ours = method_names(options.ours)
        trained = next((name for name in ours if paper.row_label(name).startswith(paper.PAPERS_MODEL)), None)
        methods = {
            paper.OURS: () if trained is None else (trained,),
            "rgvi": (),
        }  # not RGVI without its networks
        rows = [_relabelled(row, trained) for row in rows]
        rows += [
            paper.PaperRow(paper.row_label(name), name) for name in (*ours, *EXTRA_ROWS) if name != trained
        ]
    names = [name for row in rows for name in methods.get(row.method, (row.method,))]
    with report_folder(options.out):
        report = evaluate(options, sets, ",".join(dict.fromkeys(names)))
        grid = paper.paper_grid(rows, report, methods)
        text = _text(options.table, sets, markdown_table(grid), report)
        by_head = [dict(zip(grid.heads, row, strict=True)) for row in grid.rows]
        forms = {"md": text, "json": json.dumps(by_head, indent=1), "csv": csv_text(grid.heads, grid.rows)}
        for suffix, form in forms.items():
            write_text(options.out / f"table{options.table}.{suffix}", form)
    show(*text.rstrip().split("\n"))
    return exit_code(report)


def _relabelled(row: "PaperRow", trained: str | None) -> "PaperRow":
    """The row, whose label says what our network in it was trained from, if that is not what the paper's was."""
    from viewmend.contrib.baselines.published import finetuned_weights
    from viewmend.evaluation.paper_tables import OURS, row_label, training_of
    from viewmend.metrics.weights import find_weights

    if row.method == OURS and trained is not None:
        return replace(row, label=row_label(trained))
    if not row.method.endswith("-finetuned"):
        return row
    weights = find_weights(finetuned_weights(row.method.split("-")[0]))
    training = weights and training_of(weights.parent)
    if not training or training.start is not None:
        return row
    name, framing = row.label.replace(" finetuned", "").split(", ")
    return replace(row, label=f"{name}, trained from scratch ({training.minutes} minutes), {framing}")


def _text(table: int, sets: tuple[str, ...], grid: str, report: "Report") -> str:
    from viewmend.evaluation.report import bullets, holes_line, not_available, setting_lines

    scenes = len({cell.key.scene for cell in report.cells})
    lines = [
        f"# Table {table}, on {', '.join(sets)}",
        "Columns (here) were measured here, columns (paper) are printed in the paper: other data, image size and GPU. "
        "Compare only within a column.",
        "The paper's PSNR of inpainted regions (36 to 42 dB) is reading (b), the error inside E over all pixels: "
        "compare it with PSNR masked (b), which grows as the share of holes falls.",
        *(f"Here: {scenes} scenes, {holes_line(table)}" for table in report.tables[:1]),
        "\n".join(setting_lines(report)),
        grid,
    ]
    missing = not_available(report)
    if missing:
        lines.append("n/a:\n\n" + bullets(missing))
    return "\n\n".join(lines) + "\n"
