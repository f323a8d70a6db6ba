"""The paper's three tables: its own figures next to those measured here.

Its data, image size and GPU differ from ours: its figures have columns of their own, and nothing is
computed from both. Tables 1 and 3 are on DNA-Rendering, table 2 on RIFTCast's captures without
retraining. FPS are on a GPU that the paper does not name. Framings: def, at 432 x 240; win,
windows; mul, windows with the frames of other cameras.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from viewmend.evaluation.averages import Row, mean
from viewmend.evaluation.report import Grid, Report, number
from viewmend.models.checkpoint import CARD, SHIPPED, shipped_models
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.registry import METHODS, make_method

OURS = "ours"
"""Method of the paper's own row: stands for a model that is named at run time."""
PAPER_COLUMNS = ("psnr", "ssim", "lpips", "vfid", "psnr_holes", "ssim_holes", "lpips_holes", "fps")
"""`psnr_holes` is over the pixels of E by the paper's text; its values follow reading (b), that of
masked images."""
PAPER_HEADINGS = {
    "psnr_holes": "PSNR inpainted, reading (b)",
    "ssim_holes": "SSIM inpainted",
    "lpips_holes": "LPIPS inpainted",
}
PAPERS_MODEL = "the paper's model"
COLUMNS = (
    ("PSNR", "psnr", "whole", 3),
    ("SSIM", "ssim", "whole", 4),
    ("LPIPS", "lpips_alex", "whole", 4),
    ("VFID", "vfid", "whole_eval", 4),
    ("PSNR holes (a)", "psnr", "holes", 3),
    ("PSNR masked (b)", "psnr", "masked", 3),
    ("SSIM masked", "ssim", "masked", 5),
    ("LPIPS holes", "lpips_alex", "holes", 4),
    ("LPIPS masked", "lpips_alex", "masked", 5),
    ("FPS", "speed", "fps", 2),
    ("ms p95", "speed", "ms_p95", 1),
)
"""Heading, metric and region of our records (or a field of a row and one of its own), decimals."""


@dataclass(frozen=True)
class PaperRow:
    """One row of a table."""

    label: str
    """The paper's name of the row."""
    method: str
    """Our name of the method."""
    figures: tuple[str, ...] = ("-",) * len(PAPER_COLUMNS)
    """Figures as printed in the paper, by `PAPER_COLUMNS`."""


def paper_rows(table: int) -> list[PaperRow]:
    """The rows of table 1, 2 or 3 (`paper_tables.csv`)."""
    text = (files("viewmend.evaluation") / "paper_tables.csv").read_text(encoding="utf-8")
    rows = [row for row in csv.DictReader(text.splitlines()) if row["table"] == str(table)]
    return [PaperRow(row["label"], row["method"], tuple(row[name] for name in PAPER_COLUMNS)) for row in rows]


@dataclass(frozen=True)
class Training:
    """How `viewmend train` made a model, from its card."""

    recipe: str
    start: str | None
    """The model that it started from; None for random weights."""
    minutes: int


def training_of(folder: Path) -> Training | None:
    """The training of the model in a folder; None if its card does not say."""
    card = folder / CARD
    text = " ".join(card.read_text("utf-8", "replace").split()) if card.is_file() else ""
    found = re.search(
        r"Trained by `viewmend train ([\w-]+)` from (random weights|`[^`]*`): .*? in (\d+) minutes", text
    )
    if found is None:
        return None
    return Training(found[1], None if found[2] == "random weights" else found[2].strip("`"), int(found[3]))


def row_label(name: str) -> str:
    """The label of a method's row. `PAPERS_MODEL` begins only that of a model trained by the paper's own recipe.

    Raises:
        ValueError: there is no such method.
    """
    folder = SHIPPED / name if name in shipped_models() else Path(name)
    if name in METHODS or not (name in shipped_models() or folder.is_dir()):
        return "not in the paper"
    if not isinstance(make_method(name), PatchTransformer):
        return "ours, not the paper's"
    training = training_of(folder)
    if training is None or training.recipe not in ("paper", "paper-small"):
        return "the paper's architecture, trained otherwise"
    return PAPERS_MODEL if training.start is None else f"{PAPERS_MODEL}, pre-trained ({training.start})"


def ablation_models(folder: Path) -> dict[str, tuple[str, ...]]:
    """The models of table 3 in a folder: NAME, or NAME-s0, NAME-s1 ... for several seeds; () for missing ones.

    Raises:
        ValueError: there is none.
    """
    names = [row.method for row in paper_rows(3)]
    folders = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    found = {
        name: tuple(str(path) for path in folders if re.fullmatch(rf"{re.escape(name)}(-s\d+)?", path.name))
        for name in names
    }
    if not any(found.values()):
        raise ValueError(
            f"{folder}: expected folders of models named {', '.join(names)} (or with -s0, -s1 ...), got none"
        )
    return found


def paper_grid(rows: Sequence[PaperRow], report: Report, methods: Mapping[str, Sequence[str]]) -> Grid:
    """The paper's figures and ours, from the report's first table.

    Args:
        rows: of `paper_rows`, and rows without figures of the paper.
        report: the evaluation.
        methods: for each row's `method`, the evaluated methods whose mean it shows (models of
            several seeds); a row without one, or without cells, is n/a.
    """
    of = {row.method: row for row in report.tables[0].rows} if report.tables else {}
    heads = ("row", "here", *(f"{c[0]} (here)" for c in COLUMNS))
    paper = tuple(f"{PAPER_HEADINGS.get(name, name.upper())} (paper)" for name in PAPER_COLUMNS)
    lines = []
    for row in rows:
        names = methods.get(row.method, (row.method,))
        done = [of[name] for name in names if name in of and of[name].scenes]
        ours = [number(_mean(done, metric, of), 1, digits, "n/a") for _, metric, of, digits in COLUMNS]
        shown = ", ".join(Path(name).name for name in names) or "none"
        failed = sum(one.failed for one in done)
        lines.append((row.label, f"{shown} (**{failed} failed**)" if failed else shown, *ours, *row.figures))
    return Grid((*heads, *paper), tuple(lines))


def _mean(rows: Sequence[Row], metric: str, of: str) -> float | None:
    """Mean over the rows of a record, or of a value of their `speed` or `vfid`."""
    return mean(_value(row, metric, of) for row in rows)


def _value(row: Row, metric: str, of: str) -> float | None:
    if metric == "vfid":
        return row.vfid[of]
    if metric == "speed":
        return None if row.speed is None else getattr(row.speed, of)
    return row.scores.mean(metric, of)
