"""Capture folders as sources of frames: `open_capture` and `CaptureFolder`."""

import functools
import logging
import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8

from viewmend.data.camera_images import stack_images
from viewmend.data.camera_reader import CameraReader
from viewmend.data.containers import names_in
from viewmend.data.errors import CaptureError, Issue
from viewmend.data.formats import read_any_calibration
from viewmend.data.formats.files import frame_order
from viewmend.data.images import read_alpha, uses_alpha
from viewmend.data.label_masks import LabelMasks
from viewmend.data.native_format import (
    CALIBRATION,
    FILE_KINDS,
    FileKind,
    NativeCalibration,
    NativeCamera,
    stays_inside,
)
from viewmend.data.source import CaptureSource, CaptureWrapper
from viewmend.data.video_clock import RATE_TOLERANCE, Track, VideoClock, match_tracks, video_track
from viewmend.data.videos import is_video, video_properties
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, check_names
from viewmend.geometry.rigid import rigid
from viewmend.types import MultiViewFrame

MaskSource = Literal["files", "alpha", "none"]
"""Where a capture's masks come from: its own files, the alpha channel of its images, or nowhere."""


def open_capture(
    path: Path | str,
    cameras: Sequence[str] | None = None,
    format: str | None = None,
    *,
    masks: MaskSource = "files",
) -> "CaptureFolder":
    """Open a capture folder of any supported format (docs/formats.md).

    Args:
        path: the folder, or the file that stands for it, such as `cameras.json`.
        cameras: names of the cameras to use; all by default.
        format: name of the format; by default it is recognised.
        masks: which masks to use: the capture's own files, the alpha channel of its images, or none.

    Raises:
        CaptureError: the calibration is invalid, files are missing, or a camera is unknown (see
            `CaptureFolder`).

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
    capture = CaptureFolder(Path(path).expanduser(), cameras, format, masks)
    for issue in capture.issues:
        logging.getLogger("viewmend").warning("%s: %s", capture.name, issue.text)
    return capture


def origin_of(source: CaptureSource) -> Float64[np.ndarray, "3"]:
    """The origin of a source's cameras and bounds, in the coordinates of its own files, metres.

    It is 0 unless a `CaptureFolder` moved the origin (`CaptureFolder.origin_m`).
    """
    while isinstance(source, CaptureWrapper):
        source = source.source
    return source.origin_m if isinstance(source, CaptureFolder) else np.zeros(3)


class CaptureFolder:
    """A capture folder as a `CaptureSource`. Opening checks the calibration and which files exist; reading is lazy.

    A camera that lacks one of its files in a frame (image, mask or depth) is absent from that frame (a gap).
    Videos are matched by the times of their frames. Images and masks are undistorted to pinhole images with the
    same K, and padded at the right and bottom to the size of the largest image. The arguments are
    those of `open_capture`, which logs `issues`.

    Raises:
        CaptureError: one of these: `cameras.json` is invalid; a camera name is unknown; some camera never
            has all of its files in one frame; in some frame, no camera has all of its files; only some
            cameras have depth; only one camera has masks; a file lies outside the folder.
    """

    def __init__(
        self,
        path: Path,
        cameras: Sequence[str] | None = None,
        format: str | None = None,
        masks: MaskSource = "files",
    ):
        calibration = read_any_calibration(path, format)
        chosen = _select(calibration.cameras, cameras, calibration.file)
        calibration = with_frames(calibration, chosen)
        folder = calibration.folder
        self.folder = folder
        is_file = path.is_file() and path.name != CALIBRATION
        self.name = path.stem if is_file else folder.resolve().name
        """Name of the folder, or of the file that was opened."""
        self._file = calibration.file
        selected = _with_masks_from(masks, chosen, calibration)
        self.unmasked = _without_masks(selected)
        """Cameras that are not used, because they have no masks and others do."""
        self._native_cameras = tuple(camera for camera in selected if camera.name not in self.unmasked)
        """The cameras in use, before undistortion."""
        self.cameras = pinhole_cameras(self._native_cameras)
        self.clock = read_clock(replace(calibration, cameras=self._native_cameras))
        """When the frames were taken; None for a capture of images without offsets (see `read_clock`)."""
        self.fps = calibration.fps
        if self.clock is not None:
            self.fps = _choose_fps(calibration.fps, self.clock)
            if calibration.file.name != CALIBRATION:
                frames = _ids_in_use(calibration, self._native_cameras, self.clock)
                calibration = replace(calibration, frames=frames)
        self._listed = calibration.frames

        # With a clock, the frame id at index i stands for the clock's time i; surplus ids are not used
        num_frames = len(self._listed) if self.clock is None else len(self.clock.times_s)
        self.frame_ids = calibration.frames[:num_frames]
        self.up = None if calibration.up is None else torch.tensor(calibration.up, dtype=torch.float32)
        corners = calibration.bounds_m
        self.bounds = (
            None if corners is None else Bounds(*torch.tensor(corners, dtype=torch.float32).unbind(0))
        )
        self.origin_m = calibration.origin_m
        """The origin of `cameras` and `bounds`, in the coordinates of the folder's files, metres, 64 bits. It
        is a point near the cameras if they are too far from the files' origin for 32 bits, else 0."""
        self.metres_per_unit = calibration.metres_per_unit
        """Length of the folder's own unit. All values of this class are in metres."""
        self.has_masks = self._cameras_have("mask")
        self.has_depth = self._cameras_have("depth")
        self._readers = tuple(
            CameraReader(folder, camera, calibration.frames, self.clock) for camera in self._native_cameras
        )
        self.present = self._find_files()
        """Whether each camera has its files in each frame."""
        self._label_masks = LabelMasks()
        self._logged_conversions: set[str] = set()

    @property
    def gaps(self) -> tuple[tuple[str, str], ...]:
        """Camera name and frame id, for each frame in which a camera lacks one of its files."""
        missing = np.argwhere(~self.present)
        return tuple((self.cameras.names[camera], self.frame_ids[time]) for camera, time in missing)

    @property
    def issues(self) -> tuple[Issue, ...]:
        """Cameras without masks, and videos whose times differ from the others'."""
        issues: list[Issue] = []
        if self.unmasked:
            names = ", ".join(f"'{name}'" for name in self.unmasked)
            unused = f"cameras {names} are" if len(self.unmasked) > 1 else f"camera {names} is"
            issues.append(
                Issue(f"{unused} not used: expected masks, which the other cameras have, got none; add them")
            )
        if self.clock is not None:
            found = len(self.frame_ids)
            if found < len(self._listed):
                expected = f"{len(self._listed)} frames as listed"
                got = f"videos with {found} common times"
                issues.append(Issue(f"expected {expected}, got {got}; the other frames are left out"))
            issues.extend(self.clock.issues(self.cameras.names))
        return tuple(issues)

    def read(self, time: int) -> MultiViewFrame:
        """Read all cameras of the frame at index `time` of `frame_ids`, in parallel.

        A camera whose video is damaged at this time is absent. Masks are 0 in a frame without a
        subject. CaptureError if a file is unreadable or has the wrong size; IndexError if `time` is
        not in the capture.
        """
        if not 0 <= time < len(self.frame_ids):
            raise IndexError(
                f"{self._file}: expected a frame index of 0 to {len(self.frame_ids) - 1}, got {time}"
            )
        views = [int(view) for view in np.flatnonzero(self.present[:, time])]
        frame_id = self.frame_ids[time]
        with ThreadPoolExecutor(min(len(views), os.cpu_count() or 1)) as pool:
            results = list(pool.map(lambda view: self._readers[view].read(time), views))
        self._warn_about_rotation()
        by_view = {view: images for view, images in zip(views, results, strict=True) if images is not None}
        if not by_view:
            raise CaptureError(
                f"{self.folder}: frame '{frame_id}': expected a readable frame in a video, got none; leave it out"
            )
        cameras = self.cameras[list(by_view)]
        frame = stack_images(list(by_view.values()), cameras, time)
        if frame.mask is not None:
            frame = self._with_opaque_masks(frame)
        # A mask without a subject may still contain noise, such as that of a compressed video
        if frame.mask is not None and not frame.has_subject:
            frame = replace(frame, mask=torch.zeros_like(frame.mask))
        return frame

    def undistort(
        self, camera: str, rgb: UInt8[np.ndarray, "height width 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Undistort another image of this camera, such as a clean plate; ValueError for another camera or size."""
        self.cameras.select([camera])  # raises the ValueError for an unknown name
        return self._readers[self.cameras.names.index(camera)].undistort(rgb)

    def _with_opaque_masks(self, frame: MultiViewFrame) -> MultiViewFrame:
        """The frame with its foreground at 255: masks with class labels or low grey levels are converted.

        A warning names the cameras; it is logged once for the same cameras.
        """
        assert frame.mask is not None
        converted = self._label_masks.convert(frame.mask)
        if converted is None:
            return frame
        if converted.views is None:  # those of all cameras
            masks = "masks"
        else:
            masks = f"masks of {', '.join(frame.cameras.names[view] for view in converted.views)}"
        if masks not in self._logged_conversions:
            self._logged_conversions.add(masks)
            logging.getLogger("viewmend").warning(
                f"{self.name}: {masks} have no values above {converted.highest}: {converted.explanation}"
            )
        return replace(frame, mask=converted.mask)

    def _warn_about_rotation(self) -> None:
        """Log that images are used as stored although EXIF rotates them, once per camera; one message per rotation."""
        cameras: dict[str, list[str]] = {}
        for reader in self._readers:
            if reader.rotation and not reader.warned:
                cameras.setdefault(str(reader.rotation), []).append(f"'{reader.camera.name}'")
                reader.warned = True
        for rotation, names in cameras.items():
            logging.getLogger("viewmend").warning(
                f"{self.name}: EXIF says that images should be {rotation}, but pixels are used as stored "
                f"(cameras {', '.join(names)}); if calibration and masks are upright, make the images upright too "
                "(exiftran -ai)"
            )

    def _cameras_have(self, kind: FileKind) -> bool:
        """Whether the cameras have files of this kind; CaptureError if some have and others do not."""
        missing = [
            f"camera '{camera.name}'" for camera in self._native_cameras if getattr(camera, kind) is None
        ]
        if missing and len(missing) < len(self._native_cameras):
            expected = f"'{kind}' for every camera or for none"
            got = f"none for {', '.join(missing)}"
            raise CaptureError(
                f"{self._file}: expected {expected}, got {got}; add it, or leave these cameras out"
            )
        return not missing

    def _find_files(self) -> Bool[np.ndarray, "view time"]:
        list_once = functools.cache(lambda parent: names_in(self.folder / parent))

        def exists(path: str) -> bool:
            if not stays_inside(path):
                raise CaptureError(
                    f"{self.folder}: expected a file inside the folder, got {path}; rename the frame"
                )
            parent, name = os.path.split(path)
            return name in list_once(parent)

        times = range(len(self.frame_ids))
        present = np.array([[reader.has(time, exists) for time in times] for reader in self._readers], bool)
        for camera, row in zip(self._native_cameras, present, strict=True):
            if not row.any():
                raise CaptureError(self._describe_camera_without_files(camera, exists))
        empty_frames = np.flatnonzero(~present.any(0)).tolist()
        if empty_frames:
            raise CaptureError(self._describe_empty_frame(empty_frames[0], exists))
        return present

    def _describe_camera_without_files(self, camera: NativeCamera, exists: Callable[[str], bool]) -> str:
        """The error message for a camera that lacks a file in every frame."""
        kinds = camera.file_kinds
        absent: list[FileKind] = [
            kind for kind in kinds if not any(exists(camera.file(kind, frame)) for frame in self._listed)
        ]

        # The message names a file of the first frame as an example: one of an absent kind, if there is any
        if absent:
            example: FileKind = absent[0]
            wanted = f"the camera's {example} in at least one frame"
        else:
            example = kinds[0]
            wanted = f"{' and '.join(kinds)} of the camera in the same frame"
        frame = self.frame_ids[0]
        path = camera.file(example, frame)
        where = f"{self.folder / path}: camera '{camera.name}', frame '{frame}'"
        got = f"found none in {len(self.frame_ids)} frames"
        next_step = f"correct the paths in {self._file}" if self._file.name == CALIBRATION else "add them"
        return f"{where}: expected {wanted}, {got}; {next_step}, or leave the camera out"

    def _describe_empty_frame(self, time: int, exists: Callable[[str], bool]) -> str:
        """The error message for a frame in which no camera has all of its files."""
        # The kinds of files in the capture, and those that no camera has in this frame
        readers = {kind: [r for r in self._readers if kind in r.camera.file_kinds] for kind in FILE_KINDS}
        kinds: list[FileKind] = [kind for kind in FILE_KINDS if readers[kind]]
        absent: list[FileKind] = [
            kind for kind in kinds if all(reader.lacks(kind, time, exists) for reader in readers[kind])
        ]

        # The message names a file as an example: one of an absent kind, if there is any
        if absent:
            example: FileKind = absent[0]
            wanted = "this file or another camera's"
            got = f"no {' and no '.join(absent)} of any camera"
        else:
            example = kinds[0]
            wanted = f"{' and '.join(kinds)} of the same camera"
            got = "no camera that has all"
        _, where = readers[example][0].locate(example, time)

        only_masks = absent == ["mask"]
        steps = ["add them, black ones if there is no subject"] if only_masks else ["add them"]
        has_images = "image" in kinds and "image" not in absent
        if self._file.name == CALIBRATION:
            # Without a clock, a frame can be removed from the list. With one, its ids stand for the clock's times
            if self.clock is None:
                steps.append(f"remove the frame from {self._file}")
        elif has_images:
            # Other formats have no list of frames: a frame exists if it has images
            steps.append("remove the frame's images")
        return f"{where}: expected {wanted}, got {got}; {', or '.join(steps)}"


def _select(
    cameras: tuple[NativeCamera, ...], names: Sequence[str] | None, file: Path
) -> tuple[NativeCamera, ...]:
    if names is None:
        return cameras
    check_names("cameras", names)
    by_name = {camera.name: camera for camera in cameras}
    unknown = [name for name in names if name not in by_name]
    if unknown or not names or len(set(names)) < len(names):
        raise CaptureError(
            f"{file}: expected cameras among {list(by_name)}, each once, got {list(names)}; choose again"
        )
    return tuple(by_name[name] for name in names)


def _with_masks_from(
    source: MaskSource, cameras: tuple[NativeCamera, ...], calibration: NativeCalibration
) -> tuple[NativeCamera, ...]:
    """The cameras with masks from this source only."""
    if source == "alpha":
        return tuple(_with_alpha(camera, calibration.folder, calibration.frames) for camera in cameras)
    if source == "none":
        return tuple(replace(camera, mask=None) for camera in cameras)
    return cameras


def _without_masks(cameras: Sequence[NativeCamera]) -> tuple[str, ...]:
    """Names of the cameras without masks, if at least two others have masks; otherwise none."""
    unmasked = tuple(camera.name for camera in cameras if camera.mask is None)
    return unmasked if len(cameras) - len(unmasked) >= 2 else ()


def _with_alpha(camera: NativeCamera, folder: Path, frames: Sequence[str]) -> NativeCamera:
    """The camera with the alpha channel of its images as masks; CaptureError if none of its images has alpha."""
    if camera.image is None:
        where = f"{folder}: camera '{camera.name}'"
        raise CaptureError(f"{where}: expected images with alpha, got a video; use another source of masks")
    paths = [camera.file("image", frame) for frame in frames]
    existing = [folder / path for path in paths if stays_inside(path) and (folder / path).is_file()]
    if existing and not any(uses_alpha(file) for file in existing):
        # No image has alpha that cuts something out. For the first one, this raises an error that says why
        read_alpha(existing[0], f"{existing[0]}: camera '{camera.name}'")
    return replace(camera, mask=camera.image, mask_labels=False)


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


def _choose_fps(stated_fps: float | None, clock: VideoClock) -> float | None:
    """The rate of the frames: as stated, unless videos have times of another rate."""
    has_times = any(track.is_timed for track in clock.tracks)
    if stated_fps is None or clock.fps is None or not has_times:
        return stated_fps or clock.fps
    return stated_fps if abs(clock.fps / stated_fps - 1) < RATE_TOLERANCE else clock.fps


def _ids_in_use(
    calibration: NativeCalibration, used: Sequence[NativeCamera], clock: VideoClock
) -> tuple[str, ...]:
    """The ids of the frames of the videos in use.

    Formats without a list of frames count those of all videos. If some are left out, the others may
    have more frames, or fewer.
    """
    listed = calibration.frames
    is_counted = listed == tuple(f"{time:06d}" for time in range(len(listed)))
    has_numbered_files = any(
        "{frame}" in str(path) for camera in used for path in (camera.image, camera.mask)
    )
    if len(used) == len(calibration.cameras) or has_numbered_files or not is_counted:
        return listed
    return tuple(f"{time:06d}" for time in range(clock.end))


def with_frames(calibration: NativeCalibration, cameras: Sequence[NativeCamera]) -> NativeCalibration:
    """The calibration with the frame ids of these cameras' footage if its file lists none.

    They are the numbers in the names of images. If all cameras have videos, the frames of these are counted.

    Raises:
        CaptureError: no image has a number where the file says, or a video is missing or cannot be decoded.
    """
    if calibration.frames:
        return calibration
    videos = [camera.video for camera in cameras if camera.video is not None]
    absent = [video for video in videos if not (calibration.folder / video).is_file()]
    if absent:
        expected = "the cameras' videos, as no 'frames' are listed"
        raise CaptureError(f"{calibration.file}: expected {expected}, got no {absent[0]}; put it there")
    if len(videos) == len(cameras):
        clock = read_clock(replace(calibration, cameras=tuple(cameras)))
        assert clock is not None, "there are videos"
        return replace(calibration, frames=tuple(f"{time:06d}" for time in range(clock.end)))
    patterns = [camera.image for camera in cameras if camera.image is not None]
    ids = set[str]().union(*(_numbers_in(calibration.folder, pattern) for pattern in patterns))
    if not ids:
        expected = f"'frames', or images with a number for {{frame}} in {patterns[0]}"
        raise CaptureError(f"{calibration.file}: expected {expected}, got neither; add one of them")
    return replace(calibration, frames=tuple(sorted(ids, key=frame_order)))


def _numbers_in(folder: Path, pattern: str) -> set[str]:
    """The numbers that stand for {frame} in the names of the files of a pattern; none if a folder has it."""
    parent, name = os.path.split(pattern)
    before, _, after = name.partition("{frame}")
    expression = re.compile(f"{re.escape(before)}([0-9]+){re.escape(after)}")
    matches = (expression.fullmatch(file) for file in names_in(folder / parent))
    return {match[1] for match in matches if match is not None}


def read_clock(calibration: NativeCalibration) -> VideoClock | None:
    """Match the videos of a calibration's cameras by time; None if they have no videos and no offsets.

    A camera's numbered images are matched like the frames of a video. Their rate is that of the capture or,
    if it has none, of the first video. CaptureError if a video cannot be decoded, no two cameras
    have frames of the same time, or there are offsets but no frame rate.
    """
    cameras = calibration.cameras
    videos: dict[tuple[str, str], Path] = {}
    for camera in cameras:
        for kind, path in (("images", camera.video), ("masks", camera.mask)):
            if path and is_video(path) and (calibration.folder / path).is_file():
                videos[camera.name, kind] = calibration.folder / path
    if not videos and not any(camera.offset_ms for camera in cameras):
        return None
    fps = calibration.fps or next((video_properties(file).fps for file in videos.values()), None)
    if fps is None:
        raise CaptureError(f"{calibration.file}: expected fps, which offset_ms needs, got none; add it")
    numbered_times_s = np.arange(len(calibration.frames)) / fps
    tracks = []
    for camera in cameras:
        offset_s = camera.offset_ms / 1000
        for kind in ("images", "masks"):
            video = videos.get((camera.name, kind))
            if video is not None:
                tracks.append(video_track(camera.name, kind, video, offset_s))
            elif kind == "images":  # numbered masks need no track: they have the times of the images
                tracks.append(Track(camera.name, kind, numbered_times_s, fps, offset_s))
    try:
        return match_tracks(tracks)
    except ValueError as error:
        raise CaptureError(f"{calibration.file}: {error}") from None
