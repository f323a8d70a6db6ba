"""A plain capture's `cameras.json`, format "plain-capture/1": parsed strictly, in this project's conventions."""

import difflib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float64
from msgspec import Meta, Struct

from viewmend.capture.errors import CaptureError
from viewmend.foreign_input import bounded_bytes
from viewmend.geometry.cameras import is_intrinsics
from viewmend.geometry.rigid import is_rotation
from viewmend.json_input import Number, Triple, read_json, shown, typed

FORMAT = "plain-capture/1"
CALIBRATION = "cameras.json"
ROTATION_TOLERANCE = 1e-3
Stream = Literal["image", "video", "mask", "depth"]
STREAMS: tuple[Stream, ...] = ("image", "video", "mask", "depth")
Text = Annotated[str, Meta(min_length=1)]
Pixels = Annotated[int, Meta(ge=1, le=2**31 - 1)]
Positive = Annotated[float, Meta(gt=0, le=1e300)]
Matrix = tuple[Triple, Triple, Triple]


class CameraEntry(Struct, frozen=True, kw_only=True):
    """One of the file's `cameras`."""

    name: Text
    width: Pixels
    height: Pixels
    K: Matrix
    R: Matrix
    t: Triple
    dist: tuple[Number, Number, Number, Number, Number] = (0.0, 0.0, 0.0, 0.0, 0.0)
    image: Text | None = None
    video: Text | None = None
    mask: Text | None = None
    depth: Text | None = None
    colour: Matrix | None = None
    mask_labels: bool = False

    def __post_init__(self) -> None:
        if not bool(is_intrinsics(torch.tensor(self.K, dtype=torch.float64))):
            expected = "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0"
            raise _wrong("K", expected, shown(self.K), "bring the calibration to OpenCV's axes and form, in pixels")
        R = np.array(self.R)
        if not bool(is_rotation(torch.from_numpy(R), ROTATION_TOLERANCE)):
            off = abs(R @ R.T - np.eye(3)).max()
            got = f"determinant {np.linalg.det(R):.4g}, R R^T off by {off:.2g}, {shown(self.R)}"
            raise _wrong("R", "a rotation, world to camera", got, "check axes, signs and the number of digits")
        if (self.image is None) == (self.video is None):
            got = "neither" if self.image is None else "both"
            raise _wrong("image", "either 'image' or 'video'", got, "name one of the two")
        for stream in STREAMS:
            if not stays_inside(getattr(self, stream) or "inside"):
                got = shown(getattr(self, stream))
                next_step = "move the file in and write it relative"
                raise _wrong(stream, "a path inside the capture folder", got, next_step)


class CalibrationFile(Struct, frozen=True, kw_only=True):
    """All of the file."""

    format: str
    first_pixel_center: tuple[Number, Number] = (0.0, 0.0)
    metres_per_unit: Positive = 1.0
    up: Triple | None = None
    fps: Positive | None = None
    bounds: tuple[Triple, Triple] | None = None
    frames: Annotated[tuple[Text, ...], Meta(min_length=1)]
    cameras: tuple[CameraEntry, ...]

    def __post_init__(self) -> None:
        if self.bounds is not None and not all(low < high for low, high in zip(*self.bounds, strict=True)):
            raise _wrong("bounds", "[low corner, high corner]", shown(self.bounds), "put the smaller numbers first")
        if self.up is not None and not any(self.up):
            raise _wrong("up", "a direction or null", shown(self.up), "write null where it is unknown")
        if len(self.cameras) < 2:
            raise _wrong("cameras", "two cameras or more", str(len(self.cameras)), "add the rig's other cameras")
        for key, names in (("frames", self.frames), ("cameras", tuple(camera.name for camera in self.cameras))):
            twice = sorted(name for name, count in Counter(names).items() if count > 1)[:5]
            if twice:
                raise _wrong(key, "different names", f"{twice} more than once", "rename or remove the duplicates")


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
    colour: Float64[np.ndarray, "3 3"] | None = None
    """Coefficients a, b, c of red, green and blue: values x of 0 to 255 become a x^2 + b x + c."""
    mask_labels: bool = False
    """Whether a mask's values are labels, of which 0 alone is background."""

    @property
    def streams(self) -> tuple[Stream, ...]:
        """What the camera has files of."""
        return tuple(stream for stream in STREAMS if getattr(self, stream) is not None)

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
    file: Path
    """Where it was read."""
    folder: Path
    """What the files' paths are relative to."""


