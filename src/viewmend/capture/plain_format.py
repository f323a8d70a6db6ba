"""A plain capture's `cameras.json`, format "plain-capture/1": parsed strictly, in this project's conventions."""

import json
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64

from viewmend.capture.errors import CaptureError
from viewmend.capture.json_fields import Fields, shown
from viewmend.geometry.cameras import is_intrinsics
from viewmend.geometry.rigid import is_rotation

FORMAT = "plain-capture/1"
CALIBRATION = "cameras.json"
ROTATION_TOLERANCE = 1e-3
CAPTURE_KEYS = ("format", "first_pixel_center", "metres_per_unit", "up", "fps", "bounds", "frames", "cameras")
CAMERA_KEYS = ("name", "width", "height", "K", "R", "t", "dist", "image", "video", "mask", "depth")
Stream = Literal["image", "video", "mask", "depth"]


@dataclass(frozen=True)
class PlainCamera:
    """One camera as it stands in `cameras.json`, of the image before undistortion."""

    name: str
    width: int
    height: int
    K: Float64[np.ndarray, "3 3"]
    """Pixels; the top-left pixel has its centre at (0.5, 0.5)."""
    R: Float64[np.ndarray, "3 3"]
    """camera_from_world, exactly orthonormal."""
    t_m: Float64[np.ndarray, "3"]
    dist: Float64[np.ndarray, "5"]
    """k1 k2 p1 p2 k3 of Brown and Conrady, in OpenCV's order."""
    image: str | None
    video: str | None
    mask: str | None
    depth: str | None

    @property
    def streams(self) -> tuple[Stream, ...]:
        """What the camera has files of."""
        every: tuple[Stream, ...] = ("image", "video", "mask", "depth")
        return tuple(stream for stream in every if getattr(self, stream) is not None)

    def file(self, stream: Stream, frame: str) -> str:
        """Path of a stream's file at this frame, relative to the capture; the camera must have the stream."""
        pattern = getattr(self, stream)
        assert isinstance(pattern, str), f"camera {self.name} has no {stream}"
        return pattern.replace("{frame}", frame)


@dataclass(frozen=True)
class PlainCalibration:
    """All of a `cameras.json`, lengths in metres."""

    frames: tuple[str, ...]
    cameras: tuple[PlainCamera, ...]
    up: Float64[np.ndarray, "3"] | None
    """Unit length."""
    fps: float | None
    bounds_m: Float64[np.ndarray, "2 3"] | None
    metres_per_unit: float


def read_calibration(folder: Path) -> PlainCalibration:
    """Parse `cameras.json` of a capture folder.

    K is moved to the convention of this project (`first_pixel_center`), t and bounds to metres (`metres_per_unit`); a
    rotation that is orthonormal to 1e-3 is made exactly so.

    Raises:
        CaptureError: the file is absent, is no JSON, lacks a key, or holds a value that cannot be right.
    """
    path = folder / CALIBRATION
    root = Fields(_load(path), str(path))
    version = root.text("format")
    if version != FORMAT:
        raise root.wrong(
            "format", f'"{FORMAT}"', shown(version), "convert the capture, or use the viewmend that reads it"
        )
    root.check_spelling(CAPTURE_KEYS)
    scale = root.number("metres_per_unit", default=1.0)
    if scale <= 0:
        raise root.wrong("metres_per_unit", "a number above 0", shown(scale), "write 0.001 for millimetres")
    first = root.array("first_pixel_center", (2,), default=np.zeros(2))
    bounds = root.array("bounds", (2, 3), default=None)
    if bounds is not None and not (bounds[0] < bounds[1]).all():
        raise root.wrong("bounds", "[low corner, high corner]", shown(bounds.tolist()), "put the smaller numbers first")
    up = root.array("up", (3,), default=None)
    if up is not None and not np.linalg.norm(up) > 0:
        raise root.wrong("up", "a direction or null", shown(up.tolist()), "write null where it is unknown")
    fps = root.number("fps", default=None)
    if fps is not None and fps <= 0:
        raise root.wrong("fps", "a number above 0 or null", shown(fps), "write null for a static capture")
    return PlainCalibration(
        frames=_frames(root),
        cameras=_cameras(root, 0.5 - first, scale),
        up=None if up is None else up / np.linalg.norm(up),
        fps=fps,
        bounds_m=None if bounds is None else bounds * scale,
        metres_per_unit=scale,
    )


