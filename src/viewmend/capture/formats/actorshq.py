"""ActorsHQ: `calibration.csv` beside `rgbs/<camera>` and `masks/<camera>`, in a folder a scale (`4x`)."""

import csv
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.formats.files import inverted, rotation_of
from viewmend.capture.formats.footage import footage_of
from viewmend.foreign_input import bounded_bytes

HEADER = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")
CORNERS = ("aabb_min_x", "aabb_min_y", "aabb_min_z", "aabb_max_x", "aabb_max_y", "aabb_max_z")
SCALES = ("1x", "2x", "4x")
MOST_BYTES = 2**24


def find(folder: Path) -> Path | None:
    """The file by which a folder is recognised: of this scale, or of a sequence's only one."""
    if (folder / "calibration.csv").is_file():
        return folder / "calibration.csv"
    below = [folder / scale / "calibration.csv" for scale in SCALES]
    return next((file for file in below if file.is_file()), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of those cameras would hold that have images; bounds are those of all times.

    Raises:
        ValueError: the table has other columns or a value that is no number, or a sequence has several scales.
    """
    place = "" if file.parent == folder else file.parent.name + "/"
    scales = [scale for scale in SCALES if place and (folder / scale / "calibration.csv").is_file()]
    if len(scales) > 1:
        raise ValueError(f"expected a folder of one scale, got {', '.join(scales)} in it; open one of these")
    rows = [row for row in _table(file, HEADER) if (file.parent / "rgbs" / str(row["name"])).is_dir()]
    footage = footage_of(file.parent, {str(row["name"]): f"rgbs/{row['name']}" for row in rows})
    entries = []
    for row in rows:
        entry = footage.of(str(row["name"]), (row["w"], row["h"]))
        K = [[row["fx"] * row["w"], 0.0, row["px"] * row["w"]], [0.0, row["fy"] * row["h"], row["py"] * row["h"]]]
        turn = rotation_of(str(row["name"]), [row["rx"], row["ry"], row["rz"]])
        pose = inverted(np.c_[np.array(turn), [row["tx"], row["ty"], row["tz"]]])
        paths = {key: place + entry[key] for key in ("image", "mask") if key in entry}
        entries.append(entry | {"K": [*K, [0.0, 0.0, 1.0]]} | pose | paths)
    told: dict[str, Any] = {"first_pixel_center": [0.5, 0.5], "frames": footage.frames, "cameras": entries}
    boxes = file.parent.parent / "aabbs.csv"
    if boxes.is_file():
        corners = np.array([[row[key] for key in CORNERS] for row in _table(boxes, CORNERS)], float)
        told["bounds"] = [corners[:, :3].min(0).tolist(), corners[:, 3:].max(0).tolist()]
    return told


def _table(file: Path, columns: tuple[str, ...]) -> list[dict[str, Any]]:
    """The rows of a table, numbers but for names.

    Raises:
        ValueError: it lacks a column or has no rows, or a value is no number.
    """
    try:
        rows = list(csv.DictReader(bounded_bytes(file, MOST_BYTES).decode().splitlines()))
        found = [{key: row[key] if key == "name" else float(row[key]) for key in columns} for row in rows]
    except (csv.Error, KeyError, TypeError) as error:
        got = str(error)[:60]
        raise ValueError(f"expected columns {','.join(columns)} in {file.name}, got {got}; copy it again") from None
    if not found or any("/" in str(row.get("name", "")) for row in found):
        raise ValueError(f"expected rows of cameras or times in {file.name}, got none or paths; copy it again")
    return found
