"""Video files: exact frames by index, and writing of MP4 and WebM."""

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from viewmend.data.errors import CaptureError

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")
MAX_MISSING_FRAMES = 30
"""How many more frames a container may claim than it has."""
SMPTE170M, BT709, VIDEO_RANGE = 6, 1, 1
"""ITU-T H.273 codes: the matrix of BT.601, primaries and transfer of BT.709, and luma from 16 to 235."""

Image = UInt8[np.ndarray, "height width 3"]
ImageWithAlpha = UInt8[np.ndarray, "height width 4"]
"""RGB and straight alpha."""


def is_video(path: str) -> bool:
    """Whether a file name is that of a video."""
    return path.lower().endswith(VIDEO_SUFFIXES)


@dataclass(frozen=True)
class VideoProperties:
    """Properties of a video file."""

    width: int
    height: int
    fps: float | None
    frames: int
    """How many frames can be decoded; containers often claim a few more."""


def video_properties(path: Path) -> VideoProperties:
    """Size, rate and length of a video. Only its end is decoded.

    Raises:
        CaptureError: no decoder opens it, or it has no frames.
    """
    import cv2

    decoder = cv2.VideoCapture(str(path))
    width, height = (int(decoder.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    frames, fps = int(decoder.get(cv2.CAP_PROP_FRAME_COUNT)), float(decoder.get(cv2.CAP_PROP_FPS))
    for last in range(frames - 1, max(-1, frames - 1 - MAX_MISSING_FRAMES), -1):
        decoder.set(cv2.CAP_PROP_POS_FRAMES, last)
        if decoder.grab():
            break
        frames = last
    decoder.release()
    if min(width, height, frames) < 1:
        raise CaptureError(f"{path}: expected a video, got a file without decodable frames; export it again")
    return VideoProperties(width, height, fps if fps > 0 else None, frames)


class VideoFile:
    """A video, read by frame index. Thread-safe.

    Seeking in compressed video is inexact, so the file is decoded sequentially, and going back starts again at the
    beginning. Read frames in order of time.
    """

    def __init__(self, path: Path):
        self.path = path
        self._lock = threading.Lock()
        self._decoder = None
        self._decoded = 0  # frames decoded so far; `_last` is the last one
        self._last: Image | None = None

    def read(self, index: int, where: str) -> Image:
        """The frame at `index` as RGB, read-only. `where` starts the error messages: file, camera, frame.

        Raises:
            CaptureError: the video cannot be opened, or ends before this frame.
        """
        with self._lock:
            if self._decoder is None or index < self._decoded - 1:
                self._open(where)
            while self._decoded <= index:
                self._advance(index, where)
            assert self._last is not None
            return self._last

    def _open(self, where: str) -> None:
        import cv2

        self._decoder = cv2.VideoCapture(str(self.path))
        self._decoded, self._last = 0, None
        if not self._decoder.isOpened():
            self._decoder = None
            raise CaptureError(f"{where}: expected a video, got a file that no decoder opens; export it again")

    def _advance(self, index: int, where: str) -> None:
        import cv2

        assert self._decoder is not None
        bgr = None
        if self._decoder.grab():
            if self._decoded < index:  # skipped frames are not converted
                self._decoded += 1
                return
            bgr = self._decoder.retrieve()[1]
        if bgr is None:
            end, self._decoder = self._decoded, None
            raise CaptureError(
                f"{where}: expected at least {index + 1} frames in the video, got {end}; "
                "shorten 'frames' in cameras.json, or export the video again"
            )
        self._last = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        self._decoded += 1


class VideoWriter:
    """Writes an H.264 MP4 of RGB frames, which all have the size of the first. A context manager.

    By default the video plays everywhere (4:2:0), and an odd last row or column is dropped. `faithful` keeps every
    pixel and nearly exact colours, for captures that are processed further. `threads` is the number of encoder
    threads, 0 for one per core.
    """

    def __init__(self, file: Path | BytesIO, fps: float, faithful: bool = False, threads: int = 0):
        self._faithful = faithful
        self._container, self._stream = _open_output(file, "mp4", "libx264", fps)
        self._stream.pix_fmt = "yuv444p" if faithful else "yuv420p"
        tag_colours(self._stream.codec_context)
        self._stream.options = {"crf": "8" if faithful else "18", "preset": "veryfast"}
        self._stream.codec_context.thread_count = threads
        self._started = False

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def add(self, rgb: Image) -> None:
        """Append a frame."""
        from av import VideoFrame

        if not self._faithful:
            rgb = rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2]
        if not self._started:
            self._stream.height, self._stream.width = rgb.shape[:2]
            self._started = True
        frame = VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the file; a second call does nothing."""
        if self._started:
            self._container.mux(self._stream.encode(None))
            self._started = False
        self._container.close()


def tag_colours(context: "VideoCodecContext") -> None:
    """Declare that the YUV data are sRGB converted by BT.601 in video range, as FFmpeg does. Call before opening.

    Without these tags browsers assume BT.709, always or from 720 rows on, and colours change by up to 25 of 255.
    """
    context.colorspace, context.color_range = SMPTE170M, VIDEO_RANGE
    context.color_primaries = context.color_trc = BT709  # those of sRGB; browsers need all of them


def write_mp4(file: Path | BytesIO, frames: Iterable[Image], fps: float) -> None:
    """Write frames as an MP4 that plays everywhere."""
    with VideoWriter(file, fps) as video:
        for frame in frames:
            video.add(frame)


def write_webm(file: Path, frames: Iterable[ImageWithAlpha], fps: float) -> None:
    """Write frames as a VP9 WebM with alpha, which browsers and editors composite."""
    container, stream = _open_output(file, "webm", "libvpx-vp9", fps)
    with container:
        from av import VideoFrame

        stream.pix_fmt = "yuva420p"
        tag_colours(stream.codec_context)
        # Alpha is encoded as a second image. VP9's hidden reference frames would separate the two.
        stream.options = {"crf": "18", "b:v": "0", "auto-alt-ref": "0", "deadline": "realtime", "cpu-used": "5"}
        stream.metadata["alpha_mode"] = "1"
        for number, rgba in enumerate(frames):
            if number == 0:
                stream.height, stream.width = rgba.shape[:2]
            container.mux(stream.encode(VideoFrame.from_ndarray(np.ascontiguousarray(rgba), format="rgba")))
        container.mux(stream.encode(None))


def _open_output(file: Path | BytesIO, format: str, codec: str, fps: float) -> tuple[Any, Any]:
    """A PyAV container that is open for writing, and its video stream."""
    import av

    if isinstance(file, Path):
        file.parent.mkdir(parents=True, exist_ok=True)
    container = av.open(file, "w", format=format)
    return container, container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))


def can_write_mp4() -> bool:
    """Whether PyAV is installed."""
    return find_spec("av") is not None
