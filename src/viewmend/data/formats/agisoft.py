"""Agisoft Metashape's XML export of cameras. Each aligned image is a camera of a single frame."""

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from viewmend.data.formats.files import files_like, find_mask, names_from_paths, read_xml, xml_attributes, xml_number
from viewmend.utils.untrusted_input import bounded_bytes

MAX_BYTES = 2**24
"""A hundred cameras need 200 kB."""
UNSUPPORTED = ("k4", "p3", "p4")
"""Distortion coefficients that must be 0."""


def find(folder: Path) -> Path | None:
    """The first XML file with a chunk of cameras."""
    for path in files_like(folder, "*.xml"):
        if path.stat().st_size <= MAX_BYTES:
            data = path.read_bytes()
            if b"<document" in data[:4096] and b"<chunk" in data:
                return path
    return None


def content(folder: Path, file: Path) -> dict[str, Any]:
    """The aligned images of the chunk that has most, in the folder or in `images`, in the chunk's unit."""
    chunks = [(chunk, _used_cameras(chunk)) for chunk in read_xml(bounded_bytes(file, MAX_BYTES)).findall("chunk")]
    chunk, used = max(chunks, key=lambda pair: len(pair[1]), default=(None, []))
    if chunk is None or not used:
        raise ValueError("expected a chunk with aligned cameras, got none; align the photos and export them again")
    sensors = {sensor.get("id"): sensor for sensor in chunk.findall("./sensors/sensor")}
    images = [_find_image(folder, camera.get("label", "")) for camera in used]
    entries = []
    for camera, image, name in zip(used, images, names_from_paths(images), strict=True):
        entry = {"name": name, **_lens(name, sensors.get(camera.get("sensor_id"))), **_pose(name, camera, chunk)}
        entries.append(entry | {"image": image, "mask": find_mask(folder, image.removeprefix("images/"))})
    return {"first_pixel_center": [0.5, 0.5], "frames": ["0"], "cameras": entries}


def _used_cameras(chunk: Element) -> list[Element]:
    cameras = chunk.findall("./cameras//camera")
    return [c for c in cameras if c.find("transform") is not None and c.get("enabled", "1").lower() in ("1", "true")]


def _find_image(folder: Path, label: str) -> str:
    """The path of the image with this label, which often lacks the suffix."""
    label = label.replace("\\", "/")
    for place in ("", "images/"):
        for path in files_like(folder / place, "*") if (folder / place).is_dir() else ():
            if path.name == label or (path.stem == label and path.suffix.lower() not in (".xml", ".txt")):
                return place + path.name
    return f"images/{label}"


def _lens(name: str, sensor: Element | None) -> dict[str, Any]:
    found = [] if sensor is None else sensor.findall("calibration")
    lens = next((c for c in found if c.get("class") == "adjusted"), found[0] if found else None)
    if lens is None or lens.get("type", "frame") != "frame" or any(_value(name, lens, key) for key in UNSUPPORTED):
        expected = "a calibrated frame lens with k1 to k3, p1, p2"
        raise ValueError(f"camera '{name}': expected {expected}, got another; undistort the images first")
    width, height = (int(side) for side in xml_attributes(name, lens.find("resolution"), "width height"))
    cx, cy, k1, k2, k3, p1, p2 = (_value(name, lens, key) for key in ("cx", "cy", "k1", "k2", "k3", "p1", "p2"))
    if lens.find("f") is not None:
        f, b1, skew = (_value(name, lens, key) for key in ("f", "b1", "b2"))
        fx, fy, cx, cy = f + b1, f, cx + width / 2, cy + height / 2
    else:  # before version 1.2
        fx, fy, skew = (_value(name, lens, key) for key in ("fx", "fy", "skew"))
    K = [[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return {"width": width, "height": height, "K": K, "dist": [k1, k2, p2, p1, k3]}  # p1 and p2 are swapped in OpenCV


def _value(name: str, lens: Element, key: str) -> float:
    found = lens.find(key)
    return 0.0 if found is None else xml_number(f"camera '{name}': {key}", found.text)


def _pose(name: str, camera: Element, chunk: Element) -> dict[str, Any]:
    chunk_from_camera = _numbers(name, camera.find("transform"), 16).reshape(4, 4)
    number = camera.get("component_id", "")
    component = chunk.find(f"./components/component[@id='{number if number.isdecimal() else ''}']/transform")
    transform = chunk.find("transform") if component is None else component
    turn, shift, scale = np.eye(3), np.zeros(3), 1.0
    if transform is not None and transform.find("rotation") is not None:
        turn = _numbers(name, transform.find("rotation"), 9).reshape(3, 3)
        shift = _numbers(name, transform.find("translation"), 3)
        scale = xml_number(f"camera '{name}': scale", transform.findtext("scale"))
    R = (turn @ chunk_from_camera[:3, :3]).T
    centre = scale * turn @ chunk_from_camera[:3, 3] + shift
    return {"R": R.tolist(), "t": (-R @ centre).tolist()}


def _numbers(name: str, element: Element | None, count: int) -> np.ndarray:
    words = ((None if element is None else element.text) or "").split()
    if len(words) != count:
        raise ValueError(f"camera '{name}': expected {count} numbers of its pose, got {len(words)}; export it again")
    return np.array([xml_number(f"camera '{name}': pose", word) for word in words])
