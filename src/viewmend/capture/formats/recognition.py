"""Which format a folder has, and its calibration by the reader of that format."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.errors import CaptureError
from viewmend.capture.formats import (
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
from viewmend.capture.plain_format import CALIBRATION, PlainCalibration, calibration_of, read_calibration


@dataclass(frozen=True)
class Format:
    """One of the calibrations that are read."""

    find: Callable[[Path], Path | None]
    """The file by which a folder is recognised, None where it has none."""
    content: Callable[[Path, Path], dict[str, Any]]
    """What a `cameras.json` would hold, of the capture folder and that file."""
    root: Callable[[Path, Path], Path] = lambda path, _: path
    """What its paths are relative to, of the same two: the capture folder, unless a file was opened."""


_STUDIOS = (dna_rendering, riftcast, easymocap, genebody, zju_mocap, mvhumannet, actorshq, panoptic)
_TOOLS = (pose2sim, qualisys, agisoft, middlebury, opencv)
FORMATS = {
    module.__name__.rpartition(".")[2]: Format(module.find, module.content, getattr(module, "root", Format.root))
    for module in (transforms, colmap, *_STUDIOS, *_TOOLS)
}
KINDS = ("plain", *FORMATS)


def read_any_calibration(path: Path, kind: str | None = None) -> PlainCalibration:
    """The calibration of a folder, or of a file that stands for one, of `kind`; by default the first of `KINDS`.

    Raises:
        CaptureError: the kind is unknown, the folder is not of it, or its calibration cannot be used.
    """
    if kind not in (None, *KINDS):
        raise CaptureError(f"expected a kind among {', '.join(KINDS)}, got '{kind}'; choose one of them")
    if kind == "plain" or (kind is None and (path / CALIBRATION).is_file()):
        return read_calibration(path)
    for name in FORMATS if kind is None else (kind,):
        if (file := FORMATS[name].find(path)) is not None:
            try:
                with np.errstate(all="ignore"):  # what overflows is refused as a number that is not finite
                    told = calibration_of(FORMATS[name].content(path, file), file)
                    return replace(told, folder=FORMATS[name].root(path, file))
            except (ValueError, OSError) as error:
                raise CaptureError(f"{file}: {error}") from None
    if kind is None:
        return read_calibration(path)  # says what a capture folder has
    raise CaptureError(f"{path}: expected a folder of the kind '{kind}', got none of its files; see docs/formats.md")
