"""A report as one self-contained HTML page (tables, plots, images, videos), and a contact sheet for each scene."""

import base64
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from viewmend.data.images import write_image
from viewmend.data.videos import write_mp4
from viewmend.evaluation.averages import Table
from viewmend.evaluation.report import (
    RULES,
    Grid,
    Report,
    holes_line,
    kinds_grid,
    main_grid,
    not_available,
    readings_grid,
    setting_lines,
)
from viewmend.evaluation.result_cache import Cell, CellStore, SceneImages, slug
from viewmend.evaluation.video_strip import STRIP_PX, Picture
from viewmend.utils.contact_sheet import Tile, contact_sheet, in_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DIFFERENCE_GAIN = 3
"""Factor by which differences are brightened."""
WHOLE_PX = 360
"""Longer side of whole views on the page."""
TILE_PX = 288
"""Width of the images on a contact sheet."""
CLOSE_UP_SHARE = 6
"""A close-up is 1/6 of the view's shorter side, or as large as the hole."""
VIDEO_FPS = 6.0
"""Slow enough to notice flicker."""
VIDEO_COLUMNS = 4
MIN_VIDEO_FRAMES = 2
MIN_PLOT_MS = 0.1
"""Faster steps are plotted here; the axis is logarithmic."""
LABEL_SIZE_PX = 150.0, 13.0
"""Space reserved for a label in a plot: width, height."""
INK = "#1a1a1a"
"""Colour of axes and text."""
PLOT_STYLE: Any = {
    "svg.hashsalt": "viewmend",
    "svg.fonttype": "none",
    "font.size": 12,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
    "axes.spines.top": False,
    "axes.spines.right": False,
}
"""Equal figures give equal bytes, and text stays text."""


def page(report: Report, store: CellStore, shown: int = 12, video: bool = True) -> str:
    """The whole page, with images and videos of the first `shown` scenes of each set."""
    cells = report.cells
    style = (files("viewmend.evaluation") / "report.css").read_text()
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
    legend = (
        "At the frame with the largest hole of each scene: the whole view; a close-up of the largest hole; its "
        f"difference from the truth, {DIFFERENCE_GAIN} times brighter. Then a video of the first frames. Further "
        "scenes are in sheets/."
    )
    parts += ["<h2>What the figures mean</h2>", _list(RULES), f"<h2>Scenes</h2><p>{legend}</p>"]
    for scene in _first_scenes(cells, shown):
        parts.append(_scene(scene, [cell for cell in cells if cell.key.scene == scene], store, video))
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style>"
    )
    return f'<!doctype html><html lang="en"><head>{head}</head><body><main>{"".join(parts)}</main></body></html>\n'


def write_sheets(cells: Sequence[Cell], store: CellStore, folder: Path) -> list[Path]:
    """Write FOLDER/SCENE.png for every scene that has images: all methods at the largest hole, and close up."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for scene in dict.fromkeys(cell.key.scene for cell in cells):
        own = [cell for cell in cells if cell.key.scene == scene]
        images = store.scene_images(own[0].key)
        if images is None:
            continue
        columns, close = _columns(own, images, store), _close_up(images)
        whole = [Tile(label, image) for label, image in columns]
        near = [Tile("", None if image is None else np.ascontiguousarray(image[close])) for _, image in columns]
        written.append(folder / f"{slug(scene)}.png")
        write_image(written[-1], contact_sheet([whole, near], TILE_PX))
    return written


def scene_video(cells: Sequence[Cell], store: CellStore) -> bytes | None:
    """An MP4 of one scene's cells side by side: rendered, each method, truth; None without frames."""
    done = [cell for cell in cells if cell.error is None]
    rendered, truth = store.scene_strip(done[0]) if done else ([], [])
    if len(truth) < MIN_VIDEO_FRAMES:
        return None
    strips = [("rendered", rendered), *((cell.key.method, store.strip(cell)) for cell in done), ("truth", truth)]
    strips = [(name, frames) for name, frames in strips if len(frames) == len(truth)]
    rows = (in_rows([Tile(name, frames[n]) for name, frames in strips], VIDEO_COLUMNS) for n in range(len(truth)))
    mp4 = io.BytesIO()
    write_mp4(mp4, [contact_sheet(tiles, STRIP_PX) for tiles in rows], VIDEO_FPS)
    return mp4.getvalue()


