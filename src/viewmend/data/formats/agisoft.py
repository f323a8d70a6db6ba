"""Agisoft Metashape's XML export of cameras. Each aligned image is a camera of a single frame.

Photos without a pose of their own are left out with a warning: those that were not aligned,
and the secondary cameras of multi-camera systems, whose pose Metashape stores relative to
the primary camera. So are photos whose sensor has no calibration.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float64

from viewmend.data.formats.files import (
    IMAGE_SUFFIXES,
    existing,
    files_like,
    first_of,
    listed,
    names_from_paths,
    read_xml,
    warn,
    warn_of_unused_images,
    xml_attributes,
    xml_number,
)
from viewmend.data.formats.moments import PosedImage, fixed_cameras, with_masks
from viewmend.utils.untrusted_input import bounded_bytes

MAX_BYTES = 2**24
"""A hundred cameras need 200 kB."""
UNSUPPORTED = ("k4", "p3", "p4")
"""Distortion coefficients that must be 0."""


def find(folder: Path) -> Path | None:
    """The first XML file with a chunk of cameras."""
    return first_of(path for path in files_like(folder, "*.xml") if _has_chunk(path))


def _has_chunk(file: Path) -> bool:
    """Whether this is an export of Metashape that is not too large."""
    if file.stat().st_size > MAX_BYTES:
        return False
    data = file.read_bytes()
    return b"<document" in data[:4096] and b"<chunk" in data


def content(folder: Path, file: Path) -> dict[str, Any]:
    """The aligned images of the chunk that has most, in the folder or below `images`, in the chunk's unit."""
    chunk = _choose_chunk(file)
    used = _used_cameras(chunk)
    _warn_of_others(file, chunk, used)
    candidates = _find_images(folder, chunk)
    warn_of_unused_images(folder, chain.from_iterable(candidates.values()))
    paths = {camera: _only_image(camera, candidates[camera]) for camera in used}
    used = existing(folder, used, paths.__getitem__)
    sensors = {sensor.get("id"): sensor for sensor in chunk.findall("./sensors/sensor")}
    used = _with_calibration(file, used, sensors)
    posed = [_posed(chunk, camera, paths[camera], sensors.get(camera.get("sensor_id"))) for camera in used]
    posed = with_masks(folder, posed)
    rig = fixed_cameras(posed)
    if rig is not None:
        cameras, frames = rig
        return {"first_pixel_center": [0.5, 0.5], "frames": list(frames), "cameras": cameras}
    entries = []
    names = names_from_paths([image.path.removeprefix("images/") for image in posed])
    for image, name in zip(posed, names, strict=True):
        pose = {"R": image.R.tolist(), "t": (-image.R @ image.center).tolist()}
        entries.append({"name": name, **image.lens, **pose, "image": image.path, "mask": image.mask})
    return {"first_pixel_center": [0.5, 0.5], "frames": ["0"], "cameras": entries}


def _choose_chunk(file: Path) -> Element:
    """The chunk with most aligned cameras, with a warning of the others; ValueError if no chunk has any."""
    chunks = [
        chunk for chunk in read_xml(bounded_bytes(file, MAX_BYTES)).findall("chunk") if _used_cameras(chunk)
    ]
    if not chunks:
        raise ValueError(
            "expected a chunk with aligned cameras, got none; align the photos and export them again"
        )
    largest = max(chunks, key=lambda chunk: len(_used_cameras(chunk)))
    others = [chunk.get("label", "") for chunk in chunks if chunk is not largest]
    if others:
        warn(f"{file}: the chunk '{largest.get('label', '')}' is used, and not {listed(others)}")
    return largest


def _posed(chunk: Element, camera: Element, image: str, sensor: Element | None) -> PosedImage:
    """A photo with its lens and its pose."""
    label = camera.get("label", "")
    R, center = _pose(label, camera, chunk)
    return PosedImage(image, None, _lens(label, sensor), R, center)


def _used_cameras(chunk: Element) -> list[Element]:
    """The enabled cameras with a pose, of the component that has most of them: components do not share a world."""
    posed = [
        camera for camera in _cameras(chunk) if _is_enabled(camera) and camera.find("transform") is not None
    ]
    components = Counter(camera.get("component_id") for camera in posed)
    largest = components.most_common(1)[0][0] if components else None
    return [camera for camera in posed if camera.get("component_id") == largest]


def _cameras(chunk: Element) -> list[Element]:
    return chunk.findall("./cameras//camera")


def _is_enabled(camera: Element) -> bool:
    return camera.get("enabled", "1").lower() in ("1", "true")


def _warn_of_others(file: Path, chunk: Element, used: list[Element]) -> None:
    """Name the photos of a chunk that are not used, by the reason."""
    reasons: dict[str, list[str]] = {}
    for camera in _cameras(chunk):
        if camera in used:
            continue
        if not _is_enabled(camera):
            reason = "photos that are disabled in Metashape are left out"
        elif camera.find("transform") is not None:
            reason = "photos that are aligned only among themselves (another component) are left out"
        elif camera.get("master_id") is not None:
            reason = (
                "photos of a multi-camera system without a pose of their own are left out (split the system into "
                "single cameras in Metashape and export again)"
            )
        else:
            reason = "photos that were not aligned are left out"
        reasons.setdefault(reason, []).append(camera.get("label", ""))
    for reason, labels in reasons.items():
        warn(f"{file}: {reason}: {listed(labels)}")


