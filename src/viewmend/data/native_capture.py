"""Capture folders as sources of frames: `open_capture`, and the readers of their images, masks and depth."""

import functools
import logging
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8

from viewmend.data.containers import names_in
from viewmend.data.errors import CaptureError, Issue
from viewmend.data.formats import read_any_calibration
from viewmend.data.images import (
    MAX_LABELS,
    RUN_LENGTH_SUFFIX,
    Orientation,
    exif_orientation,
    read_alpha,
    read_depth,
    read_mask,
    read_rgb,
    read_run_lengths,
    to_mask,
    uses_alpha,
)
from viewmend.data.native_format import (
    CALIBRATION,
    FILE_KINDS,
    FileKind,
    NativeCalibration,
    NativeCamera,
    stays_inside,
)
from viewmend.data.source import CaptureSource, CaptureWrapper
from viewmend.data.video_clock import ABSENT, Track, TrackKind, VideoClock, match_tracks, video_track
from viewmend.data.videos import VideoFile, is_video, video_properties
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.rigid import rigid
from viewmend.types import MultiViewFrame

OPAQUE = 250
"""Masks of which none reaches this value hold labels if their values are few."""
LEAST_LABELLED = 0.005
"""A single mask holds labels if at least this share of it has one low value, and the rest is 0."""
ONE_LEVEL, LEVEL_SPREAD = 0.8, 0.25
"""Masks without an opaque pixel hold one label if the first share of their foreground differs from its median by at
most the second: edges and JPEG add values."""


def open_capture(
    path: Path | str, cameras: Sequence[str] | None = None, format: str | None = None, *, alpha: bool = False
) -> "NativeCapture":
    """Open a capture folder of any supported format (docs/formats.md).

    Args:
        path: the folder, or the file that stands for it, such as `cameras.json`.
        cameras: names of the cameras to use; all by default.
        format: name of the format; by default it is recognised.
        alpha: use the alpha channel of the images as masks.

    Raises:
        CaptureError: the calibration is invalid, files are missing, or a camera is unknown (see `NativeCapture`).

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from viewmend import open_capture
        >>> from viewmend.data.native_writer import write_capture
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> folder = Path(tempfile.mkdtemp()) / "take"
        >>> _ = write_capture(Studio(StudioConfig(cameras=4, frames=1, size_px=64)), folder)
        >>> capture = open_capture(folder)
        >>> len(capture.cameras), len(capture.frame_ids), capture.has_masks
        (4, 1, True)
        >>> capture.read(0).rgb.shape
        torch.Size([4, 3, 64, 64])
    """
    capture = NativeCapture(Path(path), cameras, format, alpha)
    for issue in capture.issues:
        logging.getLogger("viewmend").warning("%s: %s", capture.name, issue.text)
    return capture


def origin_of(source: CaptureSource) -> Float64[np.ndarray, "3"]:
    """The coordinates, in a capture's own files, of the origin that its cameras and bounds refer to; metres."""
    while isinstance(source, CaptureWrapper):
        source = source.source
    return source.origin_m if isinstance(source, NativeCapture) else np.zeros(3)


