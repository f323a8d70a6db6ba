"""`intri.yml` and `extri.yml` of EasyMocap and EasyVolcap, with `images/<camera>/<frame>` and `masks` likewise."""

from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.formats.files import bounded_bytes, five_coefficients, image_size_px, rotation_of
from viewmend.capture.formats.footage import MASK_PLACES, in_time, listing
from viewmend.capture.plain_format import stays_inside

MOST_BYTES = 2**22
"""The largest of these files that is read; sixty cameras have 50 kB."""


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised."""
    files = folder / "intri.yml", folder / "extri.yml"
    return files[0] if all(file.is_file() for file in files) else None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of these cameras would hold.

    Raises:
        ValueError: a file is no OpenCV YAML, lacks a camera's matrix, or there are no images.
    """
    intrinsics, extrinsics = _matrices(file), _matrices(file.with_name("extri.yml"))
    names = intrinsics["names"]
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


def _matrices(file: Path) -> dict[str, Any]:
    """Matrices, whole numbers and the list `names` of an OpenCV YAML file."""
    import cv2

    text = bounded_bytes(file, MOST_BYTES).decode()
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root, found = storage.root(), {}
        for key in root.keys():  # noqa: SIM118 (it is no dict)
            node = root.getNode(key)
            if key == "names":
                found[key] = [node.at(index).string() for index in range(node.size())] if node.isSeq() else []
            elif node.isMap():
                found[key] = np.asarray(node.mat(), float).ravel()
            elif node.isInt() or node.isReal():
                found[key] = int(node.real())
    except (cv2.error, SystemError, TypeError, OverflowError) as error:
        got = str(error).strip().splitlines()[-1][-80:]
        raise ValueError(f"expected OpenCV YAML in {file.name}, got: {got}; export it again") from None
    if not found.get("names"):
        found["names"] = sorted(key[2:] for key in found if key.startswith("K_"))
    return found


def _matrix(found: dict[str, Any], key: str, size: int) -> np.ndarray:
    value = np.asarray(found.get(key, []))
    if value.size != size:
        raise ValueError(f"expected {key} of {size} numbers, got {value.size}; add it")
    return value.ravel()
