"""Plain capture folders: `cameras.json` and the files that it names, as a source of frames."""

import functools
import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from viewmend.capture.camera_reader import CameraReader, stack_images
from viewmend.capture.containers import names_in
from viewmend.capture.errors import CaptureError
from viewmend.capture.formats.recognition import read_any_calibration
from viewmend.capture.images import read_rgba
from viewmend.capture.plain_format import CALIBRATION, PlainCamera, stays_inside
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND
from viewmend.geometry.rigid import rigid
from viewmend.views import MultiViewFrame


def open_capture(
    path: Path | str, cameras: Sequence[str] | None = None, kind: str | None = None, *, alpha: bool = False
) -> "PlainCapture":
    """Open a capture: a folder of any format that is read (docs/formats.md), or a plain one's `cameras.json`.

    Args:
        path: the folder, or its `cameras.json`.
        cameras: the names to use; all by default.
        kind: names the format where the folder could be of several.
        alpha: the masks are the images' own alpha.

    Raises:
        CaptureError: the calibration is wrong, files are missing, or a name is unknown (see `PlainCapture`).

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from viewmend import open_capture
        >>> from viewmend.capture.plain_writer import write_capture
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> folder = Path(tempfile.mkdtemp()) / "take"
        >>> write_capture(Studio(StudioConfig(cameras=4, frames=1, size_px=64)), folder)
        >>> capture = open_capture(folder)
        >>> len(capture.cameras), len(capture.frame_ids), capture.has_masks
        (4, 1, True)
        >>> capture.read(0).rgb.shape
        torch.Size([4, 3, 64, 64])
    """
    path = Path(path)
    folder = path.parent if path.name == CALIBRATION and path.is_file() else path
    return PlainCapture(folder, cameras, kind, alpha)


