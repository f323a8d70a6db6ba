"""`transforms.json` of nerfstudio, instant-ngp and Blender. Each of its frames is a camera of a single frame."""

import math
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from viewmend.data.formats.files import image_size_px, names_from_paths
from viewmend.data.images import read_rgba
from viewmend.data.native_format import stays_inside
from viewmend.utils.untrusted_input import Number, bounded_bytes, read_json, typed

NAMES = ("transforms.json", "transforms_train.json")
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
Row = tuple[Number, Number, Number, Number]
Angle = Annotated[float, Meta(gt=0, lt=3.14)]
Side = Annotated[int, Meta(ge=1, le=2**16)]


class Lens(Struct, kw_only=True):
    """Intrinsics, at the top level or of one frame."""

    camera_model: str | None = None
    is_fisheye: bool | None = None
    camera_angle_x: Angle | None = None
    fl_x: Number | None = None
    fl_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    w: Side | None = None
    h: Side | None = None
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    p1: Number | None = None
    p2: Number | None = None


class TransformsFrameEntry(Lens, kw_only=True):
    """One of the file's `frames`."""

    file_path: Annotated[str, Meta(min_length=1)]
    transform_matrix: Annotated[tuple[Row, ...], Meta(min_length=3, max_length=4)]
    """world_from_camera, OpenGL axes."""
    mask_path: str | None = None
    depth_file_path: str | None = None


class TransformsFile(Lens, kw_only=True):
    """The whole file."""

    frames: list[TransformsFrameEntry]


def find(folder: Path) -> Path | None:
    """The file that identifies the format."""
    return next((folder / name for name in NAMES if (folder / name).is_file()), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All frames. The alpha of the images is the mask if no frame names one, and the first image is not opaque.

    Raises:
        ValueError: a value is invalid, the lens is a fisheye, or an image is missing whose size is needed.
    """
    file_content = typed(read_json(bounded_bytes(file)), TransformsFile, "see docs/formats.md")
    paths = [_with_suffix(folder, frame.file_path) for frame in file_content.frames]
    alpha = not any(frame.mask_path for frame in file_content.frames) and bool(paths) and _uses_alpha(folder, paths[0])
    cameras = []
    for frame, path, name in zip(file_content.frames, paths, names_from_paths(paths), strict=True):
        entry = {"name": name, **_intrinsics(folder, path, file_content, frame), **_pose(frame), "image": path}
        cameras.append(entry | {"mask": path if alpha else frame.mask_path, "depth": frame.depth_file_path})
    return {"first_pixel_center": [0.5, 0.5], "up": [0.0, 0.0, 1.0], "frames": ["0"], "cameras": cameras}


def _with_suffix(folder: Path, path: str) -> str:
    """The path of an image; files of Blender omit `.png`."""
    plain = str(PurePosixPath(path))
    if not stays_inside(plain) or (folder / plain).is_file() or not (folder / f"{plain}.png").is_file():
        return plain
    return f"{plain}.png"


def _uses_alpha(folder: Path, path: str) -> bool:
    if not stays_inside(path) or not (folder / path).is_file():
        return False
    try:
        return bool((read_rgba(folder / path, path)[..., 3] != 255).any())
    except ValueError:  # no alpha
        return False


def _intrinsics(folder: Path, path: str, default: Lens, frame: Lens) -> dict[str, Any]:
    lens = {key: _first(getattr(frame, key), getattr(default, key)) for key in Lens.__struct_fields__}
    model = lens["camera_model"] or MODELS[0]
    if model not in MODELS or lens["is_fisheye"] or lens["k4"]:
        got = "k4 or a fisheye" if model in MODELS else model[:40]
        raise ValueError(f"expected a camera_model among {', '.join(MODELS)}, got {got}; undistort the images first")
    width, height = lens["w"], lens["h"]
    if width is None or height is None:
        width, height = image_size_px(folder, path)
    fx = lens["fl_x"]
    if fx is None:
        if lens["camera_angle_x"] is None:
            raise ValueError("expected fl_x or camera_angle_x, got neither; add the focal length")
        fx = width / (2 * math.tan(lens["camera_angle_x"] / 2))
    cx, cy = _first(lens["cx"], width / 2), _first(lens["cy"], height / 2)
    K = [[fx, 0.0, cx], [0.0, _first(lens["fl_y"], fx), cy], [0.0, 0.0, 1.0]]
    dist = [lens[key] or 0.0 for key in ("k1", "k2", "p1", "p2", "k3")]
    return {"width": width, "height": height, "K": K, "dist": dist}


def _pose(frame: TransformsFrameEntry) -> dict[str, Any]:
    world_from_camera = np.array(frame.transform_matrix, float)[:3]
    R = np.diag([1.0, -1.0, -1.0]) @ world_from_camera[:, :3].T  # from OpenGL to OpenCV axes
    return {"R": R.tolist(), "t": (-R @ world_from_camera[:, 3]).tolist()}


def _first(value: Any, otherwise: Any) -> Any:
    return otherwise if value is None else value
