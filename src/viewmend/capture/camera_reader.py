"""One camera of a plain capture: its files, read and undistorted."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from viewmend.capture.errors import CaptureError
from viewmend.capture.images import as_mask, exif_turn, read_depth, read_mask, read_rgb
from viewmend.capture.plain_format import PlainCamera, Stream
from viewmend.capture.run_lengths import RUN_LENGTHS, read_runs
from viewmend.capture.videos import VideoFile, is_video
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame


@dataclass(frozen=True)
class CameraImages:
    """What one camera has of one time, undistorted."""

    rgb: UInt8[np.ndarray, "height width 3"]
    mask: UInt8[np.ndarray, "height width"] | None
    depth: Float32[np.ndarray, "height width"] | None


class CameraReader:
    """Reads one camera's streams. Holds its open videos and its undistortion map; may be used from any thread."""

    def __init__(self, folder: Path, camera: PlainCamera):
        self.camera = camera
        self.turn: str | None = None
        """How the EXIF of the first image that was read says that it should be turned; '' where it should not."""
        self.turn_is_said = False
        self._folder = folder
        self._undistortion = Undistortion(camera)
        streams = (camera.video, camera.mask if camera.mask and is_video(camera.mask) else None)
        self._video, self._mask_video = (VideoFile(folder / path) if path else None for path in streams)
        self._curves = None if camera.colour is None else _curves(camera.colour)

    def read(self, frame: str, index: int) -> CameraImages:
        """The images at frame id `frame`, which is at `index` of the capture's frames.

        Raises:
            CaptureError: a file is missing, unreadable, or not of the camera's size.
        """
        camera = self.camera
        path, where = self._locate("video" if camera.video else "image", frame)
        rgb = self._video.read(index, where) if self._video else read_rgb(path, where)
        if self.turn is None:
            self.turn = "" if self._video else exif_turn(path) or ""
        self._check_size(rgb, where, self.turn)
        rgb = self._coloured(rgb)
        mask, depth = None, None
        if camera.mask:
            path, where = self._locate("mask", frame)
            mask = self._read_mask(path, where, index)
            self._check_size(mask, where)
        if camera.depth:
            path, where = self._locate("depth", frame)
            depth = read_depth(path, where)
            self._check_size(depth, where)
        return self._undistortion.straight(CameraImages(rgb, mask, depth))

    def straightened(self, rgb: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """Another image of the camera (a clean plate), its colours and distortion corrected as its own are."""
        return self._undistortion.straight(CameraImages(self._coloured(rgb), None, None)).rgb

    def _coloured(self, rgb: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
        import cv2

        return rgb if self._curves is None else cv2.LUT(rgb, self._curves)

    def _read_mask(self, path: Path, where: str, index: int) -> UInt8[np.ndarray, "height width"]:
        if self._mask_video:
            mask = as_mask(self._mask_video.read(index, where))
        elif path.suffix == RUN_LENGTHS:
            mask = read_runs(path, where, (self.camera.height, self.camera.width))
        else:
            mask = read_mask(path, where)
        return 255 * (mask > 0).astype(np.uint8) if self.camera.mask_labels else mask

    def _locate(self, stream: Stream, frame: str) -> tuple[Path, str]:
        path = self._folder / self.camera.file(stream, frame)
        return path, f"{path}: camera '{self.camera.name}', frame '{frame}'"

    def _check_size(self, image: np.ndarray, where: str, turn: str = "") -> None:
        height, width = image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            advice = "correct width, height and K there, or the file"
            if turn:
                advice = f"its EXIF says that it is to be {turn}: write it upright (exiftran -ai), or {advice}"
            raise CaptureError(
                f"{where}: expected {self.camera.width} x {self.camera.height} pixels as the calibration says, "
                f"got {width} x {height}; {advice}"
            )


class Undistortion:
    """Straightens what one camera took. Holds its map, which is made at first use; may be used from any thread."""

    def __init__(self, camera: PlainCamera):
        self._camera = camera
        self._lock = threading.Lock()
        self._maps: tuple[np.ndarray, np.ndarray] | None = None

    def straight(self, images: CameraImages) -> CameraImages:
        """Images of the pinhole camera of the same K and size; themselves where the lens has no distortion.

        Where such a pixel lies outside the image that was taken (the corners, when a lens with pincushion distortion
        is straightened), the nearest pixel of its border stands in: the mask of a subject that the image cuts off then
        goes on, and carves nothing away, as for all that lies outside an image. Depth there is unknown, 0.
        """
        import cv2

        if not self._camera.dist.any():
            return images
        first, second = self._map()
        border = cv2.BORDER_REPLICATE
        rgb = cv2.remap(images.rgb, first, second, cv2.INTER_LINEAR, borderMode=border)
        mask, depth = images.mask, images.depth
        if mask is not None:
            mask = cv2.remap(mask, first, second, cv2.INTER_LINEAR, borderMode=border)
        if depth is not None:  # no mean of two depths across an edge
            depth = cv2.remap(depth, first, second, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
        return CameraImages(rgb, mask, depth)

    def _map(self) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        with self._lock:
            if self._maps is None:
                camera = self._camera
                K = camera.K.copy()
                K[:2, 2] -= 0.5  # OpenCV puts the first pixel's centre at 0
                size, fixed = (camera.width, camera.height), cv2.CV_16SC2  # 1/32 pixel, thrice as fast as floats
                first, second = cv2.initUndistortRectifyMap(K, camera.dist, None, K, size, fixed)  # pyright: ignore
                self._maps = first, second
            return self._maps


def _curves(colour: Float64[np.ndarray, "3 3"]) -> UInt8[np.ndarray, "1 256 3"]:
    """What each value of red, green and blue becomes by its quadratic."""
    values = np.vander(np.arange(256.0), 3) @ colour.T
    return np.rint(values.clip(0, 255)).astype(np.uint8)[None]


def stack_images(images: Sequence[CameraImages], cameras: Cameras, time: int) -> MultiViewFrame:
    """What these cameras took at one time, padded right and below to the largest.

    All of them have masks or none; depth alike.
    """
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
