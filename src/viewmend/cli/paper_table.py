"""`viewmend evaluate paper-table`: the tables of the paper on the data at hand, its own figures beside ours."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from viewmend.cli.evaluating import RunOptions

if TYPE_CHECKING:
    from viewmend.evaluation.report import Report

RIVALS = ("telea", "navier-stokes", "nearest", "reprojection")
"""Rows that the paper does not have."""


@dataclass(frozen=True, kw_only=True)
class Options(RunOptions):
    """Make one of the paper's tables: 1, all methods; 2, on captures without retraining; 3, the ablation.

    The paper's figures stand in columns of their own: its data, image size and GPU are not ours. Rows whose weights are
    not here are n/a. OUT gets table1.md, .csv and .json (or 2, 3), and all that viewmend evaluate writes.
    """

    table: Annotated[Literal[1, 2, 3], tyro.conf.Positional]
    """Which."""
    sets: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[P|Q|CAPTURE...]")] = ()
    """Sets as viewmend evaluate takes them; by default P, and Q if there are --performers. Table 2 wants captures."""
    ours: str = "small"
    """Our models, by name or folder, with commas; the first takes the row of the paper's own."""
    models: Path | None = None
    """Table 3: a folder of models named full, no-rope, no-past, single-camera, single-camera-no-masks, with -s0, -s1
    ... behind for several seeds, as viewmend ablation leaves them in OUT/models."""


def run(options: Options) -> int:
    """Run the command; 1 if a cell failed, else 0."""
    from viewmend.atomic_writes import write_text
    from viewmend.cli.console import show
    from viewmend.cli.evaluating import evaluate, report_folder, write_report
    from viewmend.evaluation.paper_tables import NO_FIGURES, OURS, TABLES, PaperRow, ablation_models, paper_grid
    from viewmend.evaluation.report_markdown import written
    from viewmend.methods import method_names

    options = replace(options, error_rule=options.error_rule or "unseen")
    sets = options.sets or (("P", "Q") if options.performers else ("P",))
    rows = list(TABLES[options.table])
    if options.table == 3:
        if options.models is None:
            raise ValueError("expected --models DIR for Table 3, got none; viewmend ablation trains them")
        methods = ablation_models(options.models)
    else:
        if options.table == 2 and not options.sets:
            raise ValueError("expected captures for Table 2, got none; name their folders behind the 2")
        given = method_names(options.ours) if options.ours.strip() else ()
        if not given:
            raise ValueError("expected --ours with a model's name or folder, got none; leave it away for small")
        first, *others = given
        methods = {OURS: (first,)}
        rows += [PaperRow("not in the paper", name, NO_FIGURES) for name in (*others, *RIVALS)]
    names = [name for row in rows for name in methods.get(row.method, (row.method,))]
    with report_folder(options.out):
        found = evaluate(options, sets, ",".join(dict.fromkeys(names)))
        write_report(options, found)
        grid = paper_grid(rows, found.report, methods)
        text = _text(options.table, sets, written(grid), found.report)
        by_head = [dict(zip(grid.heads, row, strict=True)) for row in grid.rows]
        forms = {"md": text, "json": json.dumps(by_head, indent=1)}
        forms["csv"] = "\n".join(_csv_line(line) for line in (grid.heads, *grid.rows)) + "\n"
        for suffix, form in forms.items():
            write_text(options.out / f"table{options.table}.{suffix}", form)
    show(*text.rstrip().split("\n"))
    return 1 if found.failed else 0


def _text(table: int, sets: tuple[str, ...], grid: str, report: "Report") -> str:
    from viewmend.evaluation.report_grids import holes_line, not_available, setting_lines

    scenes = len({cell.key.scene for cell in report.cells})
    lines = [
        f"# Table {table}, on {', '.join(sets)}",
        "Columns (here) were measured here, columns (paper) are printed in the paper: other data, another image size "
        "and another GPU. Compare within a column.",
        "The paper's PSNR of inpainted regions is (a) by its text; its values are in the range of (b).",
        *(f"Here: {scenes} scenes, {holes_line(table)}" for table in report.tables[:1]),
        "\n".join(setting_lines(report)),
        grid,
    ]
    if missing := not_available(report):
        lines.append("n/a:\n\n" + "\n".join(f"* {line}" for line in missing))
    return "\n\n".join(lines) + "\n"


def _csv_line(cells: tuple[str, ...]) -> str:
    import csv
    import io

    file = io.StringIO()
    csv.writer(file, lineterminator="").writerow(cells)
    return file.getvalue()
