"""ActorsHQ: `calibration.csv` with `rgbs/<camera>` and `masks/<camera>`, in one folder per image scale (`4x`)."""

import csv
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.data.formats.files import collect_footage, decode_text, invert_pose, to_rotation, with_folders
from viewmend.utils.untrusted_input import bounded_bytes

COLUMNS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")
CORNERS = ("aabb_min_x", "aabb_min_y", "aabb_min_z", "aabb_max_x", "aabb_max_y", "aabb_max_z")
SCALES = ("1x", "2x", "4x")
MAX_BYTES = 2**24


def find(folder: Path) -> Path | None:
    """The calibration of the folder, or of its first scale."""
    files = [folder / scale / "calibration.csv" for scale in ("", *SCALES)]
    return next((file for file in files if file.is_file()), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """The cameras that have images, in a folder of one scale. The bounds are those of all frames."""
    prefix = "" if file.parent == folder else file.parent.name + "/"
    scales = [scale for scale in SCALES if prefix and (folder / scale / "calibration.csv").is_file()]
    if len(scales) > 1:
        raise ValueError(
            f"expected a folder with one scale, got {', '.join(scales)}; open one of these folders"
        )
    table = {str(row["name"]): row for row in _read_table(file, COLUMNS)}
    rows = [table[name] for name in with_folders(file.parent, "rgbs", table)]
    footage = collect_footage(file.parent, {str(row["name"]): f"rgbs/{row['name']}" for row in rows})
    entries = []
    for row in rows:
        entry = footage.entry(str(row["name"]), (row["w"], row["h"]))
        K = [
            [row["fx"] * row["w"], 0.0, row["px"] * row["w"]],
            [0.0, row["fy"] * row["h"], row["py"] * row["h"]],
        ]
        rotation = to_rotation(str(row["name"]), [row["rx"], row["ry"], row["rz"]])
        pose = invert_pose(np.c_[np.array(rotation), [row["tx"], row["ty"], row["tz"]]])
        paths = {key: prefix + entry[key] for key in ("image", "mask") if key in entry}
        entries.append(entry | {"K": [*K, [0.0, 0.0, 1.0]]} | pose | paths)
    result: dict[str, Any] = {"first_pixel_center": [0.5, 0.5], "frames": footage.frames, "cameras": entries}
    boxes = file.parent.parent / "aabbs.csv"
    if boxes.is_file():
        corners = np.array([[row[key] for key in CORNERS] for row in _read_table(boxes, CORNERS)], float)
        result["bounds"] = [corners[:, :3].min(0).tolist(), corners[:, 3:].max(0).tolist()]
    return result


def _read_table(file: Path, columns: tuple[str, ...]) -> list[dict[str, Any]]:
    """The rows of a table; all columns but `name` are numbers."""
    try:
        rows = list(csv.DictReader(decode_text(bounded_bytes(file, MAX_BYTES), file.name).splitlines()))
        found = [{key: row[key] if key == "name" else float(row[key]) for key in columns} for row in rows]
    except (csv.Error, KeyError, TypeError) as error:
        got = f"none named {error}" if isinstance(error, KeyError) else str(error)[:60]
        raise ValueError(
            f"expected columns {','.join(columns)} in {file.name}, got {got}; copy it again"
        ) from None
    if not found or any("/" in str(row.get("name", "")) for row in found):
        raise ValueError(
            f"expected rows of cameras or frames in {file.name}, got none or paths; copy it again"
        )
    return found
