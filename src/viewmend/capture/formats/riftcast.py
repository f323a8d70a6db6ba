"""RIFTCast's data sets (VCI): `calibration.json`, and images and run-length masks in a folder a frame."""

import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from viewmend.capture.formats.files import five_coefficients
from viewmend.capture.plain_format import stays_inside
from viewmend.capture.run_lengths import RUN_LENGTHS
from viewmend.foreign_input import bounded_bytes
from viewmend.json_input import Number, Triple, read_json, typed

CALIBRATION = "calibration.json"
TYPES = ("VCI", "VCI_REAL")
MOST_META_BYTES = 2**16
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between OpenGL's axes, which the program works in, and OpenCV's, which its files have."""
Sixteen = Annotated[list[Number], Meta(min_length=16, max_length=16)]


class Extrinsics(Struct, kw_only=True):
    """A camera's pose: camera_from_world by rows, OpenCV axes."""

    view_matrix: Sixteen


class Intrinsics(Struct, kw_only=True):
    """A camera's lens; the first pixel has its centre at 0.5."""

    camera_matrix: Annotated[list[Number], Meta(min_length=9, max_length=9)]
    resolution: tuple[int, int]
    distortion_coefficients: list[Number] = []


class CameraEntry(Struct, kw_only=True):
    """One of the cameras."""

    camera_id: int | str
    extrinsics: Extrinsics
    intrinsics: Intrinsics


class CalibrationFile(Struct, kw_only=True):
    """All of `calibration.json`."""

    cameras: list[CameraEntry]


class Dataset(Struct, kw_only=True):
    """What the meta file says of the data set."""

    path: str = "."
    camera_path: str = CALIBRATION
    frame_count: Annotated[int, Meta(ge=1)] | None = None
    start_frame: int = 0
    flip_images: bool = True
    flip_masks: bool = True
    to_world: Sixteen | None = None


class Volume(Struct, kw_only=True):
    """The cube that holds the subject, in the program's frame."""

    position: Triple
    scale: Annotated[float, Meta(gt=0, le=1e6)] = 1.0
    """Half of its side."""


class MetaFile(Struct, kw_only=True):
    """The file that RIFTCast is started with; other keys do not matter here."""

    type: str
    version: str
    dataset: Dataset
    volume: Volume | None = None


def find(path: Path) -> Path | None:
    """The meta file that this path is; or the folder's calibration, where there are images as RIFTCast has them."""
    if path.is_file():
        return path if path.suffix == ".json" and _is_meta(path) else None
    there = (path / CALIBRATION).is_file() and next(path.glob("frame_*/rgb"), None) is not None
    return path / CALIBRATION if there else None


def root(path: Path, file: Path) -> Path:
    """The data set's folder, which a meta file names."""
    if path.is_dir():
        return path
    told = file.parent / _meta(file).dataset.path
    return told if told.is_dir() else file.parent


