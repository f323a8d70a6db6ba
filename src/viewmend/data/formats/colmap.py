"""COLMAP's sparse model, text or binary. Each image is a camera of a single frame."""

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from viewmend.data.formats.files import find_mask, names_from_paths
from viewmend.utils.untrusted_input import bounded_bytes

MAX_BYTES = 2**29
"""A model of a thousand images needs about 100 MB."""
MODELS = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
}
"""Supported camera models: their number in binary files, and their parameters."""


class ColmapImage(NamedTuple):
    """One image of the model."""

    quaternion: list[float]
    """Rotation of camera_from_world: w, x, y, z."""
    t: list[float]
    camera: int
    name: str


def find(folder: Path) -> Path | None:
    """The file cameras.bin or cameras.txt, next to that of the images."""
    for place in ("sparse/0", "sparse", "."):
        for suffix in (".bin", ".txt"):
            if all((folder / place / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
                return folder / place / f"cameras{suffix}"
    return None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All images of the model. The unit is arbitrary, as in COLMAP.

    Raises:
        ValueError: a file is truncated or invalid, or a camera model is not in `MODELS`.
    """
    cameras, images = (bounded_bytes(path, MAX_BYTES) for path in (file, file.with_name(f"images{file.suffix}")))
    try:
        if file.suffix == ".bin":
            lenses, views = _binary_lenses(cameras), _binary_images(images)
        else:
            lenses, views = _text_lenses(cameras.decode()), _text_images(images.decode())
    except (struct.error, IndexError):
        raise ValueError("expected complete files of cameras and images, got less; export the model again") from None
    views.sort(key=lambda view: view.name)
    prefix = "images/" if (folder / "images").is_dir() else ""
    entries = []
    for view, name in zip(views, names_from_paths([view.name for view in views]), strict=True):
        if view.camera not in lenses:
            expected = f"a camera with the id {view.camera} of image '{view.name[:40]}'"
            raise ValueError(f"expected {expected}, got none; export the model again")
        mask = find_mask(folder, view.name)
        entry = {"name": name, **lenses[view.camera], **_pose(view)}
        entries.append(entry | {"image": prefix + view.name, "mask": mask})
    return {"first_pixel_center": [0.5, 0.5], "frames": ["0"], "cameras": entries}


def _binary_lenses(data: bytes) -> dict[int, dict[str, Any]]:
    by_number = {number: model for model, (number, _) in MODELS.items()}
    (count,), at, lenses = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        camera, number, width, height = struct.unpack_from("<iiQQ", data, at)
        model = by_number.get(number, f"number {number}")
        size = len(_parameters(model))
        lenses[camera] = _lens(model, width, height, list(struct.unpack_from(f"<{size}d", data, at + 24)))
        at += 24 + 8 * size
    return lenses


def _binary_images(data: bytes) -> list[ColmapImage]:
    (count,), at, images = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.find(b"\0", at + 64)
        name = data[at + 64 : end].decode()
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
        if end < 0 or at > len(data):
            raise IndexError
        images.append(ColmapImage(pose[:4], pose[4:], camera, name))
    return images


def _text_lenses(text: str) -> dict[int, dict[str, Any]]:
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return {int(w[0]): _lens(w[1], int(w[2]), int(w[3]), [float(n) for n in w[4:]]) for w in lines}


def _text_images(text: str) -> list[ColmapImage]:
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    images = []
    for line in lines[::2]:  # every other line has the image's points, and may be empty
        if words := line.split(maxsplit=9):
            pose = [float(number) for number in words[1:8]]
            images.append(ColmapImage(pose[:4], pose[4:], int(words[8]), words[9].strip()))
    return images


def _parameters(model: str) -> list[str]:
    if model not in MODELS:
        expected = ", ".join(MODELS)
        raise ValueError(f"expected a model among {expected}, got {model[:40]}; undistort the images in COLMAP first")
    return MODELS[model][1].split()


def _lens(model: str, width: int, height: int, values: list[float]) -> dict[str, Any]:
    names = _parameters(model)
    if len(values) != len(names):
        raise ValueError(f"expected {len(names)} parameters of {model}, got {len(values)}; export the model again")
    lens = dict(zip(names, values, strict=True))
    if lens.get("k4") or lens.get("k5") or lens.get("k6"):
        raise ValueError(f"expected {model} with k4, k5 and k6 of 0, got others; undistort the images in COLMAP first")
    fx, fy = lens.get("fx", lens.get("f")), lens.get("fy", lens.get("f"))
    K = [[fx, 0.0, lens["cx"]], [0.0, fy, lens["cy"]], [0.0, 0.0, 1.0]]
    dist = [lens.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    return {"width": width, "height": height, "K": K, "dist": dist}


def _pose(view: ColmapImage) -> dict[str, Any]:
    quaternion = np.array(view.quaternion)
    norm = np.linalg.norm(quaternion)
    if not (np.isfinite(norm) and norm > 0):
        raise ValueError(f"expected a rotation of image '{view.name[:40]}', got {view.quaternion}; export it again")
    w, x, y, z = quaternion / norm
    R = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return {"R": np.array(R).tolist(), "t": view.t}
