"""OpenCV's FileStorage files: a reader, and rigs with one file per camera.

The files of a rig are `CAMERA/*.xml`, next to the camera's footage, or `CAMERA.xml` in one folder;
likewise YAML. They are not parsed by OpenCV, which terminates the process on some invalid files.
"""

import math
import re
import shlex
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import yaml

from viewmend.data.formats.files import (
    decode_text,
    files_like,
    find_footage,
    folders_containing,
    read_xml,
    to_distortion,
    to_rotation,
)
from viewmend.utils.untrusted_input import bounded_bytes

MAX_BYTES = 2**20
"""Sixty cameras need 50 kB."""
LOADER = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
"""Keeps numbers as text, so that a camera named 00 keeps its name; libyaml's version is
faster, if available."""
SUFFIXES = (".xml", ".yml", ".yaml")
KEYS = {
    "K": ("k", "cameramatrix", "intrinsicmatrix", "intrinsics", "mtx"),
    "dist": ("d", "dist", "distcoeffs", "distortion", "distortioncoeffs", "distortioncoefficients"),
    "R": ("r", "rotation", "rotationmatrix", "rvec", "rotationvector"),
    "t": ("t", "translation", "translationvector", "tvec"),
    "width": ("width", "imagewidth"),
    "height": ("height", "imageheight"),
}
"""Common names of these values, in lower case and without punctuation."""


def find(folder: Path) -> Path | None:
    """The first camera's file, if it has intrinsics and a pose."""
    return next((file for _, file in _cameras(folder)), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All cameras, in the unit of their files."""
    cameras = _cameras(folder)
    footage = find_footage(folder, [name for name, _ in cameras])
    entries = []
    for name, path in ((name, path) for name, path in cameras if name in footage):
        stored = read_storage(path)
        fisheye = [key for key in stored if "fisheye" in key.lower() and np.any(stored[key])]
        if fisheye:
            raise ValueError(
                f"camera '{name}': expected a lens with k1 k2 p1 p2 k3, got {fisheye[0]}; undistort the images first"
            )
        values = _values(stored)
        W = values.get("width")
        H = values.get("height")
        size = (float(W), float(H)) if isinstance(W, int | float) and isinstance(H, int | float) else None
        entries.append(footage.entry(name, size) | _calibration(name, values))
    return {"frames": footage.frames, "fps": footage.fps, "cameras": entries}


def _cameras(folder: Path) -> list[tuple[str, Path]]:
    """Names and files of the cameras: one file per subfolder, or else several in one folder."""
    files = [(place.name, _complete_files(place)) for place in folders_containing(folder, "")[1:]]
    single = [(name, found[0]) for name, found in files if len(found) == 1]
    if len(single) >= 2:
        return single
    for place in folders_containing(folder, "calib"):
        found = [(path.stem, path) for path in _complete_files(place)]
        if len(found) >= 2:
            return found
    return []


def _complete_files(place: Path) -> list[Path]:
    """The files in a folder that have intrinsics and a pose; if there are none, those that are invalid."""
    files = [path for path in files_like(place, "*.*") if path.suffix.lower() in SUFFIXES]
    complete = []
    invalid = []
    for path in (path for path in files if path.stat().st_size <= MAX_BYTES):
        try:
            if b"opencv" not in bounded_bytes(path, MAX_BYTES):
                continue
            if {"K", "R", "t"} <= _values(read_storage(path)).keys():
                complete.append(path)
        except ValueError:
            invalid.append(path)
        except OSError:  # unreadable files are not of this format
            continue
    return complete or invalid


def _values(stored: dict[str, Any]) -> dict[str, Any]:
    """The stored values by the keys of `KEYS`."""
    plain = {re.sub(r"[^a-z0-9]", "", key.lower()): value for key, value in stored.items()}
    found = {name: next((plain[key] for key in keys if key in plain), None) for name, keys in KEYS.items()}
    return {name: value for name, value in found.items() if value is not None}


def _calibration(name: str, values: dict[str, Any]) -> dict[str, Any]:
    K = np.asarray(values.get("K", []))
    t = np.asarray(values.get("t", []))
    if K.size != 9 or t.size != 3:
        got = f"{K.size} and {t.size}"
        raise ValueError(
            f"camera '{name}': expected a matrix of 9 numbers and a translation of 3, got {got}; add them"
        )
    entry = {
        "K": K.reshape(3, 3).tolist(),
        "t": t.ravel().tolist(),
        "R": to_rotation(name, values.get("R", [])),
    }
    return entry | {"dist": to_distortion(name, values.get("dist", []))}


def read_storage(file: Path) -> dict[str, Any]:
    """The matrices (flat), numbers and lists of names in a FileStorage file, YAML, XML or JSON; the rest is ignored.

    ValueError for another file, one that is too large, and a matrix of another size.
    """
    data = bounded_bytes(file, MAX_BYTES)
    if data.lstrip().startswith(b"<"):
        entries = {child.tag: _xml_value(child) for child in read_xml(data)}
    else:
        entries = _read_yaml(decode_text(data, file.name), file.name)
    found: dict[str, Any] = {}
    for key, value in entries.items():
        if key == "names":
            found[key] = [name for name in value if isinstance(name, str)] if isinstance(value, list) else []
        elif isinstance(value, dict):
            if {"rows", "cols", "data"} <= value.keys():
                found[key] = _matrix(key, value)
        elif (number := _number(value)) is not None:
            found[key] = number
    return found


def _read_yaml(text: str, name: str) -> dict[str, Any]:
    """The content of a YAML or JSON document, with numbers as text."""
    head, _, rest = text.partition("\n")
    try:
        entries = yaml.load(rest if head.startswith("%YAML") else text, LOADER)
    except (yaml.YAMLError, RecursionError) as error:
        got = str(getattr(error, "problem", None) or "invalid text or too deep nesting")[:80]
        raise ValueError(f"expected OpenCV's YAML or XML in {name}, got: {got}; export it again") from None
    if not isinstance(entries, dict):
        raise ValueError(f"expected OpenCV's YAML or XML in {name}, got no keys; export it again")
    return {str(key): value for key, value in entries.items()}


def _xml_value(element: Element) -> Any:
    """The content of an XML element, as `_read_yaml` would return it."""
    parts = {child.tag: child.text or "" for child in element}
    if "data" in parts:
        return parts | {"data": parts["data"].split()}
    text = (element.text or "").strip()
    return shlex.split(text) if element.tag == "names" else text


def _matrix(key: str, stored: dict[str, Any]) -> np.ndarray:
    """The numbers of a stored matrix in row-major order, `(rows * cols * channels,)`."""
    data = stored["data"]
    dt = stored.get("dt", "d")
    numbers = [_number(value) for value in data] if isinstance(data, list) else []
    sides = [_number(stored.get("rows")), _number(stored.get("cols"))]
    channels = _number(dt.strip('"')[:-1] or "1") if isinstance(dt, str) else None
    if None in numbers or math.prod(side or 0 for side in (*sides, channels)) != len(numbers):
        got = f"{len(numbers)}, or invalid ones"
        raise ValueError(f"{key[:40]}: expected rows x cols numbers, got {got}; export it again")
    return np.array(numbers, float)


def _number(value: object) -> float | None:
    """A number from its text, including YAML's `.Inf` and `.Nan`; None if it is invalid."""
    try:
        return (
            float(value.lower().replace(".inf", "inf").replace(".nan", "nan"))
            if isinstance(value, str)
            else None
        )
    except ValueError:
        return None
