"""The paper's three tables: its own figures, which of our methods stands in each row, and both side by side.

Figures are those that the paper prints; its data, its image size and its GPU are not ours, so they stand beside ours in
columns of their own and nothing is computed from both.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from viewmend.evaluation.averages import Row
from viewmend.evaluation.records import mean
from viewmend.evaluation.report import Report
from viewmend.evaluation.report_grids import Grid, number


@dataclass(frozen=True)
class PaperFigures:
    """What the paper prints in a row; None where it prints nothing. PSNR in dB, FPS on a GPU that it does not name."""

    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    vfid: float | None = None
    psnr_holes: float | None = None
    """"Inpainted regions": over the pixels of E by the text; what it prints looks more like masked images."""
    ssim_holes: float | None = None
    lpips_holes: float | None = None
    fps: float | None = None


@dataclass(frozen=True)
class PaperRow:
    """One row: how the paper calls it, what it prints, and the name of our method."""

    label: str
    method: str
    figures: PaperFigures


NO_FIGURES = PaperFigures()
OURS = "ours"
"""Stands for the model that takes the row of the paper's own."""


def _rows(network: str, method: str, text: str) -> tuple[PaperRow, ...]:
    """Rows of def, win and mul, one line of eight figures each."""
    lines = [PaperFigures(*map(float, line.split())) for line in text.strip().splitlines()]
    return tuple(
        PaperRow(f"{network}, {framing}", method.replace("*", framing), figures)
        for framing, figures in zip(("def", "win", "mul"), lines, strict=True)
    )


TABLE_1: tuple[PaperRow, ...] = (
    PaperRow(
        "RGVI (offline; sees the truth of past frames)",
        "rgvi",
        PaperFigures(33.478, 0.9881, 0.0140, 1.6203, 42.582, 0.99834, 0.00678, 3.09),
    ),
    *_rows(
        "DSTT pretrained",
        "dstt-o-*",
        """
        31.532 0.9827 0.0332 3.2139 35.091 0.99733 0.00761 12.82
        31.986 0.9835 0.0317 2.4210 36.252 0.99788 0.00477 5.96
        32.045 0.9835 0.0316 2.3864 36.490 0.99793 0.00470 1.71
        """,
    ),
    *_rows(
        "DSTT finetuned",
        "dstt-o-*-finetuned",
        """
        31.341 0.9825 0.0341 3.4281 34.972 0.99731 0.00747 13.68
        31.913 0.9833 0.0317 2.8144 37.642 0.99770 0.00889 3.40
        31.937 0.9833 0.0326 2.5660 36.391 0.99789 0.00473 1.70
        """,
    ),
    *_rows(
        "FuseFormer pretrained",
        "fuseformer-o-*",
        """
        31.884 0.9832 0.0316 3.1830 35.421 0.99749 0.00646 8.64
        32.050 0.9836 0.0310 2.2516 36.107 0.99785 0.00473 3.61
        32.156 0.9838 0.0303 2.2095 36.371 0.99791 0.00458 0.76
        """,
    ),
    *_rows(
        "FuseFormer finetuned",
        "fuseformer-o-*-finetuned",
        """
        31.726 0.9829 0.0325 3.3018 35.317 0.99746 0.00672 7.50
        31.930 0.9834 0.0323 2.5002 36.090 0.99785 0.00477 3.37
        31.978 0.9835 0.0320 2.4637 36.236 0.99789 0.00473 0.75
        """,
    ),
    *_rows(
        "E2FGVI pretrained",
        "e2fgvi-o-*",
        """
        31.834 0.9831 0.0320 3.1350 35.444 0.99750 0.00666 6.14
        32.055 0.9837 0.0311 2.2489 36.210 0.99788 0.00467 3.07
        32.155 0.9838 0.0306 2.1975 36.430 0.99791 0.00458 0.90
        """,
    ),
    *_rows(
        "E2FGVI finetuned",
        "e2fgvi-o-*-finetuned",
        """
        31.908 0.9832 0.0314 3.1274 35.299 0.99744 0.00690 7.10
        31.895 0.9833 0.0324 2.5528 35.769 0.99771 0.00527 3.07
        31.879 0.9832 0.0325 2.5562 35.742 0.99766 0.00541 0.92
        """,
    ),
    PaperRow(
        "the paper's model",
        OURS,
        PaperFigures(32.616, 0.9851, 0.0262, 1.6671, 42.184, 0.99911, 0.00224, 41.55),
    ),
)
"""DNA-Rendering, 7 test scenes; def: at 432 x 240; win: windows; mul: windows, with the other cameras' frames."""
TABLE_2: tuple[PaperRow, ...] = (
    PaperRow(
        "DSTT pretrained, mul", "dstt-o-mul", PaperFigures(32.977, 0.9822, 0.0159, 1.4968, 36.051, 0.9967, 0.0109, 0.71)
    ),
    PaperRow(
        "FuseFormer pretrained, mul",
        "fuseformer-o-mul",
        PaperFigures(32.678, 0.9832, 0.0206, 1.4056, 37.361, 0.9975, 0.0095, 0.69),
    ),
    PaperRow(
        "E2FGVI pretrained, mul",
        "e2fgvi-o-mul",
        PaperFigures(32.766, 0.9833, 0.0204, 1.3748, 37.535, 0.9976, 0.0092, 0.82),
    ),
    PaperRow("the paper's model", OURS, PaperFigures(33.059, 0.9800, 0.0287, 0.9953, 42.192, 0.9989, 0.0031, 37.01)),
)
"""RIFTCast's captures, without retraining."""
TABLE_3: tuple[PaperRow, ...] = (
    PaperRow(
        "single camera, without masks",
        "single-camera-no-masks",
        PaperFigures(32.400, 0.9846, 0.0261, 1.6009, 34.426, 0.9971, 0.0092, 87.46),
    ),
    PaperRow(
        "single camera", "single-camera", PaperFigures(32.277, 0.9843, 0.0275, 1.7331, 40.004, 0.9986, 0.0034, 79.43)
    ),
    PaperRow(
        "without past frames", "no-past", PaperFigures(32.237, 0.9843, 0.0275, 1.7320, 39.838, 0.9986, 0.0039, 41.32)
    ),
    PaperRow("without RoPE", "no-rope", PaperFigures(32.046, 0.9839, 0.0278, 1.7963, 38.920, 0.9983, 0.0050, 41.05)),
    PaperRow("full", "full", PaperFigures(32.616, 0.9851, 0.0262, 1.6671, 42.184, 0.9991, 0.0022, 41.55)),
)
"""The ablation, on DNA-Rendering."""
TABLES: dict[int, tuple[PaperRow, ...]] = {1: TABLE_1, 2: TABLE_2, 3: TABLE_3}
OUR_COLUMNS = (
    ("PSNR", "psnr", "whole", 3),
    ("SSIM", "ssim", "whole", 4),
    ("LPIPS", "lpips_alex", "whole", 4),
    ("VFID", "vfid", "whole_eval", 4),
    ("PSNR holes (a)", "psnr", "holes", 3),
    ("PSNR masked (b)", "psnr", "masked", 3),
    ("SSIM masked", "ssim", "masked", 5),
    ("LPIPS masked", "lpips_alex", "masked", 5),
    ("FPS", "speed", "fps", 2),
    ("ms p95", "speed", "ms_p95", 1),
)
"""Heading, metric and region of our records (or a field of a row and one of its own), decimals."""
PAPER_DIGITS = {
    "psnr": 3,
    "ssim": 4,
    "lpips": 4,
    "vfid": 4,
    "psnr_holes": 3,
    "ssim_holes": 5,
    "lpips_holes": 5,
    "fps": 2,
}