def _load(path: Path) -> object:
    if not path.is_file():
        there = "the folder has none" if path.parent.is_dir() else "there is no such folder"
        raise CaptureError(f"expected a capture folder with {path}, but {there}; check the path")
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:  # of syntax, of bytes, of numbers with thousands of digits
        raise CaptureError(f"{path}: expected JSON, got something else: {error}; mend the file there") from None


def _frames(root: Fields) -> tuple[str, ...]:
    frames = root.list("frames")
    for index, frame in enumerate(frames):
        if not isinstance(frame, str) or not frame:
            raise root.wrong(f"frames[{index}]", "a frame id, a string", shown(frame), "put it in quotes")
    _check_unique(root, "frames", [str(f) for f in frames])
    return tuple(str(f) for f in frames)


def _cameras(root: Fields, shift_px: Float64[np.ndarray, "2"], scale: float) -> tuple[PlainCamera, ...]:
    entries = root.list("cameras")
    if len(entries) < 2:
        raise root.wrong("cameras", "two cameras or more", str(len(entries)), "add the rig's other cameras")
    cameras = tuple(_camera(Fields(e, f"{root.where}: cameras[{i}]"), shift_px, scale) for i, e in enumerate(entries))
    _check_unique(root, "cameras", [c.name for c in cameras])
    return cameras


def _check_unique(root: Fields, key: str, names: list[str]) -> None:
    twice = sorted({n for n in names if names.count(n) > 1}) if len(set(names)) < len(names) else []
    if twice:
        raise root.wrong(key, "different names", f"{twice} more than once", "rename or remove the duplicates")


def _camera(entry: Fields, shift_px: Float64[np.ndarray, "2"], scale: float) -> PlainCamera:
    name = entry.text("name")
    entry = Fields(entry.data, f"{entry.where.split(': cameras[')[0]}: camera '{name}'")
    entry.check_spelling(CAMERA_KEYS)
    K = _intrinsics(entry)
    K[:2, 2] += shift_px
    streams = {key: _stream(entry, key) for key in ("image", "video", "mask", "depth")}
    if (streams["image"] is None) == (streams["video"] is None):
        got = "neither" if streams["image"] is None else "both"
        raise entry.wrong("image", "either 'image' or 'video'", got, "name one of the two")
    return PlainCamera(
        name=name,
        width=entry.positive_integer("width"),
        height=entry.positive_integer("height"),
        K=K,
        R=_rotation(entry),
        t_m=entry.array("t", (3,)) * scale,
        dist=entry.array("dist", (5,), default=np.zeros(5)),
        **streams,
    )


def _intrinsics(entry: Fields) -> Float64[np.ndarray, "3 3"]:
    K = entry.array("K", (3, 3))
    if K[0, 0] * K[1, 1] == 0:
        raise entry.wrong(
            "K", "an invertible matrix", f"a singular one, {shown(K.tolist())}", "give focal lengths in pixels"
        )
    if not bool(is_intrinsics(torch.from_numpy(K))):
        expected = "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0"
        raise entry.wrong("K", expected, shown(K.tolist()), "bring the calibration to OpenCV's axes and form")
    return K


def _rotation(entry: Fields) -> Float64[np.ndarray, "3 3"]:
    R = entry.array("R", (3, 3))
    if not bool(is_rotation(torch.from_numpy(R), ROTATION_TOLERANCE)):
        off = abs(R @ R.T - np.eye(3)).max()
        got = f"determinant {np.linalg.det(R):.4g}, R R^T off by {off:.2g}, {shown(R.tolist())}"
        raise entry.wrong("R", "a rotation, world to camera", got, "check axes, signs and the number of digits")
    u, _, vt = np.linalg.svd(R)  # the nearest rotation: calibrations carry few digits
    return u @ vt


def _stream(entry: Fields, key: str) -> str | None:
    pattern = entry.text(key, default=None)
    if pattern is not None and not stays_inside(pattern):
        raise entry.wrong(
            key, "a path inside the capture folder", shown(pattern), "move the file in and write it relative"
        )
    return pattern


def stays_inside(path: str) -> bool:
    """Whether a relative path cannot leave the folder that it is relative to (absolute, drive, '..')."""
    posix, windows = PurePosixPath(path), PureWindowsPath(path)
    return not (posix.is_absolute() or windows.drive or windows.root or ".." in windows.parts or not posix.parts)
