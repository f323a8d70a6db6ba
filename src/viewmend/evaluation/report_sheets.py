"""A contact sheet for each scene: the view with the largest hole by all methods, and its largest hole up close."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from viewmend.capture.images import write_image
from viewmend.contact_sheet import Tile, contact_sheet
from viewmend.evaluation.cells import Cell, CellPictures, CellStore, slug
from viewmend.evaluation.film import Picture

TILE_PX = 288
CLOSE_SHARE = 6
"""Up close, the picture's side is at most this part of the view's, unless the hole is larger."""


def write_sheets(cells: Sequence[Cell], store: CellStore, folder: Path) -> list[Path]:
    """Write FOLDER/SCENE.png for every scene that has pictures; the files written."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for scene in dict.fromkeys(cell.key.scene for cell in cells):
        own = [cell for cell in cells if cell.key.scene == scene]
        pictures = store.pictures(own[0].key)
        if pictures is None:
            continue
        path = folder / f"{slug(scene)}.png"
        write_image(path, contact_sheet(_rows(own, pictures, store), TILE_PX))
        written.append(path)
    return written


def columns(cells: Sequence[Cell], shared: CellPictures, store: CellStore) -> list[tuple[str, Picture | None]]:
    """A scene's pictures with their labels: rendered, E, each method, truth; None for a method that failed."""
    shown: list[tuple[str, Picture | None]] = [("rendered", shared.rendered), ("E", shared.error)]
    for cell in cells:
        if cell.error is None:
            shown.append((_label(cell), store.picture(cell.key)))
        else:
            shown.append((f"{cell.key.method}: failed", None))
    return [*shown, ("truth", shared.truth)]


def _rows(cells: Sequence[Cell], shared: CellPictures, store: CellStore) -> list[list[Tile]]:
    shown = columns(cells, shared, store)
    top, left, side = largest_hole(shared.error)
    close = slice(top, top + side), slice(left, left + side)
    whole = [Tile(label, image) for label, image in shown]
    near = [Tile("", None if image is None else np.ascontiguousarray(image[close])) for _, image in shown]
    return [whole, near]


def _label(cell: Cell) -> str:
    """The method, and its PSNR in the holes of the frame that is shown."""
    shown = max(cell.frames, key=lambda frame: frame.hole_px)
    score = "" if shown.psnr_holes is None else f" {shown.psnr_holes:.2f} dB"
    return f"{cell.key.method}{score}"


def largest_hole(error: Picture) -> tuple[int, int, int]:
    """Top, left and side of a square in the image around the largest connected part of E; without E in its middle."""
    import cv2

    height, width = error.shape[:2]
    count, _, stats, _ = cv2.connectedComponentsWithStats((error[..., 0] > 0).astype(np.uint8), connectivity=8)
    least = max(1, min(height, width) // CLOSE_SHARE)
    x, y, wide, high = 0, 0, width, height
    if count > 1:
        part = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
        x, y, wide, high = (int(v) for v in stats[part, :4])
        least = max(least, wide + 8, high + 8)
    side = min(least, height, width)
    top = min(max(0, y + high // 2 - side // 2), height - side)
    left = min(max(0, x + wide // 2 - side // 2), width - side)
    return top, left, side
