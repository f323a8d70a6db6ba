"""`intri.yml` and `extri.yml` of EasyMocap and EasyVolcap, with `images/<camera>/<frame>` and `masks` likewise."""

from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.formats.files import five_coefficients, image_size_px, rotation_of
from viewmend.capture.formats.footage import MASK_PLACES, in_time, listing
from viewmend.capture.formats.opencv_storage import read_storage
from viewmend.capture.plain_format import stays_inside


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised."""
    files = folder / "intri.yml", folder / "extri.yml"
    return files[0] if all(file.is_file() for file in files) else None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of these cameras would hold.

    Raises:
        ValueError: a file is no OpenCV YAML, lacks a camera's matrix, or there are no images.
    """
    intrinsics, extrinsics = read_storage(file), read_storage(file.with_name("extri.yml"))
    names = intrinsics.get("names") or sorted(key[2:] for key in intrinsics if key.startswith("K_"))
    if not all(stays_inside(name) for name in names):
        raise ValueError("expected names of cameras that are fit for folders, got others; rename them")
    listed = {name: listing(folder, f"images/{name}") for name in names}
    images = {name: found for name, found in listed.items() if found}
    if len(images) < len(names):
        lacking = next(name for name in names if name not in images)
        raise ValueError(f"expected images of camera '{lacking}' in images/{lacking}, got none; add them")
    masks = next((place for place in MASK_PLACES if (folder / place).is_dir()), None)
    frames = sorted({frame for found in images.values() for frame in found.frames}, key=in_time)
    entries = []
    for name in names:
        K = _matrix(intrinsics, f"K_{name}", 9).reshape(3, 3)
        size = intrinsics.get(f"W_{name}"), intrinsics.get(f"H_{name}")
        width, height = size if all(size) else image_size_px(folder, images[name].first())
        dist = next((intrinsics[key] for key in (f"dist_{name}", f"D_{name}") if key in intrinsics), np.zeros(5))
        entry = {"name": name, "width": width, "height": height, "K": K.tolist(), "dist": five_coefficients(name, dist)}
        rotation = extrinsics.get(f"Rot_{name}", extrinsics.get(f"R_{name}"))
        entry |= {"R": rotation_of(name, rotation), "t": _matrix(extrinsics, f"T_{name}", 3).tolist()}
        entry["image"] = images[name].pattern
        if masks:
            found = listing(folder, f"{masks}/{name}")
            entry["mask"] = found.pattern if found else f"{masks}/{name}/{{frame}}.png"
        entries.append(entry)
    return {"frames": frames, "cameras": entries}


def _matrix(found: dict[str, Any], key: str, size: int) -> np.ndarray:
    value = np.asarray(found.get(key, []))
    if value.size != size:
        raise ValueError(f"expected {key} of {size} numbers, got {value.size}; add it")
    return value.ravel()
