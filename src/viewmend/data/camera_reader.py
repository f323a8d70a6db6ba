"""Reads the images, masks and depth of one camera from files and videos."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from viewmend.data.camera_images import CameraImages
from viewmend.data.errors import CaptureError
from viewmend.data.image_orientation import Orientation, exif_orientation
from viewmend.data.images import (
    RUN_LENGTH_SUFFIX,
    read_alpha,
    read_depth,
    read_mask,
    read_rgb,
    read_run_lengths,
    to_mask,
)
from viewmend.data.native_format import FileKind, NativeCamera
from viewmend.data.undistortion import Undistortion
from viewmend.data.video_clock import ABSENT, TrackKind, VideoClock
from viewmend.data.videos import VideoFile, is_video, video_properties


def colour_curves(coefficients: Float64[np.ndarray, "3 3"]) -> UInt8[np.ndarray, "1 256 3"]:
    """The corrected value of each channel for each value from 0 to 255; see `NativeCamera.colour`."""
    powers = np.vander(np.arange(256.0), 3)
    corrected = powers @ coefficients.T
    return np.rint(corrected.clip(0, 255)).astype(np.uint8)[None]


class CameraReader:
    """Reads the files of one camera. Keeps its videos open and its undistortion map. Thread-safe."""

    def __init__(self, folder: Path, camera: NativeCamera, frames: Sequence[str], clock: VideoClock | None):
        self.camera = camera
        self.rotation: Orientation | None = None
        """How to turn the camera's images, by the EXIF of the first image that was read."""
        self._rotation_is_known = False
        self.warned = False
        """Whether the user was warned of the rotation."""
        self._folder = folder
        self._frames = frames
        """All frame ids that are listed; with a clock, the capture may have fewer frames."""
        self._num_frames = len(frames) if clock is None else len(clock.times_s)
        self._undistortion = Undistortion(camera)
        self._video = VideoFile(folder / camera.video) if camera.video else None
        has_mask_video = camera.mask is not None and is_video(camera.mask)
        self._mask_video = VideoFile(folder / str(camera.mask)) if has_mask_video else None
        self._curves = None if camera.colour is None else colour_curves(camera.colour)

        # Which image or mask belongs to each frame of the capture
        in_order = np.arange(self._num_frames)
        by_clock = {} if clock is None else clock.frames
        images = by_clock.get((camera.name, "images"), in_order)
        masks = images if camera.video is None or self._has_mask_per_image() else in_order
        self._index: dict[TrackKind, np.ndarray] = {
            "images": images,
            "masks": by_clock.get((camera.name, "masks"), masks),
        }

    def _has_mask_per_image(self) -> bool:
        """Whether mask files are numbered like the video's frames, not like the capture's.

        They are if there are fewer mask files than frames of the capture, but one per frame of the video.
        """
        if self._video is None or self.camera.mask is None or self._mask_video is not None:
            return False
        frames = self._frames[: self._num_frames]
        count = sum((self._folder / self.camera.file("mask", frame)).is_file() for frame in frames)
        return count < self._num_frames and count == video_properties(self._video.path).frames

    def has(self, time: int, exists: Callable[[str], bool]) -> bool:
        """Whether the camera has all of its files in the frame at index `time`; `exists` looks a path up."""
        return not any(self.lacks(kind, time, exists) for kind in self.camera.file_kinds)

    def lacks(self, kind: FileKind, time: int, exists: Callable[[str], bool]) -> bool:
        """Whether the camera has no file of this kind in the frame at index `time`, as in `has`."""
        number = self._index["masks" if kind == "mask" else "images"][time]
        return bool(number == ABSENT) or not exists(self.camera.file(kind, self._file_id(kind, time)))

    def read(self, time: int) -> CameraImages | None:
        """Read and undistort the images of the frame at index `time`, in which the camera is present.

        None if its video is damaged there. CaptureError if a file is missing, unreadable, or not of
        the camera's size.
        """
        camera = self.camera
        path, where = self.locate("video" if camera.video else "image", time)
        rgb = (
            self._video.read(int(self._index["images"][time]), where)
            if self._video
            else read_rgb(path, where)
        )
        if rgb is None:
            return None
        if not self._rotation_is_known:
            self.rotation = None if self._video else exif_orientation(path)
            self._rotation_is_known = True
        self._check_size(rgb, where, self.rotation)
        mask = None
        depth = None
        if camera.mask:
            path, where = self.locate("mask", time)
            mask = self._read_mask(path, where, time)
            if mask is None:
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

    def _correct_colours(
        self, rgb: UInt8[np.ndarray, "height width 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        return rgb if self._curves is None else cv2.LUT(rgb, self._curves)

    def _read_mask(self, path: Path, where: str, time: int) -> UInt8[np.ndarray, "height width"] | None:
        if self._mask_video:
            image = self._mask_video.read(int(self._index["masks"][time]), where)
            if image is None:
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

    def _as_stored(
        self, mask: UInt8[np.ndarray, "rows columns"], path: Path
    ) -> UInt8[np.ndarray, "height width"]:
        """The mask, turned as its image is stored.

        The tool that made the mask may have turned it by the image's EXIF, or ignored it. A mask whose
        width and height are swapped is turned back by the image's EXIF, or else turned by its own.
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
                f"{where}: expected {expected}, got {got} (neither file says how); turn the mask"
            )
        if mask.shape != (self.camera.height, self.camera.width):
            expected = f"a mask of {self.camera.width} x {self.camera.height} pixels as its image"
            got = f"{mask.shape[1]} x {mask.shape[0]}"
            raise CaptureError(f"{where}: expected {expected}, got {got}; make it of the image's size")

    def _check_size(self, image: np.ndarray, where: str, rotation: Orientation | None = None) -> None:
        height, width = image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            advice = "correct width, height and K in the calibration, or replace the file"
            if rotation:
                advice = (
                    f"EXIF says that it should be {rotation}: make it upright (exiftran -ai), or {advice}"
                )
            expected = f"{self.camera.width} x {self.camera.height} pixels as in the calibration"
            raise CaptureError(f"{where}: expected {expected}, got {width} x {height}; {advice}")
