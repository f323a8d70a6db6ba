"""The capture formats that can be read, and how a folder's format is recognised.

Each format is one module with two functions. `find(folder)` returns the file that identifies the
format, or None. `content(folder, file)` returns the equivalent content of a `cameras.json` and
raises a ValueError for invalid input.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.data.containers import stored_path
from viewmend.data.errors import CaptureError
from viewmend.data.formats import (
    actorshq,
    agisoft,
    colmap,
    dna_rendering,
    easymocap,
    genebody,
    middlebury,
    mvhumannet,
    opencv,
    panoptic,
    pose2sim,
    qualisys,
    riftcast,
    transforms,
    zju_mocap,
)
from viewmend.data.formats.files import folders_containing
from viewmend.data.formats.reader import Format
from viewmend.data.native_format import (
    CALIBRATION,
    NativeCalibration,
    calibration_from_content,
    read_calibration,
)

DATA_SETS = (dna_rendering, riftcast, easymocap, genebody, zju_mocap, mvhumannet, actorshq, panoptic)
"""Formats of published data sets."""
TOOLS = (pose2sim, qualisys, agisoft, middlebury, opencv)
"""Formats of other programs."""
SESSIONS = ("pose2sim", "qualisys")
"""Formats whose calibration may lie in a folder next to that of the recording, or one level higher."""
FORMATS = {
    module.__name__.rpartition(".")[2]: Format.of_module(module)
    for module in (transforms, colmap, *DATA_SETS, *TOOLS)
}
"""All formats but our own, in the order in which they are tried."""
FORMAT_NAMES = ("plain", *FORMATS)
"""The names of all formats; ours is `plain`."""


def is_capture_file(path: Path, format: str | None = None) -> bool:
    """Whether a file stands for a capture by itself, as those of DNA-Rendering and RIFTCast's meta files do."""
    names = [name for name in FORMATS if format in (None, name)]
    return path.is_file() and any(FORMATS[name].find(path) is not None for name in names)


def _find(path: Path, names: Iterable[str]) -> tuple[str, Path | None]:
    """The first of these formats that matches, and the file that identifies it; "" and None if none does."""
    for name in names:
        file = FORMATS[name].find(path)
        if file is not None:
            return name, file
    if path.is_dir():
        parents = path.resolve().parents[:2]
        for place in (place for parent in parents for place in folders_containing(parent, "calib")[1:]):
            for name in (name for name in SESSIONS if name in names):
                file = FORMATS[name].find(place)
                if file is not None:
                    return name, file
    return "", None


def _is_capture(folder: Path, names: Iterable[str], native: bool) -> bool:
    """Whether a folder that is only looked at has the files of one of these formats, or of our own."""
    try:
        return (native and (folder / CALIBRATION).is_file()) or any(
            FORMATS[name].find(folder) for name in names
        )
    except (ValueError, OSError):
        return False


def _as_stored(calibration: NativeCalibration) -> NativeCalibration:
    """The calibration with the paths of its files as they are on disk."""
    folder = calibration.folder
    frames = calibration.frames
    cameras = []
    for camera in calibration.cameras:
        files: Any = {kind: stored_path(folder, getattr(camera, kind), frames) for kind in camera.file_kinds}
        cameras.append(replace(camera, **files))
    return replace(calibration, cameras=tuple(cameras))


def read_any_calibration(path: Path, format: str | None = None) -> NativeCalibration:
    """Read the calibration of a capture, which is a folder or a file, in any supported format.

    A file is one that holds or describes a whole capture, or the `cameras.json` of a capture in viewmend's own format.

    `format` is one of `FORMAT_NAMES`; by default the first one that matches. CaptureError if the
    format is unknown, the folder does not have it, or its calibration cannot be used.
    """
    if format not in (None, *FORMAT_NAMES):
        raise CaptureError(
            f"expected a format among {', '.join(FORMAT_NAMES)}, got '{format}'; choose one of them"
        )
    if path.name == CALIBRATION and path.is_file():
        path = path.parent
    native = format in (None, "plain")
    names = [name for name in FORMATS if format in (None, name)]
    if native and (path / CALIBRATION).is_file():
        return _as_stored(read_calibration(path))
    name, file = _find(path, names)
    if file is not None:
        try:
            with np.errstate(all="ignore"):  # overflow becomes infinity, which is rejected
                calibration = calibration_from_content(FORMATS[name].content(path, file), file)
                return _as_stored(replace(calibration, folder=FORMATS[name].root(path, file)))
        except (ValueError, OSError) as error:
            raise CaptureError(f"{file}: {error}") from None
    inner = [place for place in folders_containing(path, "")[1:] if _is_capture(place, names, native)]
    if inner:
        got = f"a folder of captures ({', '.join(place.name for place in inner)[:200]})"
        raise CaptureError(f"{path}: expected a capture, got {got}; open one, such as {inner[0]}")
    if native:
        return read_calibration(path)  # its error message lists what a capture folder contains
    raise CaptureError(
        f"{path}: expected a capture of format '{format}', got none of its files; see docs/formats.md"
    )
