"""MVHumanNet: `camera_extrinsics.json`, `camera_intrinsics.json`, `camera_scale.pkl`, and `images/<camera>`."""

from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from viewmend.data.formats.files import collect_footage, to_distortion, with_folders
from viewmend.utils.safe_pickle import numbers, read_objects
from viewmend.utils.untrusted_input import Number, Triple, bounded_bytes, read_json, typed

PLACES = ("images", "images_lr")
CALIBRATED_PX = {120 / 65: (4096, 3000)}
"""Image size of the calibration by `camera_scale`; other rigs have `OTHER_PX`. Images are usually
half as large."""
OTHER_PX = (2448, 2048)
MILLIMETRES = 0.001


class Pose(Struct, kw_only=True):
    """Pose of a camera, camera_from_world in OpenCV axes."""

    rotation: tuple[Triple, Triple, Triple]
    translation: Triple


class Intrinsics(Struct, kw_only=True):
    """Lens of all cameras; the centre of the first pixel is at 0."""

    intrinsics: tuple[Triple, Triple, Triple]
    dist: Annotated[list[Number], Meta(max_length=14)] = []


def find(folder: Path) -> Path | None:
    """The extrinsics, next to the intrinsics."""
    files = folder / "camera_extrinsics.json", folder / "camera_intrinsics.json"
    return files[0] if all(file.is_file() for file in files) else None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """The cameras that have images, which have the calibration's shape."""
    poses = typed(read_json(bounded_bytes(file)), dict[str, Any])
    lens = typed(read_json(bounded_bytes(file.with_name("camera_intrinsics.json"))), Intrinsics)
    scale_file = file.with_name("camera_scale.pkl")
    if not scale_file.is_file():
        raise ValueError("expected camera_scale.pkl, which has the unit of lengths, got none; copy it too")
    scale = float(numbers(read_objects(scale_file), 1)[0])
    full = next((size for known, size in CALIBRATED_PX.items() if abs(known - scale) < 1e-6), OTHER_PX)
    place = next((place for place in PLACES if (folder / place).is_dir()), PLACES[0])
    named = {key.rpartition("_")[2].rpartition(".")[0] or key: pose for key, pose in poses.items()}
    used = {name: named[name] for name in with_folders(folder, place, named)}
    footage = collect_footage(folder, {name: f"{place}/{name}" for name in used})
    entries = []
    for name, value in used.items():
        entry = footage.entry(name)
        pose = _pose(name, value)
        K = _resize(lens.intrinsics, full, (entry["width"], entry["height"]))
        dist = to_distortion(name, lens.dist)
        entries.append(entry | {"K": K, "dist": dist, "R": pose.rotation, "t": pose.translation})
    unit = {"first_pixel_center": [0.5, 0.5], "metres_per_unit": MILLIMETRES * scale}
    return unit | {"frames": footage.frames, "cameras": entries}


def _pose(name: str, value: Any) -> Pose:
    try:
        return typed(value, Pose)
    except ValueError as error:
        raise ValueError(f"camera '{name[:40]}': {error}") from None


def _resize(K: tuple[Triple, ...], full: tuple[int, int], size: tuple[int, int]) -> list[list[float]]:
    """K of the smaller image, with the first pixel centre at 0.5, the convention in which K scales with the size."""
    sx = size[0] / full[0]
    sy = size[1] / full[1]
    if abs(sx - sy) > 1 / min(full):
        got = f"{size[0]} x {size[1]}"
        raise ValueError(
            f"expected images of the shape of {full[0]} x {full[1]}, got {got}; do not crop them"
        )
    (fx, skew, cx), (_, fy, cy), _ = K
    return [[fx * sx, skew * sx, (cx + 0.5) * sx], [0.0, fy * sy, (cy + 0.5) * sy], [0.0, 0.0, 1.0]]
