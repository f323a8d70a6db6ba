"""Writing MP4 and WebM files, with PyAV (the extra `viewmend[video]`)."""

from collections.abc import Iterable
from fractions import Fraction
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

SMPTE170M, BT709, VIDEO_RANGE = 6, 1, 1
"""Numbers of ITU-T H.273: the matrix of BT.601, primaries and transfer of BT.709, and luma from 16 to 235."""

Picture = UInt8[np.ndarray, "height width 3"]
CutOut = UInt8[np.ndarray, "height width 4"]
"""RGB and alpha; colours are not multiplied by it."""


class VideoWriter:
    """An H.264 MP4 of RGB frames of one size; a context manager. The first frame says how large.

    By default any player shows it (4:2:0), and an odd last row or column is dropped. `faithful` keeps every pixel
    and nearly every colour: a capture's videos are computed on.

    Raises:
        ImportError: PyAV is not installed.
    """

    def __init__(self, file: Path | BytesIO, fps: float, faithful: bool = False, threads: int = 0):
        """Begin; `threads` of its own that encode, 0 for as many as there are cores; they stay with it."""
        try:
            import av
        except ImportError:
            raise ImportError("writing videos needs PyAV; install it, or viewmend's extra 'video'") from None
        self._faithful = faithful
        if isinstance(file, Path):
            file.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(file, "w", format="mp4")
        self._stream = self._container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        self._stream.pix_fmt = "yuv444p" if faithful else "yuv420p"
        say_colours(self._stream.codec_context)
        self._stream.options = {"crf": "8" if faithful else "18", "preset": "veryfast"}
        self._stream.codec_context.thread_count = threads
        self._begun = False

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def add(self, rgb: Picture) -> None:
        """Append a frame."""
        from av import VideoFrame

        if not self._faithful:
            rgb = rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2]
        if not self._begun:
            self._stream.height, self._stream.width = rgb.shape[:2]
            self._begun = True
        frame = VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Finish the file; a second call does nothing."""
        if self._begun:
            self._container.mux(self._stream.encode(None))
            self._begun = False
        self._container.close()


def say_colours(context: "VideoCodecContext") -> None:
    """Write into a stream how its YUV was made of sRGB, before it is opened.

    By BT.601 in video range, as FFmpeg does it. Untold, browsers take BT.709 from 720 rows on, or always, and colours
    change by up to 25 of 255.
    """
    context.colorspace, context.color_range = SMPTE170M, VIDEO_RANGE
    context.color_primaries = context.color_trc = BT709  # of sRGB; browsers heed none of the three alone


def write_mp4(file: Path | BytesIO, frames: Iterable[Picture], fps: float) -> None:
    """All frames as an MP4 that any player shows.

    Raises:
        ImportError: PyAV is not installed.
    """
    with VideoWriter(file, fps) as video:
        for frame in frames:
            video.add(frame)


def write_webm(file: Path, frames: Iterable[CutOut], fps: float) -> None:
    """All frames as a WebM of VP9 with alpha, which browsers and editors lay over what is behind.

    Raises:
        ImportError: PyAV is not installed.
    """
    try:
        import av
    except ImportError:
        raise ImportError("writing videos needs PyAV; install it, or viewmend's extra 'video'") from None
    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(file, "w", format="webm") as container:
        stream = container.add_stream("libvpx-vp9", rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = "yuva420p"
        say_colours(stream.codec_context)
        # Alpha is a second picture beside the first: VP9's frames that are never shown would part the two.
        stream.options = {"crf": "18", "b:v": "0", "auto-alt-ref": "0", "deadline": "realtime", "cpu-used": "5"}
        stream.metadata["alpha_mode"] = "1"
        for n, rgba in enumerate(frames):
            if not n:
                stream.height, stream.width = rgba.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgba), format="rgba")))
        container.mux(stream.encode(None))


def can_write_mp4() -> bool:
    """Whether PyAV is installed."""
    return find_spec("av") is not None