def largest_hole(error: Picture) -> tuple[int, int, int]:
    """Top, left and side of a square inside the image around the largest connected part of E; the centre without E."""
    import cv2

    height, width = error.shape[:2]
    count, _, stats, _ = cv2.connectedComponentsWithStats((error[..., 0] > 0).astype(np.uint8), connectivity=8)
    smallest = max(1, min(height, width) // CLOSE_UP_SHARE)
    x, y, wide, high = 0, 0, width, height
    if count > 1:
        part = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
        x, y, wide, high = (int(v) for v in stats[part, :4])
        smallest = max(smallest, wide + 8, high + 8)
    side = min(smallest, height, width)
    top = min(max(0, y + high // 2 - side // 2), height - side)
    left = min(max(0, x + wide // 2 - side // 2), width - side)
    return top, left, side


class MissingMatplotlibError(ValueError):
    """A plot needs matplotlib, which is not installed."""

    def __init__(self) -> None:
        super().__init__("plots need matplotlib: pip install 'viewmend[all]'")


@dataclass(frozen=True)
class Point:
    """One method in a plot."""

    name: str
    ms: float
    quality: float


def require_matplotlib() -> None:
    """Raise MissingMatplotlibError if matplotlib is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise MissingMatplotlibError from error


def trade_off(points: Sequence[Point], quality: str, title: str) -> str:
    """An `<svg>` of quality over median milliseconds (logarithmic) of all methods; "" without any.

    Text and axes have the page's colour (`currentColor`), for light and dark mode.

    Raises:
        MissingMatplotlibError: matplotlib is not installed.
    """
    if not points:
        return ""
    require_matplotlib()
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(PLOT_STYLE):
        figure = Figure((10, 5.56), dpi=72)
        axes = figure.add_axes((0.09, 0.12, 0.7, 0.83))
        axes.set(xscale="log", xlabel="milliseconds per step, median", ylabel=quality)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.grid(alpha=0.3, clip_on=False)
        for n, point in enumerate(points):
            axes.plot(max(point.ms, MIN_PLOT_MS), point.quality, "o", color="#0b62c4", clip_on=False, gid=f"dot{n}")
        axes.margins(0.05, 0.1)
        axes.autoscale_view()
        _label_points(axes, points)
        svg = figure_svg(figure, transparent=True).replace(INK, "currentColor")
    for n, point in enumerate(points):
        text = f"{point.name}: {point.quality:.2f}, {point.ms:.1f} ms"
        svg = svg.replace(f'<g id="dot{n}">', f'<g class="dot"><title>{escape(text)}</title>')
    return svg.replace("<svg ", f'<svg class="plot" role="img" aria-label="{escape(title)}" ', 1)


def figure_svg(figure: "Figure", transparent: bool = False) -> str:
    """The figure's `<svg>` element, without date and metadata."""
    file = io.StringIO()
    figure.savefig(
        file, format="svg", transparent=transparent, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
    )
    svg = file.getvalue()
    return re.sub(r"font-family: [^;]*", "font-family: inherit", svg[svg.index("<svg ") :])


def _label_points(axes: "Axes", points: Sequence[Point]) -> None:
    """Names next to the points, shifted towards the middle where they would overlap."""
    width, height = LABEL_SIZE_PX
    positions = [tuple(axes.transData.transform((max(p.ms, MIN_PLOT_MS), p.quality))) for p in points]
    middle = float(axes.transAxes.transform((0, 0.5))[1])
    written: list[tuple[float, float]] = []
    for n in sorted(range(len(positions)), key=lambda i: -abs(positions[i][1] - middle)):
        across, at = positions[n]
        step = math.copysign(height, middle - at)
        while any(abs(x - across) < width and abs(y - at) < height for x, y in written):
            at += step
        written.append((across, at))
        axes.annotate(
            points[n].name, positions[n], (across + 8, at - 4), xycoords="figure pixels", textcoords="figure pixels"
        )


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
        plot = f"<p>No plot: {escape(str(error))}</p>"
    return (
        f"<h2>{escape(table.title)}</h2><p>{escape(holes_line(table))}</p>{_grid(main_grid(table))}"
        f'<div class="wide">{plot}</div>'
        f"<details><summary>All scores in all readings</summary>{_grid(readings_grid(table))}</details>"
    )


def _scene(scene: str, cells: Sequence[Cell], store: CellStore, video: bool) -> str:
    images = store.scene_images(cells[0].key)
    parts = [f"<h3>{escape(scene)}</h3>"]
    if images is not None:
        close = _close_up(images)
        figures = [_figure(label, image, images.truth, close) for label, image in _columns(cells, images, store)]
        parts.append(f'<div class="wide"><div class="views">{"".join(figures)}</div></div>')
    mp4 = scene_video(cells, store) if video else None
    if mp4 is not None:
        source = f"data:video/mp4;base64,{base64.b64encode(mp4).decode()}"
        parts.append(
            f"<details><summary>Video of {escape(scene)}</summary>"
            f'<video controls loop muted playsinline preload="metadata" src="{source}"></video></details>'
        )
    return f"<section>{''.join(parts)}</section>"


def _columns(cells: Sequence[Cell], shared: SceneImages, store: CellStore) -> list[tuple[str, Picture | None]]:
    """A scene's images with labels: rendered, E, each method, truth; None for a method that failed."""
    shown: list[tuple[str, Picture | None]] = [("rendered", shared.rendered), ("E", shared.error)]
    for cell in cells:
        if cell.error is None:
            score = max(cell.frames, key=lambda frame: frame.hole_px).psnr_holes
            label = cell.key.method if score is None else f"{cell.key.method} {score:.2f} dB"
            shown.append((label, store.image(cell.key)))
        else:
            shown.append((f"{cell.key.method}: failed", None))
    return [*shown, ("truth", shared.truth)]


def _close_up(images: SceneImages) -> tuple[slice, slice]:
    top, left, side = largest_hole(images.error)
    return slice(top, top + side), slice(left, left + side)


def _figure(label: str, image: Picture | None, truth: Picture, close: tuple[slice, slice]) -> str:
    if image is None:
        return f'<figure><figcaption>{escape(label)}</figcaption><div class="none">no image</div></figure>'
    whole = _img(_shrink(image), f"{label}, whole view", ".jpg")
    near = _img(image[close], f"{label}, largest hole", ".png")
    difference = ""
    if label not in ("E", "truth"):
        values = np.abs(image[close].astype(np.int16) - truth[close]) * DIFFERENCE_GAIN
        difference = _img(values.clip(0, 255).astype(np.uint8), f"{label}, difference from the truth", ".png")
    return f"<figure><figcaption>{escape(label)}</figcaption>{whole}{near}{difference}</figure>"


def _shrink(image: Picture) -> Picture:
    import cv2

    zoom = min(1.0, WHOLE_PX / max(image.shape[:2]))
    size = round(image.shape[1] * zoom), round(image.shape[0] * zoom)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _img(image: Picture, text: str, suffix: str) -> str:
    import cv2

    _, encoded = cv2.imencode(suffix, cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR))
    data = base64.b64encode(encoded.tobytes()).decode()
    kind = "jpeg" if suffix == ".jpg" else "png"
    height, width = image.shape[:2]
    return (
        f'<img class="{kind}" alt="{escape(text)}" title="{escape(text)}" width="{width}" '
        f'height="{height}" src="data:image/{kind};base64,{data}">'
    )


def _grid(grid: Grid) -> str:
    def cells(kind: str, line: Sequence[str]) -> str:
        texts = (cell.strip("*") for cell in line)
        marked = (f"<strong>{escape(s)}</strong>" if "**" in c else escape(s) for c, s in zip(line, texts, strict=True))
        return "<tr>" + "".join(f"<{kind}>{m}</{kind}>" for m in marked) + "</tr>"

    rows = "".join(cells("td", row) for row in grid.rows)
    return f'<div class="wide"><table><thead>{cells("th", grid.heads)}</thead><tbody>{rows}</tbody></table></div>'


def _list(lines: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"
