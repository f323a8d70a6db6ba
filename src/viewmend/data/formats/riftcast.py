"""RIFTCast data sets (VCI): `calibration.json`, and one folder per frame with images and run-length masks.

RIFTCast is started with a meta file, which names the data set's folder, its frames, and the volume
of the subject.
"""

import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from viewmend.data.formats.files import to_distortion, warn_of_unused_images
from viewmend.data.images import RUN_LENGTH_SUFFIX
from viewmend.data.native_format import stays_inside
from viewmend.utils.untrusted_input import Number, Triple, bounded_bytes, read_json, typed

CALIBRATION = "calibration.json"
TYPES = ("VCI", "VCI_REAL")
MAX_META_BYTES = 2**16
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Converts between OpenGL axes, which the program uses, and OpenCV axes, which its files use."""
Sixteen = Annotated[list[Number], Meta(min_length=16, max_length=16)]
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


class Extrinsics(Struct, kw_only=True):
    """Pose of a camera: camera_from_world in row-major order, OpenCV axes."""

    view_matrix: Sixteen


class Intrinsics(Struct, kw_only=True):
    """Lens of a camera; the centre of the first pixel is at 0.5."""

    camera_matrix: Annotated[list[Number], Meta(min_length=9, max_length=9)]
    resolution: tuple[int, int]
    distortion_coefficients: list[Number] = []


class _Camera(Struct, kw_only=True):
    camera_id: int | str
    extrinsics: Extrinsics
    intrinsics: Intrinsics


class _Calibration(Struct, kw_only=True):
    cameras: list[_Camera]


class _Dataset(Struct, kw_only=True):
    path: str = "."
    camera_path: str = CALIBRATION
    frame_count: Annotated[int, Meta(ge=1)] | None = None
    start_frame: int = 0
    flip_images: bool = True
    flip_masks: bool = True
    to_world: Sixteen | None = None


class Volume(Struct, kw_only=True):
    """The cube that contains the subject, in the program's frame; `scale` is half of its side."""

    position: Triple
    scale: Annotated[float, Meta(gt=0, le=1e6)] = 1.0


class MetaFile(Struct, kw_only=True):
    """A meta file; other keys are ignored."""

    type: str
    version: str
    dataset: _Dataset
    volume: Volume | None = None


def find(path: Path) -> Path | None:
    """The path itself if it is a meta file, or the calibration of a folder with images as RIFTCast stores them."""
    if path.is_file():
        return path if path.suffix == ".json" and _is_meta(path) else None
    found = (path / CALIBRATION).is_file() and next(path.glob("frame_*/rgb"), None) is not None
    return path / CALIBRATION if found else None


def root(path: Path, file: Path) -> Path:
    """The folder of the data set, which a meta file names."""
    if path.is_dir():
        return path
    named = file.parent / _read_meta(file).dataset.path.replace("\\", "/")
    return named if named.is_dir() else file.parent


def content(path: Path, file: Path) -> dict[str, Any]:
    """All cameras; bounds, up and the range of frames are those of a meta file, if there is one."""
    folder = root(path, file)
    files = [file] if path.is_file() else sorted(json for json in folder.glob("*.json") if _is_meta(json))
    meta = _read_meta(files[0]) if files else None  # in a folder, the first one
    place = meta.dataset.camera_path if meta and stays_inside(meta.dataset.camera_path) else CALIBRATION
    cameras = typed(read_json(bounded_bytes(folder / place)), _Calibration).cameras
    frames = _frames(folder, meta)
    entries = [_camera(folder, camera, frames) for camera in cameras]
    if frames:
        warn_of_unused_images(folder, [entry["image"].replace("{frame}", frames[0]) for entry in entries])
    result = {"first_pixel_center": [0.5, 0.5], "frames": frames, "cameras": entries}
    return result | (_meta_keys(meta) if meta else {})


def _frames(folder: Path, meta: MetaFile | None) -> list[str]:
    found = (re.fullmatch(r"frame_(\d{1,9})", place.name) for place in folder.glob("frame_*"))
    frames = sorted((match[1] for match in found if match), key=int)
    if meta is None or meta.dataset.frame_count is None:
        return frames
    first = meta.dataset.start_frame
    return [frame for frame in frames if first <= int(frame) < first + meta.dataset.frame_count]


def _camera(folder: Path, camera: _Camera, frames: list[str]) -> dict[str, Any]:
    name = str(camera.camera_id)
    view = np.array(camera.extrinsics.view_matrix).reshape(4, 4)
    K = np.array(camera.intrinsics.camera_matrix).reshape(3, 3)
    size = camera.intrinsics.resolution
    entry: dict[str, Any] = {"name": name, "width": size[0], "height": size[1], "K": K.tolist()}
    entry |= {"R": view[:3, :3].tolist(), "t": view[:3, 3].tolist()}
    entry["dist"] = to_distortion(name, camera.intrinsics.distortion_coefficients)
    entry["image"] = _pattern(folder, f"rgb/rgb_{name}", frames, (".jpeg", ".jpg", ".png"))
    if any((folder / f"frame_{frame}" / "mask").is_dir() for frame in frames):
        entry["mask"] = _pattern(folder, f"mask/mask_{name}", frames, (RUN_LENGTH_SUFFIX, ".png"))
    return entry


def _pattern(folder: Path, stem: str, frames: list[str], suffixes: tuple[str, ...]) -> str:
    """The path of these files, with the first suffix that any of them has."""
    paths = ((suffix, folder / f"frame_{frame}/{stem}{suffix}") for suffix in suffixes for frame in frames)
    suffix = next((suffix for suffix, path in paths if path.is_file()), suffixes[0])
    return f"frame_{{frame}}/{stem}{suffix}"


def _meta_keys(meta: MetaFile) -> dict[str, Any]:
    """The keys `up` and `bounds` from a meta file."""
    if not (meta.dataset.flip_images and meta.dataset.flip_masks):
        raise ValueError(
            "expected flip_images and flip_masks of true, got files stored bottom-up; flip the files"
        )
    to_world = meta.dataset.to_world  # in the program's frame, y up
    stored = FLIP if to_world is None else FLIP @ np.array(to_world).reshape(4, 4)
    result: dict[str, Any] = {"up": stored[:3, 1].tolist()}
    if meta.volume is not None:
        corners = np.c_[np.array(meta.volume.position) + meta.volume.scale * CORNERS, np.ones(8)] @ stored.T
        result["bounds"] = [corners[:, :3].min(0).tolist(), corners[:, :3].max(0).tolist()]
    return result


def _is_meta(file: Path) -> bool:
    try:
        value = read_json(_without_comments(bounded_bytes(file, MAX_META_BYTES)))
    except (ValueError, OSError):
        return False
    return isinstance(value, dict) and value.get("type") in TYPES


def _read_meta(file: Path) -> MetaFile:
    meta = typed(read_json(_without_comments(bounded_bytes(file, MAX_META_BYTES))), MetaFile)
    if meta.version.partition(".")[0] != "2":
        raise ValueError(
            f"expected version 2 of RIFTCast's meta file, got {meta.version[:20]!r}; write it again"
        )
    return meta


def _without_comments(data: bytes) -> bytes:
    """Remove comments, from // to the end of the line, outside of strings."""
    return re.sub(rb'("(?:\\.|[^"\\\n])*")|//[^\n]*', lambda found: found[1] or b"", data)
