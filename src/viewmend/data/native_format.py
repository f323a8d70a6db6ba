"""Our own capture format, "plain-capture/1": parsing and writing of `cameras.json`."""

import difflib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float64
from msgspec import Meta, Struct

from viewmend.data.errors import CaptureError
from viewmend.geometry.cameras import is_intrinsics
from viewmend.geometry.rigid import is_rotation
from viewmend.utils.untrusted_input import Number, Triple, bounded_bytes, read_json, shown, typed

FORMAT = "plain-capture/1"
"""The key `format` of a calibration has this value."""
CALIBRATION = "cameras.json"
"""The calibration of a capture is in a file of this name."""
ROTATION_TOLERANCE = 1e-3
"""The entries of R R^T may differ from the identity by this much: files hold rounded numbers."""
FAR = 100.0
"""A rig is far from the file's origin if its distance is more than this many times its extent.
The origin is then moved to the rig."""
FileKind = Literal["image", "video", "mask", "depth"]
FILE_KINDS: tuple[FileKind, ...] = ("image", "video", "mask", "depth")
Text = Annotated[str, Meta(min_length=1)]
Pixels = Annotated[int, Meta(ge=1, le=2**31 - 1)]
Positive = Annotated[float, Meta(gt=0, le=1e300)]
Matrix = tuple[Triple, Triple, Triple]


class _CameraEntry(Struct, frozen=True, kw_only=True):
    """An entry of `cameras` in a `cameras.json`; docs/capture-format.md describes the keys."""

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
    offset_ms: Annotated[float, Meta(ge=-1e9, le=1e9)] = 0.0

    def __post_init__(self) -> None:
        if not is_intrinsics(self.K):
            expected = "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0"
            raise _invalid(
                "K", expected, shown(self.K), "convert the calibration to OpenCV's convention, in pixels"
            )
        R = np.array(self.R)
        if not bool(is_rotation(torch.from_numpy(R), ROTATION_TOLERANCE)):
            off = abs(R @ R.T - np.eye(3)).max()
            got = f"determinant {np.linalg.det(R):.4g}, R R^T off by {off:.2g}, {shown(self.R)}"
            raise _invalid(
                "R", "a rotation, world to camera", got, "check axes, signs and the number of digits"
            )
        if (self.image is None) == (self.video is None):
            got = "neither" if self.image is None else "both"
            raise _invalid("image", "either 'image' or 'video'", got, "name one of the two")
        for kind in FILE_KINDS:
            path = getattr(self, kind)
            if path and not stays_inside(path):
                next_step = "move the file into the folder and write a relative path"
                raise _invalid(kind, "a path inside the capture folder", shown(path), next_step)


class _Content(Struct, frozen=True, kw_only=True):
    """The content of a `cameras.json`; docs/capture-format.md describes the keys."""

    format: str
    first_pixel_center: tuple[Number, Number] = (0.0, 0.0)
    metres_per_unit: Positive = 1.0
    up: Triple | None = None
    fps: Positive | None = None
    bounds: tuple[Triple, Triple] | None = None
    frames: Annotated[tuple[Text, ...], Meta(min_length=1)] | None = None
    cameras: tuple[_CameraEntry, ...]

    def __post_init__(self) -> None:
        if self.bounds is not None and not all(low < high for low, high in zip(*self.bounds, strict=True)):
            raise _invalid(
                "bounds", "[low corner, high corner]", shown(self.bounds), "put the smaller numbers first"
            )
        if self.up is not None and not any(self.up):
            raise _invalid("up", "a direction or null", shown(self.up), "write null if it is unknown")
        if len(self.cameras) < 2:
            raise _invalid(
                "cameras", "two cameras or more", str(len(self.cameras)), "add the rig's other cameras"
            )
        _check_names_differ("frames", self.frames or ())
        _check_names_differ("cameras", [camera.name for camera in self.cameras])


@dataclass(frozen=True)
class NativeCamera:
    """One camera of a calibration, with the lens distortion of its images."""

    name: str
    width: int
    height: int
    K: Float64[np.ndarray, "3 3"]
    """Pixels; the centre of the top-left pixel is at (0.5, 0.5)."""
    R: Float64[np.ndarray, "3 3"]
    """Rotation of camera_from_world, exactly orthonormal."""
    t_m: Float64[np.ndarray, "3"]
    """Translation of camera_from_world, metres."""
    dist: Float64[np.ndarray, "5"]
    """Brown-Conrady coefficients k1 k2 p1 p2 k3, in OpenCV's order."""
    image: str | None
    """Path of its images in the capture's folder, with {frame} for the frame id; None if it has a video."""
    video: str | None
    """Path of its video; None if it has images."""
    mask: str | None
    """Path of its masks, as for images, or of a video of masks; None if it has none."""
    depth: str | None
    """Path of its depth images (16-bit PNG, z-depth in millimetres), as for images; None if it has none."""
    colour: Float64[np.ndarray, "3 3"] | None = None
    """A row of coefficients a, b, c for each of red, green and blue: a value x in 0..255 becomes
    a x^2 + b x + c. None if colours stay unchanged."""
    mask_labels: bool = False
    """Whether mask values are labels, of which only 0 is background."""
    offset_ms: float = 0.0
    """How far the camera's clock is ahead: this is subtracted from the times of its frames."""

    @property
    def file_kinds(self) -> tuple[FileKind, ...]:
        """The kinds of files that the camera has."""
        return tuple(kind for kind in FILE_KINDS if getattr(self, kind) is not None)

    def file(self, kind: FileKind, frame: str) -> str:
        """Path of its file for this frame, in the capture's folder. It must have files of that kind."""
        pattern = getattr(self, kind)
        assert isinstance(pattern, str), f"camera {self.name} has no {kind}"
        return pattern.replace("{frame}", frame)


