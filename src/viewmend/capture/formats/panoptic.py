"""CMU's Panoptic Studio: `calibration_<sequence>.json` beside `hdVideos` or `hdImgs`, else their VGA likes."""

from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from viewmend.capture.formats.files import five_coefficients
from viewmend.capture.formats.footage import footage_of
from viewmend.foreign_input import bounded_bytes
from viewmend.json_input import Number, Triple, read_json, typed

CENTIMETRES = 0.01
FPS = {"hd": 29.97, "vga": 25.0}
SIDE = Annotated[int, Meta(ge=1)]
Row = Annotated[list[Number], Meta(min_length=1, max_length=1)] | Number
"""The file has t as a column, or as a row."""


class CameraEntry(Struct, kw_only=True):
    """One of the file's cameras, world to camera in OpenCV axes."""

    name: Annotated[str, Meta(pattern=r"^\d\d_\d\d\Z")]
    type: Literal["hd", "vga", "kinect-color", "kinect-ir"]
    resolution: tuple[SIDE, SIDE]
    K: tuple[Triple, Triple, Triple]
    distCoef: list[Number]  # noqa: N815 (the file's own name)
    R: tuple[Triple, Triple, Triple]
    t: tuple[Row, Row, Row]


class CalibrationFile(Struct, kw_only=True):
    """All of the file."""

    cameras: list[CameraEntry]


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised."""
    return next(iter(sorted(folder.glob("calibration_*.json"))), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of the HD cameras would hold that have footage; of the VGA cameras where no two have.

    Raises:
        ValueError: the file holds something else, or no two cameras of a type have footage.
    """
    cameras = typed(read_json(bounded_bytes(file)), CalibrationFile).cameras
    for kind, fps in FPS.items():
        own = {camera.name: camera for camera in cameras if camera.type == kind}
        chosen = {name: path for name in own if (path := _footage(folder, kind, name))}
        if len(chosen) < 2:
            continue
        footage = footage_of(folder, chosen)
        entries = []
        for name in chosen:
            camera = own[name]
            lens = {"K": camera.K, "dist": five_coefficients(name, camera.distCoef), "R": camera.R}
            t = [row[0] if isinstance(row, list) else row for row in camera.t]
            entries.append(footage.of(name, camera.resolution) | lens | {"t": t})
        told = {"metres_per_unit": CENTIMETRES, "up": [0.0, -1.0, 0.0], "fps": footage.fps or fps}
        return told | {"frames": footage.frames, "cameras": entries}
    raise ValueError(
        "expected hdVideos/hd_00_00.mp4 or hdImgs/00_00 of two cameras or more, or vga likewise, got none; add them"
    )


def _footage(folder: Path, kind: str, name: str) -> str | None:
    """The camera's images, else its video; videos of VGA cameras lie in a folder a node."""
    if (folder / f"{kind}Imgs" / name).is_dir():
        return f"{kind}Imgs/{name}"
    videos = folder / f"{kind}Videos"
    found = next(iter(sorted((*videos.glob(f"{kind}_{name}.mp4"), *videos.glob(f"*/{kind}_{name}.mp4")))), None)
    return None if found is None else str(found.relative_to(folder))
