"""Cameras that Agisoft Metashape exports as XML: each of its aligned images is a camera of one time."""

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from viewmend.capture.formats.files import camera_names, mask_beside
from viewmend.capture.formats.xml import attributes, number, read_xml
from viewmend.foreign_input import bounded_bytes

MOST_BYTES = 2**24
"""The largest of these files that is read; a hundred cameras have 200 kB."""
UNREAD = ("k4", "p3", "p4")
"""Coefficients of a lens that are refused unless they are 0."""


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised."""
    for path in sorted(folder.glob("*.xml")):
        if path.is_file() and path.stat().st_size <= MOST_BYTES:
            data = path.read_bytes()
            if b"<document" in data[:4096] and b"<chunk" in data:
                return path
    return None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of the first chunk's aligned and enabled images would hold.

    They lie in the folder or in `images`. The unit is the chunk's, metres if it has been scaled.

    Raises:
        ValueError: the file is no XML or lacks a number, or a lens cannot be read.
    """
    chunk = read_xml(bounded_bytes(file, MOST_BYTES)).find("chunk")
    cameras = [] if chunk is None else chunk.findall("./cameras//camera")
    used = [c for c in cameras if c.find("transform") is not None and c.get("enabled", "1").lower() in ("1", "true")]
    if chunk is None or not used:
        raise ValueError("expected a chunk with aligned cameras, got none; align the photos and export them again")
    lenses = {sensor.get("id"): sensor for sensor in chunk.findall("./sensors/sensor")}
    images = [_image(folder, camera.get("label", "")) for camera in used]
    entries = []
    for camera, image, name in zip(used, images, camera_names(images), strict=True):
        entry = {"name": name, **_lens(name, lenses.get(camera.get("sensor_id"))), **_pose(name, camera, chunk)}
        entries.append(entry | {"image": image, "mask": mask_beside(folder, image.removeprefix("images/"))})
    return {"first_pixel_center": [0.5, 0.5], "frames": ["0"], "cameras": entries}


def _image(folder: Path, label: str) -> str:
    """The path of the image of this label, which often lacks the suffix."""
    for place in ("", "images/"):
        within = (folder / place).iterdir() if (folder / place).is_dir() else ()
        for path in sorted(path for path in within if path.is_file()):
            if path.name == label or (path.stem == label and path.suffix.lower() not in (".xml", ".txt")):
                return place + path.name
    return f"images/{label}"


def _lens(name: str, sensor: Element | None) -> dict[str, Any]:
    found = [] if sensor is None else sensor.findall("calibration")
    lens = next((c for c in found if c.get("class") == "adjusted"), found[0] if found else None)
    if lens is None or lens.get("type", "frame") != "frame" or any(_value(name, lens, key) for key in UNREAD):
        raise ValueError(
            f"camera '{name}': expected a calibrated frame lens of k1 to k3, p1, p2, got another; undistort"
        )
    width, height = (int(side) for side in attributes(name, lens.find("resolution"), "width height"))
    cx, cy, k1, k2, k3, p1, p2 = (_value(name, lens, key) for key in ("cx", "cy", "k1", "k2", "k3", "p1", "p2"))
    if lens.find("f") is not None:
        fx, fy, skew = (
            _value(name, lens, "f") + _value(name, lens, "b1"),
            _value(name, lens, "f"),
            _value(name, lens, "b2"),
        )
        cx, cy = cx + width / 2, cy + height / 2
    else:  # before version 1.2
        fx, fy, skew = (_value(name, lens, key) for key in ("fx", "fy", "skew"))
    K = [[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return {"width": width, "height": height, "K": K, "dist": [k1, k2, p2, p1, k3]}  # the two p are OpenCV's, swapped


def _value(name: str, lens: Element, key: str) -> float:
    found = lens.find(key)
    return 0.0 if found is None else number(f"camera '{name}': {key}", found.text)


def _pose(name: str, camera: Element, chunk: Element) -> dict[str, Any]:
    chunk_from_camera = _numbers(name, camera.find("transform"), 16).reshape(4, 4)
    component = chunk.find(f"./components/component[@id='{_digits(camera.get('component_id'))}']/transform")
    moved = chunk.find("transform") if component is None else component
    turn, shift, scale = np.eye(3), np.zeros(3), 1.0
    if moved is not None and moved.find("rotation") is not None:
        turn = _numbers(name, moved.find("rotation"), 9).reshape(3, 3)
        shift = _numbers(name, moved.find("translation"), 3)
        scale = number(f"camera '{name}': scale", moved.findtext("scale"))
    R = (turn @ chunk_from_camera[:3, :3]).T
    centre = scale * turn @ chunk_from_camera[:3, 3] + shift
    return {"R": R.tolist(), "t": (-R @ centre).tolist()}


def _digits(text: str | None) -> str:
    return text if text and text.isdecimal() else ""


def _numbers(name: str, element: Element | None, count: int) -> np.ndarray:
    words = ((None if element is None else element.text) or "").split()
    if len(words) != count:
        raise ValueError(f"camera '{name}': expected {count} numbers of its pose, got {len(words)}; export it again")
    return np.array([number(f"camera '{name}': pose", word) for word in words])
