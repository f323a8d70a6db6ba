"""A report as one self-contained HTML page, and a contact sheet of images for each scene."""

import base64
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np

from viewmend.data.images import write_image
from viewmend.evaluation.report import Block, Grid, Report, figures, notes
from viewmend.evaluation.result_cache import Cell, CellStore, SceneImages, slug
from viewmend.utils.contact_sheet import Picture, Tile, contact_sheet

DIFFERENCE_GAIN = 3
"""Factor by which differences are brightened."""
TILE_PX = 288
"""Width of the images on a contact sheet."""
CLOSE_UP_SHARE = 6
"""A close-up is 1/6 of the view's shorter side, or as large as the hole."""
LEGEND = (
    "Each scene at its frame with the most hole pixels, a row for each method: the whole view, a close-up of the "
    f"largest hole, and its difference from the true view, {DIFFERENCE_GAIN} times brighter. All scenes are in sheets/."
)


def page(report: Report, store: CellStore, shown: int = 12) -> str:
    """The whole page, with images of the first `shown` scenes of each set."""
    import cv2

    parts = [*map(_html, figures(report)), f"<h2>Images</h2><p>{LEGEND}</p>"]
    for scene in _first_scenes(report.cells, shown):
        sheet = scene_sheet([cell for cell in report.cells if cell.key.scene == scene], store)
        if sheet is not None:
            data = base64.b64encode(cv2.imencode(".jpg", sheet[..., ::-1])[1].tobytes()).decode()
            image = f'<img alt="{escape(scene)}" src="data:image/jpeg;base64,{data}">'
            parts.append(f'<h3>{escape(scene)}</h3><div class="wide">{image}</div>')
    parts += map(_html, notes(report))
    style = (files("viewmend.evaluation") / "report.css").read_text(encoding="utf-8")
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Evaluation</title><style>{style}</style>"
    )
    return f'<!doctype html><html lang="en"><head>{head}</head><body><main>{"".join(parts)}</main></body></html>\n'


def write_sheets(cells: Sequence[Cell], store: CellStore, folder: Path) -> list[Path]:
    """Write FOLDER/SCENE.png for every scene that has images; returns the files.

    Names that are the same once they are part of a file name are numbered.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for number, scene in enumerate(dict.fromkeys(cell.key.scene for cell in cells)):
        sheet = scene_sheet([cell for cell in cells if cell.key.scene == scene], store)
        if sheet is not None:
            file = folder / f"{slug(scene)}.png"
            if file in written:
                file = folder / f"{slug(scene)}--{number}.png"
            written.append(file)
            write_image(file, sheet)
    return written


def scene_sheet(cells: Sequence[Cell], store: CellStore) -> Picture | None:
    """The images of one scene's cells, see `LEGEND`; None if there are none."""
    images = store.scene_images(cells[0].key)
    if images is None:
        return None
    top, left, side = largest_hole(images.error)
    close = (slice(top, top + side), slice(left, left + side))
    rows = []
    for label, image in _labelled_images(cells, images, store):
        near = None if image is None else np.ascontiguousarray(image[close])
        difference = None
        if near is not None and label not in ("E", "true"):
            off = np.abs(near.astype(np.int16) - images.truth[close])
            difference = (off * DIFFERENCE_GAIN).clip(0, 255).astype(np.uint8)
        rows.append([Tile(label, image), Tile("close-up", near), Tile("difference", difference)])
    return contact_sheet(rows, TILE_PX)


def largest_hole(error: Picture) -> tuple[int, int, int]:
    """Top, left and side of a square inside the image around the largest connected part of E; the centre without E."""
    import cv2

    height, width = error.shape[:2]
    count, _, stats, _ = cv2.connectedComponentsWithStats(
        (error[..., 0] > 0).astype(np.uint8), connectivity=8
    )
    smallest = max(1, min(height, width) // CLOSE_UP_SHARE)
    x = 0
    y = 0
    wide = width
    high = height
    if count > 1:
        part = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
        x, y, wide, high = (int(v) for v in stats[part, :4])
        smallest = max(smallest, wide + 8, high + 8)
    side = min(smallest, height, width)
    top = min(max(0, y + high // 2 - side // 2), height - side)
    left = min(max(0, x + wide // 2 - side // 2), width - side)
    return top, left, side


def _first_scenes(cells: Sequence[Cell], count: int) -> list[str]:
    of: dict[str, dict[str, None]] = {}
    for cell in cells:
        of.setdefault(cell.set, {})[cell.key.scene] = None
    return [scene for scenes in of.values() for scene in list(scenes)[:count]]


def _labelled_images(
    cells: Sequence[Cell], shared: SceneImages, store: CellStore
) -> list[tuple[str, Picture | None]]:
    """A scene's images with labels: E, rendered, each method, true; None for a method that failed."""
    shown: list[tuple[str, Picture | None]] = [("E", shared.error), ("rendered", shared.rendered)]
    for cell in cells:
        if cell.error is not None:
            shown.append((f"{cell.key.method}: failed", None))
            continue
        score = max(cell.frames, key=lambda frame: frame.hole_px).psnr_holes
        shown.append((cell.key.method + ("" if score is None else f" {score:.2f} dB"), store.image(cell.key)))
    return [*shown, ("true", shared.truth)]


def _html(block: Block) -> str:
    if isinstance(block, Grid):
        return _table(block)
    if isinstance(block, list):
        return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in block)}</ul>"
    level = len(block) - len(block.lstrip("#"))
    kind = f"h{level}" if level else "p"
    return f"<{kind}>{escape(block.lstrip('# '))}</{kind}>"


def _table(grid: Grid) -> str:
    """A table whose later columns appear when a box is ticked, and which may be folded away."""
    hidden = grid.first is not None and grid.first < len(grid.heads)
    first = grid.first if hidden else None
    head = "".join(
        _cell(text, "th", n, first, grid.meanings.get(text, "")) for n, text in enumerate(grid.heads)
    )
    rows = ("".join(_cell(text, "td", n, first) for n, text in enumerate(row)) for row in grid.rows)
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    table = f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    if hidden:
        table = f'<div class="columns"><label><input type="checkbox"> all columns</label>{table}</div>'
    return f"<details><summary>{escape(grid.folded)}</summary>{table}</details>" if grid.folded else table


def _cell(text: str, kind: str, column: int, first: int | None, meaning: str = "") -> str:
    """A cell; from column `first` on, it is hidden until all columns are asked for."""
    later = ' class="later"' if first is not None and column >= first else ""
    hover = f' title="{escape(meaning)}"' if meaning else ""
    shown = escape(text.strip("*"))
    if "**" in text:
        shown = f"<strong>{shown}</strong>"
    return f"<{kind}{later}{hover}>{shown}</{kind}>"