def read_calibration(folder: Path) -> PlainCalibration:
    """Parse `cameras.json` of a capture folder.

    K is moved to the convention of this project (`first_pixel_center`), t and bounds to metres (`metres_per_unit`); a
    rotation that is orthonormal to 1e-3 is made exactly so.

    Raises:
        CaptureError: the file is absent, is no JSON, lacks a key, or holds a value that cannot be right.
    """
    path = folder / CALIBRATION
    if not path.is_file():
        there = "the folder has none" if folder.is_dir() else "there is no such folder"
        raise CaptureError(f"expected a capture folder with {path}, but {there}; check the path")
    try:
        return calibration_of(_spelt(bounded_bytes(path)), path)
    except ValueError as error:
        raise CaptureError(f"{path}: {error}") from None


def calibration_of(content: dict[str, Any], path: Path) -> PlainCalibration:
    """The calibration that this content of a `cameras.json` means; `path` is where it was read.

    Raises:
        ValueError: a key is absent, or a value cannot be right.
    """
    file = typed({"format": FORMAT, **read_json(json.dumps(content))}, CalibrationFile)
    shift_px = 0.5 - np.array(file.first_pixel_center)
    up = None if file.up is None else np.array(file.up)
    return PlainCalibration(
        frames=file.frames,
        cameras=tuple(_camera(entry, shift_px, file.metres_per_unit) for entry in file.cameras),
        up=None if up is None else up / np.linalg.norm(up),
        fps=file.fps,
        bounds_m=None if file.bounds is None else np.array(file.bounds) * file.metres_per_unit,
        metres_per_unit=file.metres_per_unit,
        file=path,
        folder=path.parent,
    )


def write_calibration(folder: Path, calibration: PlainCalibration) -> None:
    """Write a `cameras.json` that reads as this calibration; files are named as they are in it."""
    content = {
        "format": FORMAT,
        "first_pixel_center": [0.5, 0.5],
        "metres_per_unit": 1.0,
        "up": None if calibration.up is None else calibration.up.tolist(),
        "fps": calibration.fps,
        "bounds": None if calibration.bounds_m is None else calibration.bounds_m.tolist(),
        "frames": list(calibration.frames),
        "cameras": [_entry(camera) for camera in calibration.cameras],
    }
    (folder / CALIBRATION).write_text(json.dumps(content, indent=1), encoding="utf-8")


def _entry(camera: PlainCamera) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": camera.name, "width": camera.width, "height": camera.height}
    entry |= {"K": camera.K.tolist(), "R": camera.R.tolist(), "t": camera.t_m.tolist(), "dist": camera.dist.tolist()}
    entry |= {stream: getattr(camera, stream) for stream in camera.streams}
    if camera.colour is not None:
        entry["colour"] = camera.colour.tolist()
    return entry | ({"mask_labels": True} if camera.mask_labels else {})


def _spelt(text: bytes) -> dict[str, Any]:
    content = typed(read_json(text), dict[str, Any], "see docs/plain-capture.md")
    version = content.get("format")
    if version != FORMAT:
        got = "nothing" if version is None else shown(version)
        raise _wrong("format", f'"{FORMAT}"', got, "convert the capture, or use the viewmend that reads it")
    _check_spelling(content, CalibrationFile.__struct_fields__)
    for entry in content["cameras"] if isinstance(content.get("cameras"), list) else ():
        if isinstance(entry, dict):
            _check_spelling(entry, CameraEntry.__struct_fields__)
    return content


def _check_spelling(entry: dict[str, Any], known: Sequence[str]) -> None:
    """Unknown keys are notes and pass, unless they look like a known key that is absent (a typo)."""
    absent = [key for key in known if key not in entry]
    for key in entry.keys() - set(known):
        close = difflib.get_close_matches(key.lower(), [a.lower() for a in absent], n=1, cutoff=0.8)
        if close:
            raise _wrong(key, f"the key '{close[0]}'", f"'{key}'", "rename the key")


def _wrong(key: str, expected: str, got: str, next_step: str) -> ValueError:
    return ValueError(f"{key}: expected {expected}, got {got}; {next_step}")


def _camera(entry: CameraEntry, shift_px: Float64[np.ndarray, "2"], scale: float) -> PlainCamera:
    K = np.array(entry.K)
    K[:2, 2] += shift_px
    u, _, vt = np.linalg.svd(np.array(entry.R))  # the nearest rotation: calibrations carry few digits
    return PlainCamera(
        **{key: getattr(entry, key) for key in ("name", "width", "height", *STREAMS)},
        K=K,
        R=u @ vt,
        t_m=np.array(entry.t) * scale,
        dist=np.array(entry.dist),
        colour=None if entry.colour is None else np.array(entry.colour),
        mask_labels=entry.mask_labels,
    )


def stays_inside(path: str) -> bool:
    """Whether a relative path cannot leave the folder that it is relative to (absolute, drive, '..')."""
    posix, windows = PurePosixPath(path), PureWindowsPath(path)
    return not (posix.is_absolute() or windows.drive or windows.root or ".." in windows.parts or not posix.parts)