@dataclass(frozen=True)
class NativeCalibration:
    """The content of a `cameras.json`, with lengths in metres."""

    frames: tuple[str, ...]
    """Frame ids in order; empty if the file lists none, as they are those of the footage (`with_frames`)."""
    cameras: tuple[NativeCamera, ...]
    up: Float64[np.ndarray, "3"] | None
    """Unit length."""
    fps: float | None
    bounds_m: Float64[np.ndarray, "2 3"] | None
    metres_per_unit: float
    file: Path
    """The file that the calibration was read from."""
    folder: Path
    """The capture's folder, which the paths of the cameras' files are relative to."""
    origin_m: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """The origin of this calibration, in the coordinates of the file. It is 0 unless the cameras
    are far from the file's origin, as in survey coordinates. Then it is a point near the cameras."""


def read_calibration(folder: Path) -> NativeCalibration:
    """Parse the `cameras.json` of a capture folder; CaptureError if it is missing or invalid.

    Converts K to this project's pixel convention (`first_pixel_center`) and t and bounds to metres
    (`metres_per_unit`). A rotation that is orthonormal to within 1e-3 is made exactly orthonormal.
    """
    path = folder / CALIBRATION
    if not path.is_file():
        got = (
            "the folder has neither it nor another format's files (docs/formats.md)"
            if folder.is_dir()
            else "there is no such folder"
        )
        if folder.is_file():
            raise CaptureError(
                f"expected a capture folder, got the file {folder}; open its folder, {folder.parent}"
            )
        raise CaptureError(f"expected a capture folder with {path}, but {got}; check the path")
    try:
        content = typed(read_json(bounded_bytes(path)), dict[str, Any], "see docs/capture-format.md")
        _check_keys(content)
        return calibration_from_content(content, path)
    except ValueError as error:
        raise CaptureError(f"{path}: {error}") from None


def calibration_from_content(content: dict[str, Any], path: Path) -> NativeCalibration:
    """Convert the content of a `cameras.json`, read from the file `path`; ValueError if it is invalid."""
    # Readers of other formats pass Python values. Converted to JSON and back, they pass the same checks as
    # those of a file
    as_read = read_json(json.dumps(content))
    checked = typed({"format": FORMAT, **as_read}, _Content)
    shift_px = 0.5 - np.array(checked.first_pixel_center)
    unit_m = checked.metres_per_unit
    up = None if checked.up is None else np.array(checked.up)
    calibration = NativeCalibration(
        frames=checked.frames or (),
        cameras=tuple(_camera(entry, shift_px, unit_m) for entry in checked.cameras),
        up=None if up is None else up / np.linalg.norm(up),
        fps=checked.fps,
        bounds_m=None if checked.bounds is None else np.array(checked.bounds) * unit_m,
        metres_per_unit=unit_m,
        file=path,
        folder=path.parent,
    )
    return moved_to(calibration, _origin_near_cameras_m(calibration))


def _origin_near_cameras_m(calibration: NativeCalibration) -> Float64[np.ndarray, "3"]:
    """An origin near the cameras, in the coordinates of the file.

    It is 0 if the cameras are near enough to the file's origin for 32-bit numbers, or if all are at the same
    point. Otherwise, it is the mean of the camera centres, rounded to whole steps. A step is the rig's extent,
    rounded up to a power of ten.
    """
    centers_m = np.array([-camera.R.T @ camera.t_m for camera in calibration.cameras])
    middle_m = centers_m.mean(0)
    extent_m = float((centers_m.max(0) - centers_m.min(0)).max())
    is_valid = extent_m > 0 and bool(np.isfinite(middle_m).all())
    if not is_valid or np.abs(middle_m).max() <= FAR * extent_m:
        return np.zeros(3)
    step_m = 10.0 ** np.ceil(np.log10(extent_m))
    return np.rint(middle_m / step_m) * step_m


