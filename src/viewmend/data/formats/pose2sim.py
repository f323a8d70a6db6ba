"""TOML calibrations of Pose2Sim, FreeMoCap, aniposelib and Caliscope. Footage is found by the cameras' names."""

import re
import tomllib
from pathlib import Path
from typing import Any

from viewmend.data.formats.files import (
    decode_text,
    files_like,
    find_footage,
    folders_containing,
    to_distortion,
    to_rotation,
    warn,
)
from viewmend.utils.untrusted_input import bounded_bytes

MAX_BYTES = 2**21
"""Twelve cameras need 5 kB."""
MILLIMETRES = 0.001
"""The unit of FreeMoCap."""
NAMES = re.compile(r".*(calib|camera_array).*\.toml|config\.toml", re.IGNORECASE)


def find(folder: Path) -> Path | None:
    """The calibration, in the folder or in one with "calib" in its name."""
    for place in folders_containing(folder, "calib"):
        named = [path for path in files_like(place, "*.toml") if NAMES.fullmatch(path.name)]
        counts = {
            path: len(re.findall(rb"(?m)^matrix\s*=", bounded_bytes(path, MAX_BYTES))) for path in named
        }
        usable = sorted(
            (path for path in named if counts[path]), key=lambda path: (-counts[path], len(path.name))
        )
        if usable[1:]:
            warn(
                f"{usable[0]}: this calibration is used, and not {', '.join(path.name for path in usable[1:])}"
            )
        if usable:
            return usable[0]
    return None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All cameras that are not marked as ignored. FreeMoCap's are in millimetres."""
    try:
        root = tomllib.loads(decode_text(bounded_bytes(file, MAX_BYTES), file.name))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"expected TOML, got something else: {str(error)[:80]}; export it again") from None
    nested = root.get("cameras")
    tables = (nested if isinstance(nested, dict) else root).items()
    lenses = [(key, table) for key, table in tables if isinstance(table, dict) and "matrix" in table]
    cameras = [(str(table.get("name", key)), table) for key, table in lenses if not table.get("ignore")]
    footage = find_footage(folder, [name for name, _ in cameras])
    entries = []
    for name, table in ((name, table) for name, table in cameras if name in footage):
        if table.get("fisheye"):
            raise ValueError(
                f"camera '{name}': expected a lens without fisheye, got one; undistort the images first"
            )
        size = table.get("size")
        if not (
            isinstance(size, list) and len(size) == 2 and all(isinstance(side, int | float) for side in size)
        ):
            raise ValueError(f"camera '{name}': expected size = [width, height], got others; add it")
        entry = footage.entry(name, [float(side) for side in size])
        entry |= {"K": table["matrix"], "dist": to_distortion(name, table.get("distortions", []))}
        entries.append(
            entry | {"R": to_rotation(name, table.get("rotation", [])), "t": table.get("translation")}
        )
    synchronized = any(str(entry.get("video", "")).startswith("synchronized_videos/") for entry in entries)
    unit = MILLIMETRES if synchronized else 1.0
    return {"metres_per_unit": unit, "frames": footage.frames, "fps": footage.fps, "cameras": entries}
