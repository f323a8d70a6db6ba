"""MVHumanNet: `camera_extrinsics.json`, `camera_intrinsics.json` and `camera_scale.pkl` beside `images/<camera>`."""

from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from viewmend.capture.formats.files import five_coefficients
from viewmend.capture.formats.footage import footage_of
from viewmend.capture.formats.numpy_objects import numbers, read_objects
from viewmend.foreign_input import bounded_bytes
from viewmend.json_input import Number, Triple, read_json, typed

PLACES = ("images", "images_lr")
RIGS = {120 / 65: (4096, 3000)}
"""Pixels that a rig was calibrated at, by `camera_scale`; all others at `OTHERS`. Images are mostly half as large."""
OTHERS = (2448, 2048)
MILLIMETRES = 0.001


class Pose(Struct, kw_only=True):
    """One camera's pose, world to camera in OpenCV axes."""

    rotation: tuple[Triple, Triple, Triple]
    translation: Triple


class Intrinsics(Struct, kw_only=True):
    """The lens of all cameras; the first pixel has its centre at 0."""

    intrinsics: tuple[Triple, Triple, Triple]
    dist: Annotated[list[Number], Meta(max_length=14)] = []


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised."""
    files = folder / "camera_extrinsics.json", folder / "camera_intrinsics.json"
    return files[0] if all(file.is_file() for file in files) else None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of those cameras would hold that have images.

    Raises:
        ValueError: a file holds something else or is absent, or images have another shape than was calibrated.
    """
    poses = typed(read_json(bounded_bytes(file)), dict[str, Any])
    lens = typed(read_json(bounded_bytes(file.with_name("camera_intrinsics.json"))), Intrinsics)
    scale_file = file.with_name("camera_scale.pkl")
    if not scale_file.is_file():
        raise ValueError("expected camera_scale.pkl, without which lengths have no unit, got none; copy it, too")
    scale = float(numbers(read_objects(scale_file), 1)[0])
    full = next((size for told, size in RIGS.items() if abs(told - scale) < 1e-6), OTHERS)
    place = next((place for place in PLACES if (folder / place).is_dir()), PLACES[0])
    named = {key.rpartition("_")[2].rpartition(".")[0] or key: pose for key, pose in poses.items()}
    there = {name: pose for name, pose in named.items() if (folder / place / name).is_dir()}
    footage = footage_of(folder, {name: f"{place}/{name}" for name in there})
    entries = []
    for name, told in there.items():
        entry, pose = footage.of(name), _pose(name, told)
        K = _resized(lens.intrinsics, full, (entry["width"], entry["height"]))
        dist = five_coefficients(name, lens.dist)
        entries.append(entry | {"K": K, "dist": dist, "R": pose.rotation, "t": pose.translation})
    return {
        "first_pixel_center": [0.5, 0.5],
        "metres_per_unit": MILLIMETRES * scale,
        "frames": footage.frames,
        "cameras": entries,
    }


def _pose(name: str, told: Any) -> Pose:
    try:
        return typed(told, Pose)
    except ValueError as error:
        raise ValueError(f"camera '{name[:40]}': {error}") from None


def _resized(K: tuple[Triple, ...], full: tuple[int, int], size: tuple[int, int]) -> list[list[float]]:
    """K of the smaller image, whose first pixel has its centre at 0.5: only so are pixels scaled by a factor."""
    sx, sy = size[0] / full[0], size[1] / full[1]
    if abs(sx - sy) > 1 / min(full):
        got = f"{size[0]} x {size[1]}"
        raise ValueError(f"expected images of the shape of {full[0]} x {full[1]}, got {got}; do not crop them")
    (fx, skew, cx), (_, fy, cy), _ = K
    return [[fx * sx, skew * sx, (cx + 0.5) * sx], [0.0, fy * sy, (cy + 0.5) * sy], [0.0, 0.0, 1.0]]