def content(path: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of the data set would hold; bounds, up and which frames are those of a meta file.

    Raises:
        ValueError: a file holds something else, or images are stored bottom-up.
    """
    folder, meta = root(path, file), _meta_of(path, file)
    place = meta.dataset.camera_path if meta and stays_inside(meta.dataset.camera_path) else CALIBRATION
    cameras = typed(read_json(bounded_bytes(folder / place)), CalibrationFile).cameras
    frames = _frames(folder, meta)
    told: dict[str, Any] = {"first_pixel_center": [0.5, 0.5], "frames": frames}
    told["cameras"] = [_camera(folder, camera, frames) for camera in cameras]
    return told | (_told_by(meta) if meta else {})


def stored_from_program(path: Path) -> np.ndarray:
    """From the frame that the program works in, y up, to the one of `calibration.json`, 4 x 4 (data set or meta file).

    Raises:
        ValueError: this is no data set, or its meta file holds something else.
    """
    if (file := find(path)) is None:
        raise ValueError(f"expected a data set of RIFTCast or its meta file, got {path}")
    return _stored_from_program(_meta_of(path, file))


def _stored_from_program(meta: MetaFile | None) -> np.ndarray:
    if meta is None or meta.dataset.to_world is None:
        return FLIP
    return FLIP @ np.array(meta.dataset.to_world).reshape(4, 4)


def _meta_of(path: Path, file: Path) -> MetaFile | None:
    """The meta file that this path is, or the first in the folder; None where there is none."""
    metas = [file] if path.is_file() else sorted(json for json in root(path, file).glob("*.json") if _is_meta(json))
    return _meta(metas[0]) if metas else None


def _frames(folder: Path, meta: MetaFile | None) -> list[str]:
    found = (re.fullmatch(r"frame_(\d{1,9})", place.name) for place in folder.glob("frame_*"))
    frames = sorted((match[1] for match in found if match), key=int)
    if meta is None or meta.dataset.frame_count is None:
        return frames
    first = meta.dataset.start_frame
    return [frame for frame in frames if first <= int(frame) < first + meta.dataset.frame_count]


def _camera(folder: Path, camera: CameraEntry, frames: list[str]) -> dict[str, Any]:
    name, view = str(camera.camera_id), np.array(camera.extrinsics.view_matrix).reshape(4, 4)
    K, size = np.array(camera.intrinsics.camera_matrix).reshape(3, 3), camera.intrinsics.resolution
    entry = {"name": name, "width": size[0], "height": size[1], "K": K.tolist()}
    entry |= {"R": view[:3, :3].tolist(), "t": view[:3, 3].tolist()}
    entry["dist"] = five_coefficients(name, camera.intrinsics.distortion_coefficients)
    entry["image"] = _pattern(folder, f"rgb/rgb_{name}", frames, (".jpeg", ".jpg", ".png"))
    if any((folder / f"frame_{frame}" / "mask").is_dir() for frame in frames[:1]):
        entry["mask"] = _pattern(folder, f"mask/mask_{name}", frames, (RUN_LENGTHS, ".png"))
    return entry


def _pattern(folder: Path, stem: str, frames: list[str], suffixes: tuple[str, ...]) -> str:
    """The path of these files, with the first suffix that any of them has."""
    there = (suffix for suffix in suffixes for frame in frames if _is_file(folder / f"frame_{frame}/{stem}{suffix}"))
    return f"frame_{{frame}}/{stem}{next(there, suffixes[0])}"


def _is_file(path: Path) -> bool:
    return "\0" not in str(path) and path.is_file()


def _told_by(meta: MetaFile) -> dict[str, Any]:
    if not (meta.dataset.flip_images and meta.dataset.flip_masks):
        raise ValueError("expected flip_images and flip_masks, got files that are bottom-up; flip them and these two")
    stored = _stored_from_program(meta)
    told: dict[str, Any] = {"up": stored[:3, 1].tolist()}
    if meta.volume is not None:
        half = meta.volume.scale * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners = np.c_[np.array(meta.volume.position) + half, np.ones(8)] @ stored.T
        told["bounds"] = [corners[:, :3].min(0).tolist(), corners[:, :3].max(0).tolist()]
    return told


def _is_meta(file: Path) -> bool:
    """Whether a JSON file is what RIFTCast is started with."""
    try:
        told = read_json(_without_comments(bounded_bytes(file, MOST_META_BYTES)))
    except (ValueError, OSError):
        return False
    return isinstance(told, dict) and told.get("type") in TYPES


def _meta(file: Path) -> MetaFile:
    meta = typed(read_json(_without_comments(bounded_bytes(file, MOST_META_BYTES))), MetaFile)
    if meta.version.partition(".")[0] != "2":
        raise ValueError(f"expected version 2 of RIFTCast's meta file, got {meta.version[:20]!r}; write it anew")
    return meta


def _without_comments(data: bytes) -> bytes:
    """JSON without what follows // to the end of a line, outside of texts."""
    return re.sub(rb'("(?:\\.|[^"\\\n])*")|//[^\n]*', lambda found: found[1] or b"", data)
