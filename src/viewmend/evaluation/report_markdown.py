"""A report as Markdown tables."""

from viewmend.evaluation.averages import Table
from viewmend.evaluation.report import RULES, Report
from viewmend.evaluation.report_grids import (
    Grid,
    holes_line,
    kinds_grid,
    main_grid,
    not_available,
    readings_grid,
    scenes_grid,
    setting_lines,
)
from viewmend.methods import REFERENCE
from viewmend.terminal import printable


def markdown(report: Report) -> str:
    """The whole report."""
    parts = ["# Evaluation", "\n".join(setting_lines(report))]
    for table in report.tables:
        parts += [_main(table), written(readings_grid(table))]
    if missing := not_available(report):
        parts += ["## Not available", "\n".join(f"* {line}" for line in missing)]
    if report.kinds:
        by_kind = written(kinds_grid(report))
        parts += ["## By rig and style", f"PSNR in the holes, dB; gain over {REFERENCE}.", by_kind]
    parts += ["## Scenes", "PSNR in the holes, dB.", written(scenes_grid(report))]
    failed = [cell for cell in report.cells if cell.error is not None]
    if failed:
        lines = [printable(f"* {cell.key.scene}, {cell.key.method}: {cell.error}") for cell in failed]
        parts += ["## Failed", "\n".join(lines)]
    parts += ["## What the figures mean", "\n".join(f"* {rule}" for rule in RULES)]
    parts += ["## Methods", "\n".join(f"* {name}: `{report.identities.get(name, '?')}`" for name in report.methods)]
    return "\n\n".join(parts) + "\n"


def summary(report: Report) -> str:
    """The main tables alone, for a terminal."""
    return "\n\n".join(_main(table) for table in report.tables) + "\n"


def written(grid: Grid) -> str:
    """A grid as a table of Markdown."""
    lines = [grid.heads, ["---"] * len(grid.heads), *grid.rows]
    return "\n".join("| " + " | ".join(printable(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)


def _main(table: Table) -> str:
    return f"## {printable(table.title)}\n\n{holes_line(table)}\n\n{written(main_grid(table))}"