def moved_to(calibration: NativeCalibration, origin_m: Float64[np.ndarray, "3"]) -> NativeCalibration:
    """The same calibration relative to another origin, which is given in the coordinates of the file."""
    shift_m = origin_m - calibration.origin_m
    if not shift_m.any():
        return calibration
    cameras = tuple(replace(camera, t_m=camera.t_m + camera.R @ shift_m) for camera in calibration.cameras)
    bounds_m = None if calibration.bounds_m is None else calibration.bounds_m - shift_m
    return replace(calibration, cameras=cameras, bounds_m=bounds_m, origin_m=origin_m)


def exact_pose(
    R: Float64[np.ndarray, "3 3"], t: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """The rotation that is nearest to a rounded one, and the translation that keeps the camera's position."""
    u, _, vt = np.linalg.svd(R)
    center = -np.linalg.solve(R, t)
    return u @ vt, -(u @ vt) @ center


def _camera(entry: _CameraEntry, shift_px: Float64[np.ndarray, "2"], unit_m: float) -> NativeCamera:
    K = np.array(entry.K)
    K[:2, 2] += shift_px
    R, t = exact_pose(np.array(entry.R), np.array(entry.t))
    return NativeCamera(
        name=entry.name,
        width=entry.width,
        height=entry.height,
        K=K,
        R=R,
        t_m=t * unit_m,
        dist=np.array(entry.dist),
        image=_with_slashes(entry.image),
        video=_with_slashes(entry.video),
        mask=_with_slashes(entry.mask),
        depth=_with_slashes(entry.depth),
        colour=None if entry.colour is None else np.array(entry.colour),
        mask_labels=entry.mask_labels,
        offset_ms=entry.offset_ms,
    )


def _with_slashes(path: str | None) -> str | None:
    """The path with `/` instead of Windows' backslashes."""
    return None if path is None else path.replace("\\", "/")


def write_calibration(folder: Path, calibration: NativeCalibration) -> None:
    """Write a `cameras.json` that reads back as this calibration, with lengths in metres.

    Positions are relative to the origin of `calibration.file`; file paths stay unchanged.
    """
    calibration = moved_to(calibration, np.zeros(3))
    content = {
        "format": FORMAT,
        "first_pixel_center": [0.5, 0.5],
        "metres_per_unit": 1.0,
        "up": None if calibration.up is None else calibration.up.tolist(),
        "fps": calibration.fps,
        "bounds": None if calibration.bounds_m is None else calibration.bounds_m.tolist(),
        "cameras": [_entry(camera) for camera in calibration.cameras],
    }
    if calibration.frames:
        content["frames"] = list(calibration.frames)
    (folder / CALIBRATION).write_text(json.dumps(content, indent=1), encoding="utf-8")


def _entry(camera: NativeCamera) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": camera.name, "width": camera.width, "height": camera.height}
    entry |= {
        "K": camera.K.tolist(),
        "R": camera.R.tolist(),
        "t": camera.t_m.tolist(),
        "dist": camera.dist.tolist(),
    }
    entry |= {kind: getattr(camera, kind) for kind in camera.file_kinds}
    if camera.colour is not None:
        entry["colour"] = camera.colour.tolist()
    if camera.offset_ms:
        entry["offset_ms"] = camera.offset_ms
    return entry | ({"mask_labels": True} if camera.mask_labels else {})


def _check_keys(content: dict[str, Any]) -> None:
    """Check the version and the spelling of the keys."""
    version = content.get("format")
    if version != FORMAT:
        got = "nothing" if version is None else shown(version)
        raise _invalid(
            "format", f'"{FORMAT}"', got, "convert the capture, or use a version of viewmend that reads it"
        )
    _check_spelling(content, _Content.__struct_fields__)
    cameras = content.get("cameras")
    if isinstance(cameras, list):
        for entry in cameras:
            if isinstance(entry, dict):
                _check_spelling(entry, _CameraEntry.__struct_fields__)


def _check_spelling(entry: dict[str, Any], known: Sequence[str]) -> None:
    """Reject a misspelt key: one that is unknown and resembles a key that the entry lacks.

    Other unknown keys are ignored.
    """
    absent = {key.lower(): key for key in known if key not in entry}
    for key in entry.keys() - set(known):
        close = difflib.get_close_matches(key.lower(), absent, n=1, cutoff=0.8)
        if close:
            raise _invalid(key, f"the key '{absent[close[0]]}'", f"'{key}'", "rename the key")


def _check_names_differ(key: str, names: Sequence[str]) -> None:
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)[:5]
    if repeated:
        raise _invalid(
            key, "different names", f"{repeated} more than once", "rename or remove the duplicates"
        )


def _invalid(key: str, expected: str, got: str, next_step: str) -> ValueError:
    return ValueError(f"{key}: expected {expected}, got {got}; {next_step}")


def stays_inside(path: str) -> bool:
    """Whether a path stays inside its folder: it is relative, not empty, and has no drive and no `..`."""
    posix = PurePosixPath(path)
    windows = PureWindowsPath(path)
    is_absolute = posix.is_absolute() or bool(windows.drive) or bool(windows.root)
    return bool(posix.parts) and not is_absolute and ".." not in windows.parts
