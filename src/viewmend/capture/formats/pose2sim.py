"""Calibrations as TOML, of Pose2Sim, aniposelib and Caliscope; footage is found by the cameras' names."""

import re
import tomllib
from pathlib import Path
from typing import Any

from viewmend.capture.formats.files import five_coefficients, places_named, rotation_of
from viewmend.capture.formats.footage import find_footage
from viewmend.foreign_input import bounded_bytes

MOST_BYTES = 2**21
"""The largest of these files that is read; twelve cameras have 5 kB."""
NAMES = re.compile(r".*(calib|camera_array).*\.toml|config\.toml", re.IGNORECASE)


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised, in the folder or in one whose name has "calib" in it."""
    for place in places_named(folder, "calib"):
        named = [path for path in place.glob("*.toml") if NAMES.fullmatch(path.name) and path.is_file()]
        for path in sorted(named, key=lambda path: (len(path.name), path.name)):
            if re.search(rb"(?m)^matrix\s*=", bounded_bytes(path, MOST_BYTES)):
                return path
    return None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of these cameras would hold; cameras that are marked as ignored are left out.

    Raises:
        ValueError: the file is no TOML, a camera lacks a number or is a fisheye, or has no footage.
    """
    told = _tables(file)
    nested = told.get("cameras")
    tables = (nested if isinstance(nested, dict) else told).items()
    lenses = [(key, table) for key, table in tables if isinstance(table, dict) and "matrix" in table]
    cameras = [(str(table.get("name", key)), table) for key, table in lenses if not table.get("ignore")]
    footage = find_footage(folder, [name for name, _ in cameras])
    entries = []
    for name, table in cameras:
        if table.get("fisheye"):
            raise ValueError(f"camera '{name}': expected no fisheye lens, got one; undistort the images first")
        size = table.get("size")
        if not (isinstance(size, list) and len(size) == 2 and all(isinstance(side, int | float) for side in size)):
            raise ValueError(f"camera '{name}': expected size = [width, height], got others; add it")
        entry = footage.of(name, [float(side) for side in size]) | {"K": table["matrix"], "t": table.get("translation")}
        entry |= {"R": rotation_of(name, table.get("rotation", []))}
        entries.append(entry | {"dist": five_coefficients(name, table.get("distortions", []))})
    return {"frames": footage.frames, "fps": footage.fps, "cameras": entries}


def _tables(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(bounded_bytes(file, MOST_BYTES).decode())
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"expected TOML, got something else: {str(error)[:80]}; export it again") from None