def ablation_models(folder: Path) -> dict[str, tuple[str, ...]]:
    """The models of Table 3 in a folder: NAME, or NAME-s0, NAME-s1 ... for several seeds; () for those without.

    Raises:
        ValueError: there is none.
    """
    names = [row.method for row in TABLE_3]
    folders = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    found = {
        name: tuple(str(path) for path in folders if re.fullmatch(rf"{re.escape(name)}(-s\d+)?", path.name))
        for name in names
    }
    if not any(found.values()):
        raise ValueError(
            f"{folder}: expected folders of models named {', '.join(names)}, with -s0, -s1 ... behind for seeds, got "
            "none; viewmend ablation trains them"
        )
    return found


def paper_grid(rows: Sequence[PaperRow], report: Report, methods: Mapping[str, Sequence[str]]) -> Grid:
    """The paper's figures and ours, of the report's first table.

    Args:
        rows: of `TABLES`, and others without figures of the paper.
        report: what was evaluated.
        methods: for each row's `method`, the evaluated methods whose mean stands in it (models of several seeds); a
            row without one, or one without cells, is n/a.
    """
    of = {row.method: row for row in report.tables[0].rows} if report.tables else {}
    heads = ("row", "here", *(f"{c[0]} (here)" for c in OUR_COLUMNS))
    paper = tuple(f"{f.name.replace('_', ' ').upper()} (paper)" for f in fields(PaperFigures))
    lines = []
    for row in rows:
        names = methods.get(row.method, (row.method,))
        done = [of[name] for name in names if name in of and of[name].scenes]
        ours = [number(_ours(done, metric, of), 1, digits, "n/a") for _, metric, of, digits in OUR_COLUMNS]
        printed = [number(getattr(row.figures, name), 1, digits) for name, digits in PAPER_DIGITS.items()]
        shown = ", ".join(Path(name).name for name in names) or "none"
        failed = sum(one.failed for one in done)
        lines.append((row.label, f"{shown} (**{failed} failed**)" if failed else shown, *ours, *printed))
    return Grid((*heads, *paper), tuple(lines))


def _ours(rows: Sequence[Row], metric: str, of: str) -> float | None:
    """Our figure in a column: the mean over the rows."""
    parts = [getattr(row, metric, None) for row in rows]
    return mean(getattr(part, of, None) or row.scores.mean(metric, of) for part, row in zip(parts, rows, strict=True))
