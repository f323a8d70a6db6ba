"""Which format a folder has, and its calibration by the reader of that format."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.errors import CaptureError
from viewmend.capture.formats import (
    actorshq,
    agisoft,
    colmap,
    easymocap,
    genebody,
    middlebury,
    mvhumannet,
    opencv,
    panoptic,
    pose2sim,
    qualisys,
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


_STUDIOS = (easymocap, genebody, zju_mocap, mvhumannet, actorshq, panoptic)
_TOOLS = (pose2sim, qualisys, agisoft, middlebury, opencv)
FORMATS = {
    module.__name__.rpartition(".")[2]: Format(module.find, module.content)
    for module in (transforms, colmap, *_STUDIOS, *_TOOLS)
}
KINDS = ("plain", *FORMATS)


def read_any_calibration(folder: Path, kind: str | None = None) -> PlainCalibration:
    """The calibration of a folder of `kind`, by default of the first of `KINDS` whose file it has.

    Raises:
        CaptureError: the kind is unknown, the folder is not of it, or its calibration cannot be used.
    """
    if kind not in (None, *KINDS):
        raise CaptureError(f"expected a kind among {', '.join(KINDS)}, got '{kind}'; choose one of them")
    if kind == "plain" or (kind is None and (folder / CALIBRATION).is_file()):
        return read_calibration(folder)
    for name in FORMATS if kind is None else (kind,):
        if (file := FORMATS[name].find(folder)) is not None:
            try:
                with np.errstate(all="ignore"):  # what overflows is refused as a number that is not finite
                    return calibration_of(FORMATS[name].content(folder, file), file)
            except (ValueError, OSError) as error:
                raise CaptureError(f"{file}: {error}") from None
    if kind is None:
        return read_calibration(folder)  # says what a capture folder has
    raise CaptureError(f"{folder}: expected a folder of the kind '{kind}', got none of its files; see docs/formats.md")
