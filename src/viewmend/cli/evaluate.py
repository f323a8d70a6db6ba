"""`viewmend evaluate`: methods on fixed scenes and on captures, in tables and pictures."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from viewmend.cli.evaluating import RunOptions


@dataclass(frozen=True, kw_only=True)
class Options(RunOptions):
    """Compare methods on views of cameras that are left out, and write tables and pictures to --out.

    OUT gets report.html to look at, report.md, report.csv, report.json, sheets/ with a picture of each scene, and
    cells/ with what was computed: a run that was stopped goes on from there, and another method or scene costs only
    itself. docs/evaluation.md says what is measured.
    """

    sets: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="P|Q|P-long|Q-long|P-turn|CAPTURE...")]
    """P: 30 procedural scenes. Q: photo-textured people (needs --performers). P-long, Q-long: the same for 41 frames,
    the last ten scored, with a whole past. P-turn: people who turn. Anything else is a capture: each of its
    cameras is left out in turn; or a file of `viewmend splits`, whose scenes for tests are taken."""
    methods: str = "all"
    """Names with commas: telea, navier-stokes, nearest, smooth, reprojection, unfilled, rgvi, a shipped model's name, a
    model's folder, a baseline like dstt-o-def, FILE.py:NAME; all for everything that is shipped, baselines for those
    of the paper's first table."""
    json: bool = False
    """Write the report as JSON to standard output, too."""


def run(options: Options) -> int:
    """Run the command; 1 if a cell failed, else 0."""
    from viewmend.cli.console import show
    from viewmend.cli.evaluating import evaluate, report_folder, write_report
    from viewmend.evaluation.report_data import report_json
    from viewmend.evaluation.report_markdown import summary

    with report_folder(options.out):
        found = evaluate(options, options.sets, options.methods)
        write_report(options, found)
    text = report_json(found.report) if options.json else summary(found.report)
    show(*text.rstrip().split("\n"))
    return 1 if found.failed else 0
