"""Contact sheets: grids of labelled images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

Picture = UInt8[np.ndarray, "_height _width 3"]
"""An RGB image."""
LABEL_PX = 22
GAP_PX = 4
BACKGROUND = 32
"""Grey level around the images; black would hide the borders of masked images."""


@dataclass(frozen=True)
class Tile:
    """One image of a sheet with its caption."""

    label: str
    image: UInt8[np.ndarray, "height width 3"] | None
    """RGB; None leaves the cell empty."""


def picture(
    rgb: Float[Tensor, "channel height width"] | UInt8[Tensor, "channel height width"],
) -> UInt8[np.ndarray, "height width 3"]:
    """Convert an image of one or three channels, bytes or floats in [0, 1], to an RGB array."""
    if rgb.is_floating_point():
        rgb = (rgb.detach().float().clamp(0, 1) * 255).round().byte()
    return np.ascontiguousarray(rgb.expand(3, -1, -1).permute(1, 2, 0).cpu().numpy())


def contact_sheet(
    rows: Sequence[Sequence[Tile]], tile_width: int = 320, tile_height: int | None = None
) -> UInt8[np.ndarray, "height width 3"]:
    """All tiles in rows, each scaled (aspect kept) into a box of the same size with its caption above, RGB.

    The box is `tile_width` wide and, unless `tile_height` is given, as high as the tallest image.
    """
    images = [tile.image for row in rows for tile in row if tile.image is not None]
    tallest = max((round(tile_width * i.shape[0] / i.shape[1]) for i in images), default=tile_width)
    box = tile_width, tallest if tile_height is None else tile_height
    columns = max((len(row) for row in rows), default=0)
    step_x = box[0] + GAP_PX
    step_y = box[1] + LABEL_PX + GAP_PX
    sheet = np.full((len(rows) * step_y + GAP_PX, columns * step_x + GAP_PX, 3), BACKGROUND, np.uint8)
    for y, row in enumerate(rows):
        for x, tile in enumerate(row):
            _place(sheet, tile, (GAP_PX + x * step_x, GAP_PX + y * step_y), box)
    return sheet


def in_rows(tiles: Sequence[Tile], columns: int) -> list[Sequence[Tile]]:
    """The tiles in order, `columns` to a row."""
    return [tiles[start : start + columns] for start in range(0, len(tiles), columns)]


def _place(sheet: np.ndarray, tile: Tile, corner: tuple[int, int], box: tuple[int, int]) -> None:
    import cv2

    left, top = corner
    font = cv2.FONT_HERSHEY_SIMPLEX
    grey = (220, 220, 220)
    text = tile.label.encode("ascii", "replace").decode()
    (wide, _), _ = cv2.getTextSize(text, font, 0.5, 1)
    scale = 0.5 * min(1.0, (box[0] - 4) / max(wide, 1))
    cv2.putText(sheet, text, (left + 2, top + LABEL_PX - 7), font, scale, grey, 1, cv2.LINE_AA)
    if tile.image is None:
        return
    height, width = tile.image.shape[:2]
    zoom = min(box[0] / width, box[1] / height)
    size = max(1, min(box[0], round(width * zoom))), max(1, min(box[1], round(height * zoom)))
    scaled = cv2.resize(tile.image, size, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_NEAREST)
    x = left + (box[0] - size[0]) // 2
    y = top + LABEL_PX
    sheet[y : y + size[1], x : x + size[0]] = scaled