def _with_calibration(
    file: Path, used: Sequence[Element], sensors: Mapping[str | None, Element]
) -> list[Element]:
    """The cameras whose sensor has a calibration, with a warning of the others; all of them if fewer than two have."""
    calibrated = [camera for camera in used if _calibration(sensors.get(camera.get("sensor_id"))) is not None]
    if len(calibrated) == len(used) or len(calibrated) < 2:
        return list(used)
    labels = [camera.get("label", "") for camera in used if camera not in calibrated]
    warn(f"{file}: photos whose sensor has no calibration are left out: {listed(labels)}")
    return calibrated


def _find_images(folder: Path, chunk: Element) -> dict[Element, list[str]]:
    """The images that may be each photo's, in the folder or below `images`; the expected path if there is none.

    A photo's label is the name of its file, often without the suffix. Photos in several folders may
    share a label. Their groups then have the names of the folders.
    """
    places = [*files_like(folder, "*"), *files_like(folder / "images", "**/*")]
    by_label: dict[str, list[str]] = {}
    for path in (path for path in places if path.suffix.lower() in IMAGE_SUFFIXES):
        relative = path.relative_to(folder).as_posix()
        for label in (path.name, path.stem):
            by_label.setdefault(label, []).append(relative)
    groups = {camera: group for group in chunk.iter("group") for camera in group.findall("camera")}
    found = {}
    for camera in _cameras(chunk):
        label = camera.get("label", "").replace("\\", "/")
        parent, _, name = label.rpartition("/")
        paths = [path for path in by_label.get(name, []) if f"/{path}".rpartition("/")[0].endswith(parent)]
        group = groups[camera].get("label", "") if camera in groups else ""
        in_group = [path for path in paths if path.split("/")[-2:-1] == [group]]
        at_top = [path for path in paths if path.rpartition("/")[0] in ("", "images")]
        found[camera] = in_group or at_top[:1] or paths or [f"images/{label}"]
    return found


def _only_image(camera: Element, candidates: Sequence[str]) -> str:
    """The only image that may be a photo's; ValueError if there are several."""
    if len(candidates) > 1:
        label = camera.get("label", "")[:80]
        raise ValueError(
            f"expected one image of the photo '{label}', got {listed(candidates)}; put the photos of each folder in a "
            "group of the folder's name in Metashape and export again"
        )
    return candidates[0]


def _calibration(sensor: Element | None) -> Element | None:
    """The adjusted calibration of a sensor, else the first one; None if it has none."""
    found = [] if sensor is None else sensor.findall("calibration")
    return next((c for c in found if c.get("class") == "adjusted"), found[0] if found else None)


def _lens(name: str, sensor: Element | None) -> dict[str, Any]:
    lens = _calibration(sensor)
    if lens is None:
        raise ValueError(
            f"camera '{name}': expected a sensor with a calibration, got none; align the photos, and export again"
        )
    if lens.get("type", "frame") != "frame" or any(_value(name, lens, key) for key in UNSUPPORTED):
        expected = "a calibrated frame lens with k1 to k3, p1, p2"
        raise ValueError(f"camera '{name}': expected {expected}, got another; undistort the images first")
    width, height = (int(side) for side in xml_attributes(name, lens.find("resolution"), "width height"))
    cx, cy, k1, k2, k3, p1, p2 = (
        _value(name, lens, key) for key in ("cx", "cy", "k1", "k2", "k3", "p1", "p2")
    )
    if lens.find("f") is not None:
        f, b1, skew = (_value(name, lens, key) for key in ("f", "b1", "b2"))
        fx = f + b1
        fy = f
        cx = cx + width / 2
        cy = cy + height / 2
    else:  # before version 1.2
        fx, fy, skew = (_value(name, lens, key) for key in ("fx", "fy", "skew"))
    K = [[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return {
        "width": width,
        "height": height,
        "K": K,
        "dist": [k1, k2, p2, p1, k3],
    }  # p1 and p2 are swapped in OpenCV


def _value(name: str, lens: Element, key: str) -> float:
    found = lens.find(key)
    return 0.0 if found is None else xml_number(f"camera '{name}': {key}", found.text)


def _pose(
    name: str, camera: Element, chunk: Element
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Rotation of camera_from_world and the camera's position."""
    chunk_from_camera = _numbers(name, camera.find("transform"), 16).reshape(4, 4)
    number = camera.get("component_id", "")
    component = chunk.find(f"./components/component[@id='{number if number.isdecimal() else ''}']/transform")
    transform = chunk.find("transform") if component is None else component
    turn = np.eye(3)
    shift = np.zeros(3)
    scale = 1.0
    if transform is not None and transform.find("rotation") is not None:
        turn = _numbers(name, transform.find("rotation"), 9).reshape(3, 3)
        shift = _numbers(name, transform.find("translation"), 3)
        scale = xml_number(f"camera '{name}': scale", transform.findtext("scale"))
    R = (turn @ chunk_from_camera[:3, :3]).T
    centre = scale * turn @ chunk_from_camera[:3, 3] + shift
    return R, centre


def _numbers(name: str, element: Element | None, count: int) -> np.ndarray:
    words = ((None if element is None else element.text) or "").split()
    if len(words) != count:
        raise ValueError(
            f"camera '{name}': expected {count} numbers of its pose, got {len(words)}; export it again"
        )
    return np.array([xml_number(f"camera '{name}': pose", word) for word in words])
