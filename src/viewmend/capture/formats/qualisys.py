"""Qualisys' calibration (`*.qca.txt`, XML), as Pose2Sim has it; footage is found by name."""

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from viewmend.capture.formats.files import places_named
from viewmend.capture.formats.footage import find_footage
from viewmend.capture.formats.xml import attributes, read_xml
from viewmend.foreign_input import bounded_bytes

MOST_BYTES = 2**20
"""The largest of these files that is read; four cameras have 5 kB."""
UNITS_PER_PIXEL = 64
"""Lengths on the sensor, and the coefficients of the lens, are in 64ths."""
MM_PER_M = 1000


def find(folder: Path) -> Path | None:
    """The file by which the folder is recognised, in the folder or in one whose name has "calib" in it."""
    return next((path for place in places_named(folder, "calib") for path in sorted(place.glob("*.qca.txt"))), None)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """What a `cameras.json` of these cameras would hold, in metres.

    Raises:
        ValueError: the file is no XML, a camera lacks a number, or has no footage.
    """
    cameras = read_xml(bounded_bytes(file, MOST_BYTES)).findall("./cameras/camera")
    names = [camera.get("serial", "") for camera in cameras]
    footage = find_footage(folder, names)
    entries = [
        footage.of(name, _size(name, camera)) | _lens(name, camera) for name, camera in zip(names, cameras, strict=True)
    ]
    return {"frames": footage.frames, "fps": footage.fps, "up": [0.0, 0.0, 1.0], "cameras": entries}


def _size(name: str, camera: Element) -> list[float]:
    left, right, top, bottom = attributes(name, camera.find("fov_video"), "left right top bottom")
    return [right - left + 1, bottom - top + 1]


def _lens(name: str, camera: Element) -> dict[str, Any]:
    intrinsic, transform = camera.find("intrinsic"), camera.find("transform")
    fx, fy, cx, cy, skew = attributes(name, intrinsic, "focalLengthU focalLengthV centerPointU centerPointV skew")
    k1, k2, k3 = attributes(name, intrinsic, "radialDistortion1 radialDistortion2 radialDistortion3")
    p1, p2 = attributes(name, intrinsic, "tangentalDistortion1 tangentalDistortion2")
    K = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, UNITS_PER_PIXEL]]) / UNITS_PER_PIXEL
    dist = np.array([k1, k2, p1, p2, k3]) / UNITS_PER_PIXEL
    r = np.array(attributes(name, transform, "r11 r12 r13 r21 r22 r23 r31 r32 r33")).reshape(3, 3)
    R = np.diag([1.0, -1.0, -1.0]) @ r
    centre = np.array(attributes(name, transform, "x y z")) / MM_PER_M
    return {"K": K.tolist(), "dist": dist.tolist(), "R": R.tolist(), "t": (-R @ centre).tolist()}
