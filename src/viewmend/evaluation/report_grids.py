"""The tables of a report, as cells of text that any form can show."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from viewmend.evaluation.averages import Row, Table
from viewmend.evaluation.report import Report
from viewmend.methods import PRIVILEGED, REFERENCE

COLUMNS = (
    ("holes, dB", "psnr", "holes", 1, 2),
    ("in mask", "psnr", "holes_fg", 1, 2),
    ("only past", "psnr", "past", 1, 2),
    ("masked", "psnr", "masked", 1, 2),
    ("SSIM masked", "ssim", "masked", 1, 5),
    ("whole, dB", "psnr", "whole", 1, 2),
    ("rendered", "psnr_rendered", "whole", 1, 2),
    ("SSIM whole", "ssim", "whole", 1, 4),
    ("subject, dB", "psnr", "subject", 1, 2),
    ("alpha IoU", "alpha_iou", "whole", 1, 4),
    ("flicker", "flicker", "holes", 255, 2),
    ("flicker whole", "flicker", "whole", 255, 2),
    ("still", "change", "still", 255, 2),
    ("warp", "warp_error", "holes", 255, 2),
    ("change", "change", "holes", 255, 2),
)
"""Columns of the main table: heading, metric, region, factor, decimals."""
READINGS = (("whole", "whole"), ("holes", "holes"), ("in mask", "holes_fg"), ("masked", "masked"))
"""How each score is read, and the region."""
SCORES = (("PSNR", "psnr", 2), ("SSIM", "ssim", 5), ("LPIPS Alex", "lpips_alex", 4), ("LPIPS VGG", "lpips_vgg", 4))
"""Each score, the metric, decimals."""
VFIDS = ("VFID whole", "VFID masked", "VFID whole, train", "VFID masked, train")


@dataclass(frozen=True)
class Grid:
    """A table of text; `**bold**` and `*italic*` as in Markdown."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def setting_lines(report: Report) -> list[str]:
    """How, where and by which code the figures came about."""
    settings = report.settings
    rule = settings.stream.render.error_rule or "of each"
    lines = [
        f"Protocol {report.protocol}; {settings.device}, {settings.precision}; "
        f"{settings.stream.render.cameras} closest cameras; error rule {rule}; "
        f"SSIM {settings.ssim}; scored upon {settings.background}."
    ]
    return lines + [
        f"Computed by viewmend {o.viewmend}, commit {o.commit}, Python {o.python}, torch {o.torch}, on {o.device}; "
        f"{o.jobs} process{'es' if o.jobs > 1 else ''} of {o.threads} threads, load {o.load}."
        for o in report.origins
    ]


def holes_line(table: Table) -> str:
    """How much there is to fill, and what is left out."""
    sizes = " and ".join(f"{width} x {height}" for width, height in table.sizes_px)
    of_hull, of_image, of_surface = (
        next((v for row in table.rows if (v := row.scores.mean("hole_fraction", of)) is not None), None)
        for of in ("hull", "image", "only_past")
    )
    past = f"; only the past shows {number(of_surface, 100, 2)} % of the missing surface" if of_surface else ""
    return (
        f"{table.frames} frames of {sizes or 'no size'}; holes {number(of_hull, 100, 2)} % of the hull, "
        f"{number(of_image, 100, 3)} % of the image{past}; {table.thin_frames} frames with too few hole pixels left "
        f"out, {table.empty_frames} of them with none."
    )


def main_grid(table: Table) -> Grid:
    """The scores that tell most, speed, and what failed; the truth's own change in the last row."""
    heads = ("method", f"over {REFERENCE}", *(c[0] for c in COLUMNS), "FPS", "ms", "ms p95", "scenes", "failed")
    rows = [_method_row(row, len(heads)) for row in table.rows]
    return Grid(heads, (*rows, _truth_row(table.rows, len(heads))))


def readings_grid(table: Table) -> Grid:
    """All scores in all readings, and VFID."""
    heads = ("method", *(f"{score} {reading}" for score, _, _ in SCORES for reading, _ in READINGS), *VFIDS)
    rows = []
    for row in table.rows:
        cells = [
            number(row.scores.mean(metric, region), 1, digits, "n/a")
            for _, metric, digits in SCORES
            for _, region in READINGS
        ]
        rows.append((row.method, *cells, *(number(value, 1, 4, "n/a") for value in asdict(row.vfid).values())))
    return Grid(heads, tuple(rows))


def kinds_grid(report: Report) -> Grid:
    """PSNR in the holes by rig and style, and the gain over the reference."""
    rows = [
        (
            table.title,
            *(f"{number(r.scores.mean('psnr', 'holes'), 1, 2)} ({_signed(r.over_reference)})" for r in table.rows),
        )
        for table in report.kinds
    ]
    return Grid(("kind", *report.methods), tuple(rows))


def scenes_grid(report: Report) -> Grid:
    """PSNR in the holes of each scene."""
    holes = {(r.scene, r.method): number(r.value, 1, 2) for r in report.scores.where(metric="psnr", region="holes")}
    cells = {(c.key.scene, c.key.method): "-" if c.error is None else "**failed**" for c in report.cells} | holes
    shares = report.scores.by_scene("hole_fraction", "hull")
    rows = [
        (scene, number(shares.get(scene), 100, 2), *(cells.get((scene, method), "n/a") for method in report.methods))
        for scene in dict.fromkeys(scene for scene, _ in cells)
    ]
    return Grid(("scene", "holes, % of the hull", *report.methods), tuple(rows))


def not_available(report: Report) -> list[str]:
    """What is missing, with its reason, in one line for all that share it."""
    missing = report.missing | report.missing_networks
    of = {reason: [name for name in missing if missing[name] == reason] for reason in missing.values()}
    return [f"{', '.join(names)}: {reason}" for reason, names in of.items()]


def number(value: float | None, factor: int, digits: int, none: str = "-") -> str:
    """A number with so many decimals, `none` for none."""
    return none if value is None else f"{factor * value:.{digits}f}"


def _method_row(row: Row, width: int) -> tuple[str, ...]:
    if not row.scenes:
        return (row.method, *["n/a"] * (width - 1))
    name = f"{row.method} (sees past truth)" if row.method in PRIVILEGED else row.method
    return (
        name,
        _signed(row.over_reference),
        *(number(row.scores.mean(metric, of), factor, digits) for _, metric, of, factor, digits in COLUMNS),
        *(number(getattr(row.speed, name, None), 1, 1) for name in ("fps", "ms_p50", "ms_p95")),
        str(row.scenes) if row.scored_scenes == row.scenes else f"{row.scored_scenes} of {row.scenes}",
        f"**{row.failed}**" if row.failed else "0",
    )


def _truth_row(rows: Sequence[Row], width: int) -> tuple[str, ...]:
    """The truth's own change, which a perfect method would show."""
    shown = []
    for _, metric, region, factor, digits in COLUMNS:
        means = (row.scores.mean(f"{metric}_truth", region) for row in rows)
        shown.append(number(next((value for value in means if value is not None), None), factor, digits, ""))
    return ("*truth*", "", *shown, *[""] * (width - 2 - len(shown)))


def _signed(value: float | None) -> str:
    return "-" if value is None else f"{value:+.2f}"
