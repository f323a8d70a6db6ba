"""`intri.yml` and `extri.yml` of EasyMocap and EasyVolcap, with `images/<camera>/<frame>` or videos, and masks."""

from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.formats.files import five_coefficients, rotation_of
from viewmend.capture.formats.footage import find_footage
from viewmend.capture.formats.opencv_storage import read_storage
from viewmend.capture.plain_format import stays_inside

PLACES = ("images", "videos", "")
ENDLESS = 1e5
"""Bounds that EasyVolcap writes where it knows none are farther away."""


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised; one of `cameras/00` tells cameras that move."""
    for place in (folder, *sorted(folder.glob("cameras/*"))):
        if all((place / name).is_file() for name in ("intri.yml", "extri.yml")):
            return place / "intri.yml"
    return None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of these cameras would hold.

    Raises:
        ValueError: a file is no OpenCV YAML, lacks a camera's matrix, there are no images, or cameras move.
    """
    if file.parent != folder:
        raise ValueError("expected cameras that stand still, got poses of each frame; write intri.yml for the rig")
    intrinsics, extrinsics = read_storage(file), read_storage(file.with_name("extri.yml"))
    names = [name for name in intrinsics.get("names", ()) if stays_inside(name)]
    if not any(f"K_{name}" in intrinsics for name in names):  # 00 without quotes is the number 0
        names = sorted(key[2:] for key in intrinsics if key.startswith("K_") and stays_inside(key[2:]))
    if not names:
        raise ValueError("expected cameras with names that are fit for folders, got none; export it again")
    footage = find_footage(folder, names, PLACES)
    entries = []
    for name in names:
        K = _matrix(intrinsics, f"K_{name}", 9).reshape(3, 3)
        size = intrinsics.get(f"W_{name}"), intrinsics.get(f"H_{name}")
        told = (size[0], size[1]) if isinstance(size[0], float) and isinstance(size[1], float) and all(size) else None
        dist = next((intrinsics[key] for key in (f"dist_{name}", f"D_{name}") if key in intrinsics), np.zeros(5))
        rotation = extrinsics.get(f"Rot_{name}", extrinsics.get(f"R_{name}"))
        pose = {"R": rotation_of(name, rotation), "t": _matrix(extrinsics, f"T_{name}", 3).tolist()}
        entries.append(footage.of(name, told) | {"K": K.tolist(), "dist": five_coefficients(name, dist)} | pose)
    found = [extrinsics[key] for name in names if (key := f"bounds_{name}") in extrinsics]
    return {"frames": footage.frames, "fps": footage.fps, "bounds": _bounds(found), "cameras": entries}


def _bounds(found: list[Any]) -> list[list[float]] | None:
    """The volume that all cameras' bounds lie in, where they say one."""
    boxes = [np.asarray(box).reshape(2, 3) for box in found if np.size(box) == 6]
    if not boxes or np.abs(boxes).max() > ENDLESS:
        return None
    return [np.min(boxes, 0)[0].tolist(), np.max(boxes, 0)[1].tolist()]


def _matrix(found: dict[str, Any], key: str, size: int) -> np.ndarray:
    value = np.asarray(found.get(key, []))
    if value.size != size:
        raise ValueError(f"expected {key} of {size} numbers, got {value.size}; add it")
    return value.ravel()
