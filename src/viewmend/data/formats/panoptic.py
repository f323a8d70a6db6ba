"""CMU Panoptic Studio: `calibration_<sequence>.json` with `hdVideos` or `hdImgs`, or else their VGA counterparts."""

from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from viewmend.data.formats.files import (
    collect_footage,
    files_like,
    first_of,
    to_distortion,
    warn_of_unmatched,
)
from viewmend.utils.untrusted_input import Number, Triple, bounded_bytes, read_json, typed

CENTIMETRES = 0.01
FPS = {"hd": 29.97, "vga": 25.0}
SIDE = Annotated[int, Meta(ge=1)]
Row = Annotated[list[Number], Meta(min_length=1, max_length=1)] | Number
"""The file has t as a column or as a row."""


class _Camera(Struct, kw_only=True):
    """One of the file's cameras, camera_from_world in OpenCV axes."""

    name: Annotated[str, Meta(pattern=r"^\d\d_\d\d\Z")]
    type: Literal["hd", "vga", "kinect-color", "kinect-ir"]
    resolution: tuple[SIDE, SIDE]
    K: tuple[Triple, Triple, Triple]
    distCoef: list[Number]  # noqa: N815 (the file's own name)
    R: tuple[Triple, Triple, Triple]
    t: tuple[Row, Row, Row]


class _Calibration(Struct, kw_only=True):
    cameras: list[_Camera]


def find(folder: Path) -> Path | None:
    """The calibration."""
    return first_of(files_like(folder, "calibration_*.json"))


def content(folder: Path, file: Path) -> dict[str, Any]:
    """The HD cameras that have footage; the VGA cameras if fewer than two have."""
    cameras = typed(read_json(bounded_bytes(file)), _Calibration).cameras
    for kind, fps in FPS.items():
        entries = {camera.name: camera for camera in cameras if camera.type == kind}
        paths = {name: path for name in entries if (path := _footage(folder, kind, name))}
        if len(paths) < 2:
            continue
        warn_of_unmatched(folder, [name for name in entries if name not in paths], ())
        footage = collect_footage(folder, paths)
        result = []
        for camera in (entries[name] for name in paths):
            lens = {"K": camera.K, "dist": to_distortion(camera.name, camera.distCoef), "R": camera.R}
            t = [row[0] if isinstance(row, list) else row for row in camera.t]
            result.append(footage.entry(camera.name, camera.resolution) | lens | {"t": t})
        rig = {"metres_per_unit": CENTIMETRES, "up": [0.0, -1.0, 0.0], "fps": footage.fps or fps}
        return rig | {"frames": footage.frames, "cameras": result}
    expected = "hdVideos/hd_00_00.mp4 or hdImgs/00_00 of two cameras or more, or the same for vga"
    raise ValueError(f"expected {expected}, got none; add them")


def _footage(folder: Path, kind: str, name: str) -> str | None:
    """The camera's images, or else its video. Videos of VGA cameras are in one folder per node."""
    if (folder / f"{kind}Imgs" / name).is_dir():
        return f"{kind}Imgs/{name}"
    videos = folder / f"{kind}Videos"
    found = next(
        iter(sorted((*videos.glob(f"{kind}_{name}.mp4"), *videos.glob(f"*/{kind}_{name}.mp4")))), None
    )
    return None if found is None else str(found.relative_to(folder))
