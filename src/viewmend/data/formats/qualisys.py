"""Qualisys calibrations (`*.qca.txt`, XML), as used by Pose2Sim. Footage is found by the cameras' names."""

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from viewmend.data.formats.files import (
    files_like,
    find_footage,
    first_of,
    folders_containing,
    read_xml,
    xml_attributes,
)
from viewmend.utils.untrusted_input import bounded_bytes

MAX_BYTES = 2**20
"""Four cameras need 5 kB."""
UNITS_PER_PIXEL = 64
"""Lengths on the sensor and distortion coefficients are in 64ths."""
MM_PER_M = 1000


def find(folder: Path) -> Path | None:
    """The calibration, in the folder or in one with "calib" in its name."""
    files = (path for place in folders_containing(folder, "calib") for path in files_like(place, "*.qca.txt"))
    return first_of(files)


def content(folder: Path, file: Path) -> dict[str, Any]:
    """All cameras that have footage, in metres. Marker cameras of the same system have none."""
    cameras = read_xml(bounded_bytes(file, MAX_BYTES)).findall("./cameras/camera")
    names = [camera.get("serial", "") for camera in cameras]
    footage = find_footage(folder, names)
    entries = []
    recorded = [(name, camera) for name, camera in zip(names, cameras, strict=True) if name in footage]
    for name, camera in recorded:
        left, right, top, bottom = xml_attributes(name, camera.find("fov_video"), "left right top bottom")
        entries.append(footage.entry(name, [right - left + 1, bottom - top + 1]) | _calibration(name, camera))
    return {"frames": footage.frames, "fps": footage.fps, "up": [0.0, 0.0, 1.0], "cameras": entries}


def _calibration(name: str, camera: Element) -> dict[str, Any]:
    intrinsic = camera.find("intrinsic")
    transform = camera.find("transform")
    fx, fy, cx, cy, skew = xml_attributes(
        name, intrinsic, "focalLengthU focalLengthV centerPointU centerPointV skew"
    )
    k1, k2, k3 = xml_attributes(name, intrinsic, "radialDistortion1 radialDistortion2 radialDistortion3")
    p1, p2 = xml_attributes(name, intrinsic, "tangentalDistortion1 tangentalDistortion2")
    K = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, UNITS_PER_PIXEL]]) / UNITS_PER_PIXEL
    dist = np.array([k1, k2, p1, p2, k3]) / UNITS_PER_PIXEL
    r = np.array(xml_attributes(name, transform, "r11 r12 r13 r21 r22 r23 r31 r32 r33")).reshape(3, 3)
    R = np.diag([1.0, -1.0, -1.0]) @ r
    centre = np.array(xml_attributes(name, transform, "x y z")) / MM_PER_M
    return {"K": K.tolist(), "dist": dist.tolist(), "R": R.tolist(), "t": (-R @ centre).tolist()}
