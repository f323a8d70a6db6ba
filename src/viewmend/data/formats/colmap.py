"""COLMAP's sparse model, text or binary.

Each image is a camera of a single frame, unless poses and names show that a fixed rig was recorded
at several times.
"""

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from viewmend.data.formats.files import (
    decode_text,
    existing,
    folders_containing,
    names_from_paths,
    warn_of_unused_images,
)
from viewmend.data.formats.moments import PosedImage, fixed_cameras, with_masks
from viewmend.utils.untrusted_input import bounded_bytes

IMAGES = "images.txt"
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
    """The file cameras.bin or cameras.txt of the model with most images: COLMAP's first is often not the largest."""
    for place in ("sparse", "colmap/sparse", "."):
        inner = [] if place == "." else folders_containing(folder / place, "")[1:]
        models = [model for path in (*inner, folder / place) if (model := _model_in(path))]
        if len(models) > 1:
            return max(models, key=_count_images)
        if models:
            return models[0]
    return None


def _model_in(place: Path) -> Path | None:
    for suffix in (".bin", ".txt"):
        if all((place / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
            return place / f"cameras{suffix}"
    return None


def _read(file: Path) -> tuple[dict[int, dict[str, Any]], list[ColmapImage]]:
    """Lenses and images of a model, sorted by name."""
    cameras, images = (
        bounded_bytes(path, MAX_BYTES) for path in (file, file.with_name(f"images{file.suffix}"))
    )
    try:
        if file.suffix == ".bin":
            lenses = _binary_lenses(cameras)
            views = _binary_images(images)
        else:
            lenses = _text_lenses(decode_text(cameras, "cameras.txt"))
            views = _text_images(decode_text(images, IMAGES))
    except (struct.error, IndexError):
        raise ValueError(
            "expected complete files of cameras and images, got less; export the model again"
        ) from None
    return lenses, sorted(
        (view._replace(name=view.name.replace("\\", "/")) for view in views), key=lambda v: v.name
    )


def _count_images(file: Path) -> int:
    """The number of images of a model; 0 if it is invalid."""
    try:
        return len(_read(file)[1])
    except (ValueError, OSError):
        return 0


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All images of the model. The unit is arbitrary, as in COLMAP."""
    lenses, views = _read(file)
    prefix = "images/" if (folder / "images").is_dir() else ""
    known = [prefix + view.name for view in views]
    views = existing(folder, views, lambda view: prefix + view.name)
    if prefix:
        warn_of_unused_images(folder, known)
    images = []
    for view in views:
        if view.camera not in lenses:
            expected = f"a camera with the id {view.camera} of image '{view.name[:40]}'"
            raise ValueError(f"expected {expected}, got none; export the model again")
        R = _rotation(view)
        t = np.array(view.t)
        images.append(PosedImage(prefix + view.name, None, lenses[view.camera], R, -R.T @ t))
    images = with_masks(folder, images)
    rig = fixed_cameras(images)
    if rig is not None:
        cameras, frames = rig
        return {"first_pixel_center": [0.5, 0.5], "frames": list(frames), "cameras": cameras}
    moments = _count_moments(file)
    if moments > 1:
        got = (
            f"{moments} frames of a rig, {file.with_stem('frames').name}, in which cameras have several poses"
        )
        raise ValueError(
            f"expected a fixed rig or images of one moment, got {got}; write one model for each frame"
        )
    entries = []
    for image, view, name in zip(images, views, names_from_paths([view.name for view in views]), strict=True):
        pose = {"R": image.R.tolist(), "t": view.t}
        entries.append({"name": name, **image.lens, **pose, "image": image.path, "mask": image.mask})
    return {"first_pixel_center": [0.5, 0.5], "frames": ["0"], "cameras": entries}


def _count_moments(file: Path) -> int:
    """How many frames of two images or more COLMAP's file of frames lists; 0 without such a file."""
    frames = file.with_stem("frames")
    if not frames.is_file():
        return 0
    data = bounded_bytes(frames, MAX_BYTES)
    try:
        counts = _binary_frame_sizes(data) if file.suffix == ".bin" else _text_frame_sizes(data)
    except (struct.error, ValueError, IndexError):
        return 0
    return sum(count > 1 for count in counts)


def _binary_frame_sizes(data: bytes) -> list[int]:
    """The number of images of each frame: after an id, the rig's id and a pose, then 16 bytes for each image."""
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    sizes = []
    for _ in range(count):
        (size,) = struct.unpack_from("<I", data, at + 64)
        at += 68 + 16 * size
        sizes.append(size)
    return sizes


def _text_frame_sizes(data: bytes) -> list[int]:
    """The number of images of each frame, which follows two ids and a pose of seven numbers."""
    lines = [line.split() for line in decode_text(data, "frames.txt").splitlines()]
    return [int(words[9]) for words in lines if words and not words[0].startswith("#")]


def _binary_lenses(data: bytes) -> dict[int, dict[str, Any]]:
    by_number = {number: model for model, (number, _) in MODELS.items()}
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    lenses = {}
    for _ in range(count):
        camera, number, width, height = struct.unpack_from("<iiQQ", data, at)
        model = by_number.get(number, f"number {number}")
        size = len(_parameters(model))
        lenses[camera] = _lens(model, width, height, list(struct.unpack_from(f"<{size}d", data, at + 24)))
        at += 24 + 8 * size
    return lenses


def _binary_images(data: bytes) -> list[ColmapImage]:
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    images = []
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.find(b"\0", at + 64)
        name = decode_text(data[at + 64 : end], "the names in images.bin")
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
        if end < 0 or at > len(data):
            raise IndexError
        images.append(ColmapImage(pose[:4], pose[4:], camera, name))
    return images


def _text_lenses(text: str) -> dict[int, dict[str, Any]]:
    lenses = {}
    for number, line in enumerate(text.split("\n"), 1):
        words = line.split()
        if words and not words[0].startswith("#"):
            try:
                camera = int(words[0])
                width = int(words[2])
                height = int(words[3])
                values = [float(word) for word in words[4:]]
            except (ValueError, IndexError):
                raise _bad_line(
                    "cameras.txt", number, "an id, a model, a size and its parameters", line
                ) from None
            lenses[camera] = _lens(words[1], width, height, values)
    return lenses


def _text_images(text: str) -> list[ColmapImage]:
    """The images: lines of a pose and a name, each followed by a line of points, which may be empty."""
    images = []
    follows = False
    for number, line in enumerate(text.split("\n"), 1):
        words = line.split(maxsplit=9)
        if words and words[0].startswith("#"):
            continue
        if follows:
            points = line.split()
            if len(points) % 3 or not _is_number(points[-1] if points else "0"):
                expected = "the points of the image in the line before, 3 numbers each or an empty line"
                raise _bad_line(IMAGES, number, expected, line)
            follows = False
        elif words:
            try:
                pose = [float(word) for word in words[1:8]]
                images.append(ColmapImage(pose[:4], pose[4:], int(words[8]), words[9].strip()))
            except (ValueError, IndexError):
                raise _bad_line(IMAGES, number, "an id, a pose, a camera and a name", line) from None
            follows = True
    return images


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _bad_line(file: str, number: int, expected: str, line: str) -> ValueError:
    got = f"'{line.strip()[:60]}'"
    return ValueError(f"{file}: expected {expected} in line {number}, got {got}; export the model again")


def _parameters(model: str) -> list[str]:
    if model not in MODELS:
        expected = ", ".join(MODELS)
        raise ValueError(
            f"expected a model among {expected}, got {model[:40]}; undistort the images in COLMAP first"
        )
    return MODELS[model][1].split()


def _lens(model: str, width: int, height: int, values: list[float]) -> dict[str, Any]:
    names = _parameters(model)
    if len(values) != len(names):
        raise ValueError(
            f"expected {len(names)} parameters of {model}, got {len(values)}; export the model again"
        )
    lens = dict(zip(names, values, strict=True))
    if lens.get("k4") or lens.get("k5") or lens.get("k6"):
        raise ValueError(
            f"expected {model} with k4, k5 and k6 of 0, got others; undistort the images in COLMAP first"
        )
    fx = lens.get("fx", lens.get("f"))
    fy = lens.get("fy", lens.get("f"))
    K = [[fx, 0.0, lens["cx"]], [0.0, fy, lens["cy"]], [0.0, 0.0, 1.0]]
    dist = [lens.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    return {"width": width, "height": height, "K": K, "dist": dist}


def _rotation(view: ColmapImage) -> Float64[np.ndarray, "3 3"]:
    """Rotation of camera_from_world, from the quaternion."""
    quaternion = np.array(view.quaternion)
    norm = np.linalg.norm(quaternion)
    if not (np.isfinite(norm) and norm > 0):
        raise ValueError(
            f"expected a rotation of image '{view.name[:40]}', got {view.quaternion}; export it again"
        )
    w, x, y, z = quaternion / norm
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows)
