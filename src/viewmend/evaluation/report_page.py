"""A report as one page to look at: tables, trade-off, pictures side by side, videos; it asks nobody for anything."""

import base64
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from viewmend.evaluation.averages import Table
from viewmend.evaluation.cells import Cell, CellStore
from viewmend.evaluation.film import Picture
from viewmend.evaluation.report import RULES, Report
from viewmend.evaluation.report_grids import (
    Grid,
    holes_line,
    kinds_grid,
    main_grid,
    not_available,
    readings_grid,
    setting_lines,
)
from viewmend.evaluation.report_plot import MissingMatplotlibError, Point, trade_off
from viewmend.evaluation.report_sheets import columns, largest_hole
from viewmend.evaluation.report_style import STYLE
from viewmend.evaluation.report_video import scene_video

DIFFERENCE_GAIN = 3
"""How much brighter than they are differences are shown."""
WHOLE_PX = 360
"""Longer side of whole views."""


def page(report: Report, cells: Sequence[Cell], store: CellStore, shown: int = 12, video: bool = True) -> str:
    """The whole page; pictures and videos of the first scenes `shown` of each set are in it."""
    title = f"Evaluation: {', '.join(dict.fromkeys(cell.set for cell in cells)) or 'nothing'}"
    parts = [f"<h1>{escape(title)}</h1>", *(f"<p>{escape(line)}</p>" for line in setting_lines(report))]
    parts += [_table(table) for table in report.tables]
    if missing := not_available(report):
        parts += ["<h2>Not available</h2>", _list(missing)]
    failed = [f"{c.key.scene}, {c.key.method}: {c.error}" for c in cells if c.error is not None]
    if failed:
        parts += ["<h2>Failed</h2>", _list(failed)]
    if report.kinds:
        parts += ["<h2>By rig and style</h2><p>PSNR in the holes, dB, and the gain.</p>", _grid(kinds_grid(report))]
    parts += ["<h2>What the figures mean</h2>", _list(RULES), "<h2>Scenes</h2>", _legend()]
    for scene in _first_scenes(cells, shown):
        parts.append(_scene(scene, [cell for cell in cells if cell.key.scene == scene], store, video))
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style>"
    )
    return f'<!doctype html><html lang="en"><head>{head}</head><body><main>{"".join(parts)}</main></body></html>\n'


def _first_scenes(cells: Sequence[Cell], count: int) -> list[str]:
    of: dict[str, dict[str, None]] = {}
    for cell in cells:
        of.setdefault(cell.set, {})[cell.key.scene] = None
    return [scene for scenes in of.values() for scene in list(scenes)[:count]]


def _table(table: Table) -> str:
    points = [
        Point(row.method, row.speed.ms_p50, db)
        for row in table.rows
        if row.speed is not None and (db := row.scores.mean("psnr", "holes")) is not None
    ]
    try:
        plot = trade_off(points, "PSNR in the holes, dB", f"{table.title}: quality against milliseconds")
    except MissingMatplotlibError as error:
        plot = f"<p>There is no plot here: {escape(str(error))}</p>"
    return (
        f"<h2>{escape(table.title)}</h2><p>{escape(holes_line(table))}</p>{_grid(main_grid(table))}"
        f'<div class="wide">{plot}</div>'
        f"<details><summary>Every score in every reading</summary>{_grid(readings_grid(table))}</details>"
    )


def _legend() -> str:
    return (
        "<p>At the time of each scene's largest hole: the whole view; its largest hole up close; there, the difference "
        f"from the truth in every pixel, {DIFFERENCE_GAIN} times as bright. Then the first frames as a video. "
        "Scenes that are not here are in sheets/.</p>"
    )


def _scene(scene: str, cells: Sequence[Cell], store: CellStore, video: bool) -> str:
    shared = store.pictures(cells[0].key)
    parts = [f"<h3>{escape(scene)}</h3>"]
    if shared is not None:
        top, left, side = largest_hole(shared.error)
        close = slice(top, top + side), slice(left, left + side)
        figures = [_column(label, image, shared.truth, close) for label, image in columns(cells, shared, store)]
        parts.append(f'<div class="wide"><div class="views">{"".join(figures)}</div></div>')
    shown = scene_video(cells, store) if video else None
    if shown is not None:
        kind, data = shown
        source = f"data:{kind};base64,{base64.b64encode(data).decode()}"
        parts.append(
            f"<details><summary>Video of {escape(scene)}</summary>"
            f'<video controls loop muted playsinline preload="metadata" src="{source}"></video></details>'
        )
    return f"<section>{''.join(parts)}</section>"


def _column(label: str, image: Picture | None, truth: Picture, close: tuple[slice, slice]) -> str:
    if image is None:
        return f'<figure><figcaption>{escape(label)}</figcaption><div class="none">no picture</div></figure>'
    whole = _image(_smaller(image), f"{label}, whole view", ".jpg")
    near = _image(image[close], f"{label}, largest hole", ".png")
    differs = ""
    if label not in ("E", "truth"):
        difference = np.abs(image[close].astype(np.int16) - truth[close]) * DIFFERENCE_GAIN
        differs = _image(difference.clip(0, 255).astype(np.uint8), f"{label}, difference from the truth", ".png")
    return f"<figure><figcaption>{escape(label)}</figcaption>{whole}{near}{differs}</figure>"


def _smaller(image: Picture) -> Picture:
    import cv2

    zoom = min(1.0, WHOLE_PX / max(image.shape[:2]))
    size = round(image.shape[1] * zoom), round(image.shape[0] * zoom)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _image(image: Picture, said: str, suffix: str) -> str:
    import cv2

    _, encoded = cv2.imencode(suffix, cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR))
    data = base64.b64encode(encoded.tobytes()).decode()
    kind = "jpeg" if suffix == ".jpg" else "png"
    height, width = image.shape[:2]
    return (
        f'<img class="{kind}" alt="{escape(said)}" title="{escape(said)}" width="{width}" '
        f'height="{height}" src="data:image/{kind};base64,{data}">'
    )


def _grid(grid: Grid) -> str:
    def cells(kind: str, line: Sequence[str]) -> str:
        shown = (cell.strip("*") for cell in line)
        marked = (f"<strong>{escape(s)}</strong>" if "**" in c else escape(s) for c, s in zip(line, shown, strict=True))
        return "<tr>" + "".join(f"<{kind}>{m}</{kind}>" for m in marked) + "</tr>"

    rows = "".join(cells("td", row) for row in grid.rows)
    return f'<div class="wide"><table><thead>{cells("th", grid.heads)}</thead><tbody>{rows}</tbody></table></div>'


def _list(lines: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"
