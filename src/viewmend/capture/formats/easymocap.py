"""`intri.yml` and `extri.yml` of EasyMocap and EasyVolcap, with `images/<camera>/<frame>` and `masks` likewise."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.formats.files import bounded_bytes, image_size_px
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
    images = {name: _listing(folder / "images" / name) for name in names}
    masks = next((place for place in ("masks", "mask") if (folder / place).is_dir()), None)
    frames = sorted({stem for stems, _ in images.values() for stem in stems}, key=lambda stem: (len(stem), stem))
    entries = []
    for name in names:
        stems, suffix = images[name]
        if not stems:
            raise ValueError(f"expected images of camera '{name}' in images/{name}, got none; add them")
        K = _matrix(intrinsics, f"K_{name}", 9).reshape(3, 3)
        size = intrinsics.get(f"W_{name}"), intrinsics.get(f"H_{name}")
        width, height = size if all(size) else image_size_px(folder, f"images/{name}/{sorted(stems)[0]}{suffix}")
        dist = next((intrinsics[key] for key in (f"dist_{name}", f"D_{name}") if key in intrinsics), np.zeros(5))
        entry = {"name": name, "width": width, "height": height, "K": K.tolist(), "dist": _five(name, dist)}
        entry |= {"R": _rotation(extrinsics, name).tolist(), "t": _matrix(extrinsics, f"T_{name}", 3).tolist()}
        entry["image"] = f"images/{name}/{{frame}}{suffix}"
        if masks:
            entry["mask"] = f"{masks}/{name}/{{frame}}{_listing(folder / masks / name)[1]}"
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


def _rotation(found: dict[str, Any], name: str) -> np.ndarray:
    import cv2

    if f"Rot_{name}" in found:
        return _matrix(found, f"Rot_{name}", 9).reshape(3, 3)
    return cv2.Rodrigues(_matrix(found, f"R_{name}", 3))[0]


def _five(name: str, dist: np.ndarray) -> list[float]:
    values = np.asarray(dist).ravel()
    if values.size < 4 or values[5:].any():
        raise ValueError(f"expected k1 k2 p1 p2 k3 of camera '{name}', got {values.size} numbers; undistort the images")
    return [*values[:5].tolist(), 0.0][:5]


def _listing(folder: Path) -> tuple[set[str], str]:
    """Stems of the images in a folder, and their suffix: the one that most have."""
    files = [path for path in folder.glob("*.*") if not path.name.startswith(".")] if folder.is_dir() else []
    suffix = Counter(sorted(path.suffix for path in files)).most_common(1)[0][0] if files else ".png"
    return {path.stem for path in files if path.suffix == suffix}, suffix
