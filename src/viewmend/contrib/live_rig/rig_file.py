"""A live rig's `rig.toml`: its calibration, the address of each camera, and how masks are made."""

import logging
import re
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from msgspec import Meta, Struct

from viewmend.data.errors import CaptureError
from viewmend.data.formats import is_capture_file, read_any_calibration
from viewmend.data.native_format import NativeCalibration, NativeCamera
from viewmend.utils.untrusted_input import bounded_bytes, one_of, typed

log = logging.getLogger("viewmend.live")

MAX_BYTES = 1_000_000
"""A rig's file has at most this many bytes."""
SCHEMES = ("rtsp", "rtsps", "rtp", "http", "https", "udp", "tcp", "srt")
"""Schemes of cameras' addresses; what has no scheme is a file or a device."""
DEVICE = re.compile(r"/dev/video\d+|/dev/v4l/.+")
"""Paths of V4L2 devices."""
Text = Annotated[str, Meta(min_length=1, max_length=4000)]
Milliseconds = Annotated[float, Meta(ge=1, le=10_000)]


class MaskEntry(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the masks of all cameras are made."""

    method: Annotated[str, one_of("person", "plate")] = "person"
    """The person-segmentation network, or the difference from a clean plate."""
    plates: Text = "plates/{camera}.png"
    """Method plate: path of each camera's clean plate."""
    scale: Annotated[float, Meta(ge=0.1, le=1)] = 1.0
    """Scale at which masks are computed; 0.5 takes a quarter of the time."""

    def __post_init__(self) -> None:
        if "{camera}" not in self.plates:
            raise ValueError(f"plates: expected a path with {{camera}} in it, got '{self.plates}'; add it")


class RigCameraEntry(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table `[[cameras]]` of the file; `docs/guide/live-rig.md` describes the keys."""

    name: Text
    url: Text
    format: Text | None = None
    options: dict[str, str] = {}
    clock: Annotated[str, one_of("auto", "sender", "arrival")] = "auto"
    offset_ms: Annotated[float, Meta(ge=-10_000, le=10_000)] = 0.0

    def __post_init__(self) -> None:
        scheme, separator, _ = self.url.partition("://")
        if separator and scheme not in SCHEMES:
            known = ", ".join(SCHEMES)
            raise ValueError(
                f"expected a url of {known}, a device or a file, got '{self.url[:80]}'; choose one"
            )


class RigFile(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of the file; `docs/guide/live-rig.md` describes the keys."""

    calibration: Text
    format: Text | None = None
    name: Text | None = None
    fps: Annotated[float, Meta(ge=0.1, le=240)] = 15.0
    tolerance_ms: Milliseconds | None = None
    wait_ms: Milliseconds = 200.0
    mask: MaskEntry = MaskEntry()
    cameras: Annotated[tuple[RigCameraEntry, ...], Meta(min_length=2, max_length=128)]

    def __post_init__(self) -> None:
        names = [camera.name for camera in self.cameras]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"cameras: expected different names, got {twice} more than once; rename one")


@dataclass(frozen=True)
class LiveCamera:
    """One camera: its address, its calibration, and how its masks are made."""

    calibration: NativeCamera
    """The calibration, including lens distortion, for images at the size at which they are used."""
    sent_px: tuple[int, int]
    """Width and height of the images that the camera sends; they may be reduced before use."""
    url: str
    format: str | None
    """FFmpeg's input format; None if the url determines it."""
    options: tuple[tuple[str, str], ...]
    """FFmpeg's options for this input."""
    clock: str
    """Where the times of images come from: auto, sender or arrival."""
    offset_s: float
    """The camera's delay relative to the fastest camera, which is subtracted from the times of its images."""
    mask: MaskEntry
    plate: Path
    """The clean plate, for the mask method `plate`."""

    @property
    def name(self) -> str:
        """The camera's name."""
        return self.calibration.name

    @property
    def is_file(self) -> bool:
        """Whether it is a recording that is played as if it were live."""
        return "://" not in self.url and self.format is None


@dataclass(frozen=True)
class LiveRig:
    """The content of a `rig.toml`, with the calibration that it names."""

    name: str
    cameras: tuple[LiveCamera, ...]
    fps: float
    tolerance_s: float
    """Largest difference between the time of an image and the time of the frame that uses it."""
    wait_s: float
    """How long a frame waits for late images, after the first one; the largest delay is included."""
    up: Float64[np.ndarray, "3"] | None
    """The up axis of the world; None if the calibration has none."""
    bounds_m: Float64[np.ndarray, "2 3"] | None
    """Lowest and highest corner of the subject's volume; None if the calibration has none."""


def read_rig(path: Path, max_image_size: int | None = None, fps: float | None = None) -> LiveRig:
    """Read a `rig.toml` and its calibration.

    Args:
        path: the file.
        max_image_size: the calibration is for images whose longer side is reduced to this many pixels.
        fps: overrides the file's frame rate.

    Raises:
        CaptureError: the file or the calibration cannot be read, or a camera is not in the calibration.
    """
    try:
        text = bounded_bytes(path, MAX_BYTES).decode()
        rig: RigFile = typed(tomllib.loads(text), RigFile)
    except OSError as error:
        raise CaptureError(
            f"{path}: expected a rig's TOML file, got: {error.strerror}; check the path"
        ) from None
    except UnicodeError as error:
        raise CaptureError(f"{path}: expected TOML, got something else: {error}") from None
    except RecursionError:
        raise CaptureError(f"{path}: expected TOML, got brackets that are nested too deeply") from None
    except ValueError as error:  # wrong TOML, a wrong key or value, or too large a file
        raise CaptureError(f"{path}: {str(error).rstrip('.')}") from None
    folder = path.resolve().parent
    calibration = _calibration(folder / rig.calibration, rig.format)
    known = {camera.name: camera for camera in calibration.cameras}
    unknown = [camera.name for camera in rig.cameras if camera.name not in known]
    if unknown:
        expected = f"expected cameras that {calibration.file} has ({', '.join(known)})"
        raise CaptureError(f"{path}: {expected}, got {unknown}; rename them")
    cameras = [_camera(entry, known[entry.name], rig.mask, folder, max_image_size) for entry in rig.cameras]
    # Only differences count: no image is taken to be from the future
    least_s = min(camera.offset_s for camera in cameras)
    cameras = [replace(camera, offset_s=camera.offset_s - least_s) for camera in cameras]
    rate = fps or rig.fps
    half_interval_s = 0.5 / rate
    return LiveRig(
        name=rig.name or folder.name,
        cameras=tuple(cameras),
        fps=rate,
        tolerance_s=half_interval_s if rig.tolerance_ms is None else rig.tolerance_ms / 1000,
        wait_s=rig.wait_ms / 1000 + max(camera.offset_s for camera in cameras),
        up=calibration.up,
        bounds_m=calibration.bounds_m,
    )


def _calibration(path: Path, format: str | None) -> NativeCalibration:
    """Read the calibration that a rig names.

    `path` is a folder of any format, one file of such a folder, or one file that holds a whole capture.

    Raises:
        CaptureError: there is none, or the calibration recognised in the folder is another file.
    """
    if not path.is_file() or is_capture_file(path, format):
        return read_any_calibration(path, format)
    calibration = read_any_calibration(path.parent, format)
    # The reader has chosen a file of this folder. A named file with another suffix is taken to belong to it. One with
    # the same suffix is probably another calibration, and is refused. If the rig names the format, it may still be
    # a part of the calibration, as the two files of EasyMocap are; so there is only a warning.
    is_other = calibration.file.resolve() != path.resolve() and calibration.file.suffix == path.suffix
    if is_other and format is None:
        raise CaptureError(
            f"{path}: expected the folder's calibration, which is {calibration.file.name}; name the format"
        )
    if is_other:
        log.warning(
            "%s: the calibration is read from %s, as of format '%s'", path, calibration.file.name, format
        )
    return calibration


def _camera(
    entry: RigCameraEntry,
    calibration: NativeCamera,
    mask: MaskEntry,
    folder: Path,
    max_image_size: int | None,
) -> LiveCamera:
    format = entry.format
    if format is None and DEVICE.fullmatch(entry.url):
        format = "v4l2"
    is_file = format is None and "://" not in entry.url
    return LiveCamera(
        calibration=_reduced(calibration, max_image_size),
        sent_px=(calibration.width, calibration.height),
        url=str(folder / entry.url) if is_file else entry.url,
        format=format,
        options=tuple(entry.options.items()),
        clock=entry.clock,
        offset_s=entry.offset_ms / 1000,
        mask=mask,
        plate=folder / mask.plates.replace("{camera}", entry.name),
    )


def _reduced(camera: NativeCamera, max_image_size: int | None) -> NativeCamera:
    """The calibration for images whose longer side is reduced to at most this many pixels.

    Distortion coefficients do not depend on the size.
    """
    longest = max(camera.width, camera.height)
    if max_image_size is None or longest <= max_image_size:
        return camera
    width, height = (max(1, round(side * max_image_size / longest)) for side in (camera.width, camera.height))
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return replace(camera, width=width, height=height, K=scale @ camera.K)