class NativeCapture:
    """A capture folder as a `CaptureSource`. Opening checks the calibration and which files exist; reading is lazy.

    A camera whose image or mask is missing is absent from that frame (a gap). Films are matched by the times of their
    frames. Images and masks are undistorted to pinhole images with the same K, and padded right and below to the
    largest of the frame. The arguments are those of `open_capture`, which logs `issues`. CaptureError if `cameras.json`
    is invalid; a camera has no files in any frame, or a frame has no camera; only some cameras have masks or depth; a
    file lies outside the folder; or a camera name is unknown.
    """

    def __init__(
        self, path: Path, cameras: Sequence[str] | None = None, format: str | None = None, alpha: bool = False
    ):
        path = path.parent if path.name == CALIBRATION and path.is_file() else path
        calibration = read_any_calibration(path, format)
        self.folder = folder = calibration.folder
        self.name = path.stem if path.is_file() else folder.resolve().name
        """Name of the folder, or of the file that was opened."""
        self._file = calibration.file
        self._entries = _select(calibration.cameras, cameras, self._file)
        if alpha:
            self._entries = tuple(_with_alpha(camera, folder, calibration.frames) for camera in self._entries)
        self.cameras = pinhole_cameras(self._entries)
        self.clock = read_clock(calibration)
        """When the films' frames were taken; None for a capture of images."""
        self.frame_ids = calibration.frames[: None if self.clock is None else len(self.clock.times_s)]
        self._listed = len(calibration.frames)
        self.fps = calibration.fps
        self.up = None if calibration.up is None else torch.tensor(calibration.up, dtype=torch.float32)
        corners = calibration.bounds_m
        self.bounds = None if corners is None else Bounds(*torch.tensor(corners, dtype=torch.float32).unbind(0))
        self.origin_m = calibration.origin_m
        """The folder's coordinates of this class's origin, 64 bits; 0 unless the cameras are far from the folder's."""
        self.metres_per_unit = calibration.metres_per_unit
        """Length of the folder's own unit. All values of this class are in metres."""
        self.has_masks = self._all_or_none("mask")
        self.has_depth = self._all_or_none("depth")
        self._readers = tuple(CameraReader(folder, camera, self.frame_ids, self.clock) for camera in self._entries)
        self.present = self._find_files()
        """Whether each camera has its files in each frame."""
        self._masks_are_opaque = False
        self._warned_of_labels: set[str] = set()

    @property
    def gaps(self) -> tuple[tuple[str, str], ...]:
        """Camera name and frame id of each missing image."""
        missing = np.argwhere(~self.present)
        return tuple((self._entries[camera].name, self.frame_ids[time]) for camera, time in missing)

    @property
    def issues(self) -> tuple[Issue, ...]:
        """Films whose times differ from the others'."""
        if self.clock is None:
            return ()
        listed, found = self._listed, len(self.frame_ids)
        text = (
            f"expected {listed} frames as listed, got videos with {found} common times; the other frames are left out"
        )
        return ((Issue(text),) if found < listed else ()) + self.clock.issues(self.cameras.names)

    def read(self, time: int) -> MultiViewFrame:
        """Read all cameras of the frame at index `time` of `frame_ids`, in parallel.

        A camera whose film is damaged at this time is absent. Masks are 0 in a frame without a subject. CaptureError if
        a file is unreadable or has the wrong size; IndexError if `time` is not in the capture.
        """
        if not 0 <= time < len(self.frame_ids):
            raise IndexError(f"{self._file}: expected a frame index of 0 to {len(self.frame_ids) - 1}, got {time}")
        views = [int(view) for view in np.flatnonzero(self.present[:, time])]
        frame_id = self.frame_ids[time]
        with ThreadPoolExecutor(min(len(views), os.cpu_count() or 1)) as pool:
            images = list(pool.map(lambda view: self._readers[view].read(time), views))
        self._warn_of_rotation()
        views = [view for view, image in zip(views, images, strict=True) if image is not None]
        if not views:
            raise CaptureError(
                f"{self.folder}: frame '{frame_id}': expected a readable frame in a video, got none; leave it out"
            )
        frame = stack_images([image for image in images if image is not None], self.cameras[views], time)
        if frame.mask is not None:
            frame = self._from_labels(frame)
        if frame.mask is not None and not frame.has_subject:  # what remains is noise, as of a compressed video
            frame = replace(frame, mask=torch.zeros_like(frame.mask))
        return frame

    def undistort(self, camera: str, rgb: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """Undistort another image of this camera, such as a clean plate; ValueError for another camera or size."""
        self.cameras.select([camera])
        return self._readers[self.cameras.names.index(camera)].undistort(rgb)

    def _from_labels(self, frame: MultiViewFrame) -> MultiViewFrame:
        """The frame with labels in its masks as 255.

        Masks hold labels if no mask so far had an opaque pixel, and values are few or nearly all about one level. So
        does one alone of 0 and one low value, unless that is rare: it may be nearly transparent.
        """
        assert frame.mask is not None
        highest = frame.mask.flatten(1).amax(1)
        self._masks_are_opaque = self._masks_are_opaque or int(highest.max()) >= OPAQUE
        if self._masks_are_opaque:
            size = frame.mask[0].numel()
            least, most = LEAST_LABELLED * size, (1 - LEAST_LABELLED) * size
            low = [(view, top) for view, top in enumerate(highest.tolist()) if top < OPAQUE]
            inside = {view: int(frame.mask[view].count_nonzero()) for view, _ in low}
            labelled = {view: int((frame.mask[view] == top).sum()) for view, top in low}
            there = [view for view, _ in low if least < inside[view] < most]
            views = [view for view in there if labelled[view] >= max(least, ONE_LEVEL * inside[view])]
            whose = f"masks of {', '.join(frame.cameras.names[view] for view in views)}"
        else:
            few = len(torch.bincount(frame.mask.flatten(), minlength=256).nonzero()) <= MAX_LABELS
            values = frame.mask[frame.mask > int(highest.max()) // 4].float()
            level = float(values.median()) if len(values) else 0.0
            if not few and float(((values - level).abs() <= LEVEL_SPREAD * level).float().mean()) >= ONE_LEVEL:
                scaled = (frame.mask * (255 / level)).round().clamp(max=255).to(torch.uint8)
                self._warn_of_labels("masks", f"they are scaled, with {level:.0f} as opaque", int(highest.max()))
                return replace(frame, mask=scaled)
            views, whose = (list(range(len(highest))) if few and bool(highest.any()) else []), "masks"
        if not views:
            return frame
        self._warn_of_labels(whose, "they are read as labels, with 0 as background", int(highest[views].max()))
        mask = frame.mask.clone()
        mask[views] = 255 * (mask[views] > 0).to(torch.uint8)
        return replace(frame, mask=mask)

    def _warn_of_labels(self, whose: str, what: str, above: int) -> None:
        """Say once how these masks are read, which have no values above this."""
        if whose not in self._warned_of_labels:
            self._warned_of_labels.add(whose)
            logging.getLogger("viewmend").warning(f"{self.name}: {whose} have no values above {above}: {what}")

    def _warn_of_rotation(self) -> None:
        if rotated := [reader for reader in self._readers if reader.rotation and not reader.warned]:
            names = ", ".join(f"'{reader.camera.name}'" for reader in rotated)
            logging.getLogger("viewmend").warning(
                f"{self.name}: EXIF says that images should be {rotated[0].rotation}, but pixels are used as stored "
                f"(cameras {names}); if calibration and masks are upright, make the images upright too (exiftran -ai)"
            )
        for reader in rotated:
            reader.warned = True

    def _all_or_none(self, kind: FileKind) -> bool:
        missing = [f"camera '{camera.name}'" for camera in self._entries if getattr(camera, kind) is None]
        if missing and len(missing) < len(self._entries):
            expected, got = f"'{kind}' for every camera or for none", f"none for {', '.join(missing)}"
            raise CaptureError(f"{self._file}: expected {expected}, got {got}; add it, or leave these cameras out")
        return not missing

    def _find_files(self) -> Bool[np.ndarray, "view time"]:
        listing = functools.cache(lambda parent: names_in(self.folder / parent))  # each folder is listed once

        def exists(path: str) -> bool:
            if not stays_inside(path):
                raise CaptureError(f"{self.folder}: expected a file inside the folder, got {path}; rename the frame")
            parent, name = os.path.split(path)
            return name in listing(parent)

        times = range(len(self.frame_ids))
        present = np.array([[reader.has(time, exists) for time in times] for reader in self._readers], bool)
        for camera, row in zip(self._entries, present, strict=True):
            if not row.any():
                absent: list[FileKind] = [
                    k for k in camera.file_kinds if not any(exists(camera.file(k, f)) for f in self.frame_ids)
                ]
                wanted = f"{' and '.join(camera.file_kinds)} of the camera in the same frame"
                wanted = f"the camera's {absent[0]} in at least one frame" if absent else wanted
                path, frame = camera.file((*absent, *camera.file_kinds)[0], self.frame_ids[0]), self.frame_ids[0]
                where = f"{self.folder / path}: camera '{camera.name}', frame '{frame}'"
                got = f"found none in {len(self.frame_ids)} frames"
                next_step = f"correct the paths in {self._file}" if self._file.name == CALIBRATION else "add them"
                raise CaptureError(f"{where}: expected {wanted}, {got}; {next_step}, or leave the camera out")
        for time in np.flatnonzero(~present.any(0)).tolist():
            raise CaptureError(self._without_cameras(time, exists))
        return present

    def _without_cameras(self, time: int, exists: Callable[[str], bool]) -> str:
        """What is wrong with a frame in which no camera has all of its files, and what to do about it."""
        kinds: list[FileKind] = [k for k in FILE_KINDS if any(k in camera.file_kinds for camera in self._entries)]
        own = {kind: [reader for reader in self._readers if kind in reader.camera.file_kinds] for kind in kinds}
        absent: list[FileKind] = [k for k in kinds if all(reader.lacks(k, time, exists) for reader in own[k])]
        first: FileKind = (absent or kinds)[0]
        _, where = own[first][0].locate(first, time)
        wanted = "this file or another camera's" if absent else f"{' and '.join(kinds)} of the same camera"
        got = f"no {' and no '.join(absent)} of any camera" if absent else "no camera that has all"
        steps = ["add them, black ones if there is no subject" if absent == ["mask"] else "add them"]
        if self._file.name == CALIBRATION and self.clock is None:
            steps.append(f"remove the frame from {self._file}")
        elif self._file.name != CALIBRATION and "image" in kinds and "image" not in absent:
            steps.append("remove the frame's images")
        return f"{where}: expected {wanted}, got {got}; {', or '.join(steps)}"


def _select(cameras: tuple[NativeCamera, ...], names: Sequence[str] | None, file: Path) -> tuple[NativeCamera, ...]:
    if names is None:
        return cameras
    by_name = {camera.name: camera for camera in cameras}
    unknown = [name for name in names if name not in by_name]
    if unknown or not names or len(set(names)) < len(names):
        raise CaptureError(
            f"{file}: expected cameras among {list(by_name)}, each once, got {list(names)}; choose again"
        )
    return tuple(by_name[name] for name in names)


def _with_alpha(camera: NativeCamera, folder: Path, frames: Sequence[str]) -> NativeCamera:
    """The camera with its images as masks; raises a CaptureError if none of its images has alpha."""
    if camera.image is None:
        where = f"{folder}: camera '{camera.name}'"
        raise CaptureError(f"{where}: expected images with alpha, got a video; use another --method")
    files = [folder / camera.file("image", frame) for frame in frames]
    if not any(uses_alpha(file) for file in files) and (file := next(filter(Path.is_file, files), None)):
        read_alpha(file, f"{file}: camera '{camera.name}'")
    return replace(camera, mask=camera.image)


def pinhole_cameras(cameras: Sequence[NativeCamera]) -> Cameras:
    """The cameras after undistortion, in metres."""
    R = torch.tensor(np.stack([camera.R for camera in cameras]))
    t = torch.tensor(np.stack([camera.t_m for camera in cameras]))
    return Cameras(
        names=tuple(camera.name for camera in cameras),
        K=torch.tensor(np.stack([camera.K for camera in cameras])).float(),
        camera_from_world=rigid(R, t).float(),
        size_px=torch.tensor([[camera.width, camera.height] for camera in cameras]),
    )


def read_clock(calibration: NativeCalibration) -> VideoClock | None:
    """Match the films of a capture by time; None if it has no films and no offsets.

    Numbered images count as films with the capture's frame rate, or else that of its first film. CaptureError if a film
    cannot be decoded, no two show the same time, or offsets lack a frame rate.
    """
    cameras, folder = calibration.cameras, calibration.folder
    files = {(c.name, kind): path for c in cameras for kind, path in (("images", c.video), ("masks", c.mask)) if path}
    films = {key: folder / path for key, path in files.items() if is_video(path) and (folder / path).is_file()}
    if not films and not any(camera.offset_ms for camera in cameras):
        return None
    fps = calibration.fps or next((video_properties(path).fps for path in films.values()), None)
    if fps is None:
        raise CaptureError(f"{calibration.file}: expected fps, which offset_ms needs, got none; add it")
    numbers_s = np.arange(len(calibration.frames)) / fps
    tracks = []
    for camera in cameras:
        offset_s = camera.offset_ms / 1000
        for kind in ("images", "masks"):
            if (path := films.get((camera.name, kind))) is not None:
                tracks.append(video_track(camera.name, kind, path, offset_s))
            elif kind == "images":  # numbered masks follow their images
                tracks.append(Track(camera.name, kind, numbers_s, fps, offset_s))
    try:
        return match_tracks(tracks)
    except ValueError as error:
        raise CaptureError(f"{calibration.file}: {error}") from None


@dataclass(frozen=True)
class CameraImages:
    """The images of one camera in one frame."""

    rgb: UInt8[np.ndarray, "height width 3"]
    mask: UInt8[np.ndarray, "height width"] | None
    depth: Float32[np.ndarray, "height width"] | None
    """z-depth in metres; 0 where unknown."""


class CameraReader:
    """Reads the files of one camera. Keeps its videos open and its undistortion map. Thread-safe."""

    def __init__(self, folder: Path, camera: NativeCamera, frames: Sequence[str], clock: VideoClock | None):
        self.camera = camera
        self.rotation: Orientation | None = None
        """How EXIF asks viewers to turn the camera's images, by the first one that was read."""
        self._rotation_is_known = False
        self.warned = False
        """Whether the user was warned of the rotation."""
        self._folder = folder
        self._frames = frames
        self._undistortion = Undistortion(camera)
        paths = (camera.video, camera.mask if camera.mask and is_video(camera.mask) else None)
        self._video, self._mask_video = (VideoFile(folder / path) if path else None for path in paths)
        curves = None if camera.colour is None else np.vander(np.arange(256.0), 3) @ camera.colour.T
        self._curves = None if curves is None else np.rint(curves.clip(0, 255)).astype(np.uint8)[None]
        numbers = np.arange(len(frames))
        own = {} if clock is None else clock.frames
        images = own.get((camera.name, "images"), numbers)
        masks = images if camera.video is None or self._has_mask_per_image() else numbers
        self._index: dict[TrackKind, np.ndarray] = {"images": images, "masks": own.get((camera.name, "masks"), masks)}

    def _has_mask_per_image(self) -> bool:
        """Whether numbered masks are those of the film's own frames, of which some of the capture's are missing."""
        if self._video is None or self.camera.mask is None or self._mask_video is not None:
            return False
        count = sum((self._folder / self.camera.file("mask", frame)).is_file() for frame in self._frames)
        return count < len(self._frames) and count == video_properties(self._video.path).frames

    def has(self, time: int, exists: Callable[[str], bool]) -> bool:
        """Whether the camera has all of its files in the frame at index `time`; `exists` looks a path up."""
        return not any(self.lacks(kind, time, exists) for kind in self.camera.file_kinds)

    def lacks(self, kind: FileKind, time: int, exists: Callable[[str], bool]) -> bool:
        """Whether the camera has no file of this kind in the frame, as `has`."""
        number = self._index["masks" if kind == "mask" else "images"][time]
        return bool(number == ABSENT) or not exists(self.camera.file(kind, self._file_id(kind, time)))

    def read(self, time: int) -> CameraImages | None:
        """Read and undistort the images of the frame at index `time`, in which the camera is present.

        None if its film is damaged there. CaptureError if a file is missing, unreadable, or not of the camera's size.
        """
        camera = self.camera
        path, where = self.locate("video" if camera.video else "image", time)
        rgb = self._video.read(int(self._index["images"][time]), where) if self._video else read_rgb(path, where)
        if rgb is None:
            return None
        if not self._rotation_is_known:
            self.rotation = None if self._video else exif_orientation(path)
            self._rotation_is_known = True
        self._check_size(rgb, where, self.rotation)
        mask, depth = None, None
        if camera.mask:
            path, where = self.locate("mask", time)
            if (mask := self._read_mask(path, where, time)) is None:
                return None
            mask = self._as_stored(mask, path)
            self._check_mask_size(mask, where)
        if camera.depth:
            path, where = self.locate("depth", time)
            depth = read_depth(path, where)
            self._check_size(depth, where)
        return self._undistortion.apply(CameraImages(self._correct_colours(rgb), mask, depth))

    def undistort(self, rgb: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """Correct colours and distortion of another image of this camera, such as a clean plate."""
        return self._undistortion.apply(CameraImages(self._correct_colours(rgb), None, None)).rgb

    def _correct_colours(self, rgb: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
        return rgb if self._curves is None else cv2.LUT(rgb, self._curves)

    def _read_mask(self, path: Path, where: str, time: int) -> UInt8[np.ndarray, "height width"] | None:
        if self._mask_video:
            if (image := self._mask_video.read(int(self._index["masks"][time]), where)) is None:
                return None
            mask = to_mask(image)
        elif self.camera.mask == self.camera.image:
            mask = read_alpha(path, where)
        elif path.suffix == RUN_LENGTH_SUFFIX:
            mask = read_run_lengths(path, where, (self.camera.height, self.camera.width))
        else:
            mask = read_mask(path, where)
        return 255 * (mask > 0).astype(np.uint8) if self.camera.mask_labels else mask

    def _file_id(self, kind: FileKind, time: int) -> str:
        """The frame id in the path of a file that belongs to the frame at index `time`."""
        if (self._mask_video if kind == "mask" else self._video) is not None:  # one file for all frames
            return self._frames[time]
        return self._frames[int(self._index["masks" if kind == "mask" else "images"][time])]

    def locate(self, kind: FileKind, time: int) -> tuple[Path, str]:
        """Path of the camera's file of this kind in the frame at index `time`, and how errors name it."""
        path = self._folder / self.camera.file(kind, self._file_id(kind, time))
        return path, f"{path}: camera '{self.camera.name}', frame '{self._frames[time]}'"

    def _as_stored(self, mask: UInt8[np.ndarray, "rows columns"], path: Path) -> UInt8[np.ndarray, "height width"]:
        """A mask that lies as its image: another tool may have turned it as EXIF says, or not have turned it.

        A mask of the transposed size is turned back as the image's own EXIF says, or else as the mask's says.
        """
        camera = self.camera
        if mask.shape != (camera.width, camera.height) or camera.width == camera.height:
            return mask
        if self.rotation is not None and self.rotation.transposed:
            return self.rotation.undo(mask)
        own = None if self._mask_video or path.suffix == RUN_LENGTH_SUFFIX else exif_orientation(path)
        return mask if own is None or not own.transposed else own.apply(mask)

    def _check_mask_size(self, mask: UInt8[np.ndarray, "rows columns"], where: str) -> None:
        if mask.shape == (self.camera.width, self.camera.height) and self.camera.width != self.camera.height:
            expected = f"a mask of {self.camera.width} x {self.camera.height} pixels as its image"
            got = f"{mask.shape[1]} x {mask.shape[0]}: the mask is turned by 90 degrees and the image is not"
            raise CaptureError(
                f"{where}: expected {expected}, got {got} (neither has EXIF that says how); turn the mask"
            )
        self._check_size(mask, where)

    def _check_size(self, image: np.ndarray, where: str, rotation: Orientation | None = None) -> None:
        height, width = image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            advice = "correct width, height and K in the calibration, or replace the file"
            if rotation:
                advice = f"EXIF says that it should be {rotation}: make it upright (exiftran -ai), or {advice}"
            expected = f"{self.camera.width} x {self.camera.height} pixels as in the calibration"
            raise CaptureError(f"{where}: expected {expected}, got {width} x {height}; {advice}")


class Undistortion:
    """Removes the lens distortion of one camera. Computes its map at first use. Thread-safe."""

    def __init__(self, camera: NativeCamera):
        self._camera = camera
        self._lock = threading.Lock()
        self._maps: tuple[np.ndarray, np.ndarray] | None = None

    def apply(self, images: CameraImages) -> CameraImages:
        """Undistort images to the pinhole camera with the same K and size; returns them if there is no distortion.

        Pixels that lie outside the distorted image (corners, with pincushion distortion) repeat its border, so that
        the mask of a subject cut off by the border continues and does not carve the hull. Depth there is 0, unknown.
        """
        camera = self._camera
        if not camera.dist.any():
            return images
        with self._lock:
            if self._maps is None:
                K = camera.K.copy()
                K[:2, 2] -= 0.5  # in OpenCV the centre of the first pixel is at 0
                size, fixed = (camera.width, camera.height), cv2.CV_16SC2  # 1/32 pixel, three times as fast as floats
                first, second = cv2.initUndistortRectifyMap(K, camera.dist, None, K, size, fixed)  # pyright: ignore
                self._maps = first, second
        smooth = functools.partial(cv2.remap, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        rgb, mask, depth = smooth(images.rgb, *self._maps), images.mask, images.depth
        if mask is not None:
            mask = smooth(mask, *self._maps)
        if depth is not None:  # nearest: interpolated depths would be wrong at edges
            depth = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
        return CameraImages(rgb, mask, depth)


def stack_images(images: Sequence[CameraImages], cameras: Cameras, time: int) -> MultiViewFrame:
    """Stack the images of several cameras, padded right and below; masks and depth only if all cameras have them."""
    width, height = cameras.max_size_px
    masks, depths = (all(getattr(image, key) is not None for image in images) for key in ("mask", "depth"))
    rgb = torch.zeros(len(images), 3, height, width, dtype=torch.uint8)
    mask = torch.zeros(len(images), height, width, dtype=torch.uint8) if masks else None
    depth = torch.zeros(len(images), height, width) if depths else None
    for view, image in enumerate(images):
        h, w = image.rgb.shape[:2]
        rgb[view, :, :h, :w] = torch.from_numpy(image.rgb).permute(2, 0, 1)
        if mask is not None:
            mask[view, :h, :w] = torch.from_numpy(image.mask)
        if depth is not None:
            depth[view, :h, :w] = torch.from_numpy(image.depth)
    return MultiViewFrame(cameras, rgb, mask, time, depth)