class PlainCapture:
    """A capture folder as a `CaptureSource`. Opening checks the calibration and which files exist; reading is lazy.

    A camera whose image or mask is missing at a time is absent from that frame (a gap). Images and masks are
    undistorted, K kept, and padded right and below to the largest of the frame. With `alpha` the masks are the images'
    own alpha.

    Raises:
        CaptureError: `cameras.json` is wrong; a camera never has its files; a frame has no camera; masks or depths are
            there for some of the cameras only; a file lies outside the folder; `cameras` names one that is not there.
    """

    def __init__(self, path: Path, cameras: Sequence[str] | None = None, kind: str | None = None, alpha: bool = False):
        calibration = read_any_calibration(path, kind)
        self.folder = folder = calibration.folder
        self._name = path.stem if path.is_file() else folder.resolve().name
        self._file = calibration.file
        self._plain = _select(calibration.cameras, cameras, self._file)
        if alpha:
            self._plain = tuple(_with_alpha(camera, folder, calibration.frames) for camera in self._plain)
        self._calibration = calibration
        self.has_masks = self._all_or_none("mask")
        self.has_depth = self._all_or_none("depth")
        self.present = self._find_files()
        """Whether each camera is there at each time."""
        self._readers = tuple(CameraReader(folder, camera) for camera in self._plain)
        self._cameras = pinholes(self._plain)

    @property
    def name(self) -> str:
        """The name of the folder, or of the file that was opened."""
        return self._name

    @property
    def cameras(self) -> Cameras:
        """All cameras, after undistortion, in metres."""
        return self._cameras

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """Ids of the frames in order of time."""
        return self._calibration.frames

    @property
    def fps(self) -> float | None:
        """Frames a second, None where unknown or static."""
        return self._calibration.fps

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """World up, unit length."""
        up = self._calibration.up
        return None if up is None else torch.tensor(up, dtype=torch.float32)

    @property
    def bounds(self) -> Bounds | None:
        """The volume that may hold the subject, metres."""
        corners = self._calibration.bounds_m
        return None if corners is None else Bounds(*torch.tensor(corners, dtype=torch.float32).unbind(0))

    @property
    def metres_per_unit(self) -> float:
        """Length of the folder's own unit; everything that this class gives is in metres."""
        return self._calibration.metres_per_unit

    @property
    def gaps(self) -> tuple[tuple[str, str], ...]:
        """Camera and frame id of every frame that one camera lacks."""
        missing = np.argwhere(~self.present)
        return tuple((self._plain[camera].name, self.frame_ids[time]) for camera, time in missing)

    def read(self, time: int) -> MultiViewFrame:
        """All cameras that are there at index `time` of `frame_ids`; decodes them in parallel.

        Raises:
            CaptureError: a file is unreadable or of the wrong size, or no camera's mask has any foreground.
            IndexError: `time` is not in the capture.
        """
        if not 0 <= time < len(self.frame_ids):
            raise IndexError(f"{self._file}: expected a time of 0 to {len(self.frame_ids) - 1}, got {time}")
        views = [int(view) for view in np.flatnonzero(self.present[:, time])]
        frame_id = self.frame_ids[time]
        with ThreadPoolExecutor(min(len(views), os.cpu_count() or 1)) as pool:
            images = list(pool.map(lambda view: self._readers[view].read(frame_id, time), views))
        self._say_turned()
        frame = stack_images(images, self._cameras[views], time)
        if frame.mask is not None and int(frame.mask.max()) <= FOREGROUND:
            raise CaptureError(self._no_foreground(self._plain[views[0]], frame_id, int(frame.mask.max())))
        return frame

    def straightened(
        self, camera: str, rgb: UInt8[np.ndarray, "height width 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Another image that this camera took, a clean plate perhaps, undistorted as its frames are.

        Raises:
            ValueError: there is no such camera, or the image is not of its size.
        """
        self.cameras.select([camera])
        return self._readers[self.cameras.names.index(camera)].straightened(rgb)

    def _say_turned(self) -> None:
        turned = [reader for reader in self._readers if reader.turn and not reader.turn_is_said]
        if turned:
            names = ", ".join(f"'{reader.camera.name}'" for reader in turned)
            logging.getLogger("viewmend").warning(
                f"{self.name}: EXIF says that images are to be {turned[0].turn}, but pixels are taken as they are "
                f"stored: cameras {names}; where calibration and masks are of upright images, write these upright, too "
                "(exiftran -ai)"
            )
        for reader in turned:
            reader.turn_is_said = True

    def _no_foreground(self, camera: PlainCamera, frame: str, highest: int) -> str:
        return (
            f"{self.folder / camera.file('mask', frame)}: camera '{camera.name}', frame '{frame}': expected foreground "
            f"(255) in this or another camera's mask, got no value above {highest} in any; segment the images, scale "
            f"masks of 0 and 1 by 255, or remove the frame from {self._file.name}"
        )

    def _all_or_none(self, stream: str) -> bool:
        lacking = [camera.name for camera in self._plain if getattr(camera, stream) is None]
        if lacking and len(lacking) < len(self._plain):
            raise CaptureError(
                f"{self._file}: camera '{lacking[0]}': expected '{stream}' for every camera or for none, got none for "
                f"{lacking}; add it, or leave these cameras out"
            )
        return not lacking

    def _find_files(self) -> Bool[np.ndarray, "view time"]:
        listing = functools.cache(lambda parent: names_in(self.folder / parent))  # the disk is asked once a folder

        def has(path: str) -> bool:
            if not stays_inside(path):
                raise CaptureError(f"{self.folder}: expected a file inside the folder, got {path}; rename the frame")
            parent, name = os.path.split(path)
            return name in listing(parent)

        def has_all(camera: PlainCamera, frame: str) -> bool:
            return all(has(camera.file(stream, frame)) for stream in camera.streams)

        present = np.array([[has_all(camera, frame) for frame in self.frame_ids] for camera in self._plain], bool)
        for camera, row in zip(self._plain, present, strict=True):
            if not row.any():
                raise CaptureError(_never(self._file, self.folder, camera, self.frame_ids, has))
        for frame, column in zip(self.frame_ids, present.T, strict=True):
            if not column.any():
                example = self.folder / self._plain[0].file(self._plain[0].streams[0], frame)
                raise CaptureError(
                    f"{example}: camera '{self._plain[0].name}', frame '{frame}': expected this file or another "
                    f"camera's, got none of any camera; add them, or remove the frame from {self._file}"
                )
        return present


def _select(cameras: tuple[PlainCamera, ...], names: Sequence[str] | None, file: Path) -> tuple[PlainCamera, ...]:
    if names is None:
        return cameras
    by_name = {camera.name: camera for camera in cameras}
    unknown = [name for name in names if name not in by_name]
    if unknown or not names or len(set(names)) < len(names):
        raise CaptureError(f"{file}: expected different cameras among {list(by_name)}, got {list(names)}; choose again")
    return tuple(by_name[name] for name in names)


def _with_alpha(camera: PlainCamera, folder: Path, frames: Sequence[str]) -> PlainCamera:
    """The camera with its images as masks; CaptureError where the first that is there has no alpha."""
    if camera.image is None:
        raise CaptureError(
            f"{folder}: camera '{camera.name}': expected images with alpha, got a video; use another --method"
        )
    for file in (folder / camera.file("image", frame) for frame in frames):
        if file.is_file():
            read_rgba(file, f"{file}: camera '{camera.name}'")
            break
    return replace(camera, mask=camera.image)


def _never(file: Path, folder: Path, camera: PlainCamera, frames: Sequence[str], has: Callable[[str], bool]) -> str:
    """What to say of a camera that is at no time there."""
    for stream in camera.streams:
        if not any(has(camera.file(stream, frame)) for frame in frames):
            lacking, what = camera.file(stream, frames[0]), f"the camera's {stream} at one frame or more"
            break
    else:
        lacking = camera.file(camera.streams[0], frames[0])
        what = f"{' and '.join(camera.streams)} of the camera at the same frame"
    return (
        f"{folder / lacking}: camera '{camera.name}', frame '{frames[0]}': expected {what}, found at none of "
        f"{len(frames)}; correct the paths in {file}, or leave the camera out"
    )


def pinholes(cameras: Sequence[PlainCamera]) -> Cameras:
    """The cameras after undistortion, in metres."""
    R = torch.tensor(np.stack([camera.R for camera in cameras]))
    t = torch.tensor(np.stack([camera.t_m for camera in cameras]))
    return Cameras(
        names=tuple(camera.name for camera in cameras),
        K=torch.tensor(np.stack([camera.K for camera in cameras])).float(),
        camera_from_world=rigid(R, t).float(),
        size_px=torch.tensor([[camera.width, camera.height] for camera in cameras]),
    )
