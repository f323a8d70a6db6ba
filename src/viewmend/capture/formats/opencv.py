"""OpenCV's own files, one a camera: `CAMERA/*.xml` beside its footage, or `CAMERA.xml` in a folder; YAML likewise."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.formats.files import five_coefficients, places_named, rotation_of
from viewmend.capture.formats.footage import find_footage
from viewmend.capture.formats.opencv_storage import MOST_BYTES, read_storage
from viewmend.foreign_input import bounded_bytes

SUFFIXES = (".xml", ".yml", ".yaml")
KEYS = {
    "K": ("k", "cameramatrix", "intrinsicmatrix", "intrinsics", "mtx"),
    "dist": ("d", "dist", "distcoeffs", "distortion", "distortioncoeffs", "distortioncoefficients"),
    "R": ("r", "rotation", "rotationmatrix", "rvec", "rotationvector"),
    "t": ("t", "translation", "translationvector", "tvec"),
    "width": ("width", "imagewidth"),
    "height": ("height", "imageheight"),
}
"""What the field calls these, without capitals and signs."""


def find(folder: Path) -> Path | None:
    """The first camera's file, which has intrinsics and pose."""
    return next((file for _, file in _cameras(folder)), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of these cameras would hold; the unit is that of the files.

    Raises:
        ValueError: a file holds what cannot be, or a camera has no footage.
    """
    cameras = _cameras(folder)
    footage = find_footage(folder, [name for name, _ in cameras])
    return {
        "frames": footage.frames,
        "fps": footage.fps,
        "cameras": [footage.of(name, _size(found)) | _lens(name, found) for name, found in _read(cameras)],
    }


def _cameras(folder: Path) -> list[tuple[str, Path]]:
    """Names of the cameras and their files: those of folders within the folder, else those of one folder."""
    places = places_named(folder, "")
    each = [(place.name, _complete(place)) for place in places[1:]]
    own = [(name, files[0]) for name, files in each if len(files) == 1]
    if len(own) >= 2:
        return own
    for place in places_named(folder, "calib"):
        together = [(path.stem, path) for path in _complete(place)]
        if len(together) >= 2:
            return together
    return []


def _complete(place: Path) -> list[Path]:
    """Files in this place that have intrinsics and pose; those that cannot be read only where no other is there."""
    found = [path for path in sorted(place.glob("*.*")) if path.suffix.lower() in SUFFIXES and path.is_file()]
    complete, unreadable = [], []
    for path in (path for path in found if b"opencv" in bounded_bytes(path, MOST_BYTES)):
        try:
            if {"K", "R", "t"} <= _named(read_storage(path)).keys():
                complete.append(path)
        except ValueError:
            unreadable.append(path)
    return complete or unreadable


def _read(cameras: list[tuple[str, Path]]) -> list[tuple[str, dict[str, Any]]]:
    return [(name, _named(read_storage(path))) for name, path in cameras]


def _named(stored: dict[str, Any]) -> dict[str, Any]:
    """What is stored, by the names of a `cameras.json`."""
    plain = {re.sub(r"[^a-z0-9]", "", key.lower()): value for key, value in stored.items()}
    found = {name: next((plain[key] for key in keys if key in plain), None) for name, keys in KEYS.items()}
    return {name: value for name, value in found.items() if value is not None}


def _size(found: dict[str, Any]) -> list[float] | None:
    size = [found.get("width"), found.get("height")]
    return [float(side) for side in size] if all(isinstance(side, int | float) for side in size) else None  # pyright: ignore


def _lens(name: str, found: dict[str, Any]) -> dict[str, Any]:
    K, t = np.asarray(found.get("K", [])), np.asarray(found.get("t", []))
    if K.size != 9 or t.size != 3:
        got = f"{K.size} and {t.size}"
        raise ValueError(f"camera '{name}': expected a matrix of 9 numbers and a translation of 3, got {got}; add them")
    lens = {"K": K.reshape(3, 3).tolist(), "t": t.ravel().tolist(), "R": rotation_of(name, found.get("R", []))}
    return lens | {"dist": five_coefficients(name, found.get("dist", []))}
