"""EasyMocap and EasyVolcap: `intri.yml` and `extri.yml`, with `images/<camera>/<frame>` or videos, and masks."""

from pathlib import Path
from typing import Any

import numpy as np

from viewmend.data.formats.files import find_footage, to_distortion, to_rotation
from viewmend.data.formats.opencv import read_storage
from viewmend.data.native_format import stays_inside

PLACES = ("images", "videos", "")
UNBOUNDED = 1e5
"""EasyVolcap writes larger bounds if it has none."""


def find(folder: Path) -> Path | None:
    """The intrinsics of the folder, or of moving cameras, as in `cameras/00`."""
    for place in (folder, *sorted(folder.glob("cameras/*"))):
        if all((place / name).is_file() for name in ("intri.yml", "extri.yml")):
            return place / "intri.yml"
    return None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All cameras of the files; they may not move."""
    if file.parent != folder:
        raise ValueError("expected static cameras, got poses per frame; write intri.yml for the whole rig")
    intrinsics = read_storage(file)
    extrinsics = read_storage(file.with_name("extri.yml"))
    names = [name for name in intrinsics.get("names", ()) if stays_inside(name)]
    if not any(f"K_{name}" in intrinsics for name in names):  # YAML reads 00 without quotes as the number 0
        names = sorted(key[2:] for key in intrinsics if key.startswith("K_") and stays_inside(key[2:]))
    if not names:
        raise ValueError("expected cameras whose names are valid folder names, got none; export it again")
    footage = find_footage(folder, names, PLACES)
    entries = []
    for name in (name for name in names if name in footage):
        K = _matrix(intrinsics, f"K_{name}", 9).reshape(3, 3)
        W = intrinsics.get(f"W_{name}")
        H = intrinsics.get(f"H_{name}")
        size = (W, H) if isinstance(W, float) and isinstance(H, float) and W > 0 and H > 0 else None
        dist = next(
            (intrinsics[key] for key in (f"dist_{name}", f"D_{name}") if key in intrinsics), np.zeros(5)
        )
        rotation = extrinsics.get(f"Rot_{name}", extrinsics.get(f"R_{name}"))
        pose = {"R": to_rotation(name, rotation), "t": _matrix(extrinsics, f"T_{name}", 3).tolist()}
        entries.append(
            footage.entry(name, size) | {"K": K.tolist(), "dist": to_distortion(name, dist)} | pose
        )
    bounds = [extrinsics[key] for name in names if (key := f"bounds_{name}") in extrinsics]
    return {"frames": footage.frames, "fps": footage.fps, "bounds": _union(bounds), "cameras": entries}


def _union(bounds: list[Any]) -> list[list[float]] | None:
    """The volume that contains the bounds of all cameras; None if there are none."""
    boxes = [np.asarray(box).reshape(2, 3) for box in bounds if np.size(box) == 6]
    if not boxes or np.abs(boxes).max() > UNBOUNDED:
        return None
    return [np.min(boxes, 0)[0].tolist(), np.max(boxes, 0)[1].tolist()]


def _matrix(found: dict[str, Any], key: str, size: int) -> np.ndarray:
    value = np.asarray(found.get(key, []))
    if value.size != size:
        raise ValueError(f"expected {key} of {size} numbers, got {value.size}; add it")
    return value.ravel()
