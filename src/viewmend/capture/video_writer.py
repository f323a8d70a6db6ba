"""Writing videos, with PyAV (the extra `viewmend[video]`)."""

from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8


class VideoWriter:
    """An H.264 file of RGB frames of one size; a context manager. The first frame says how large.

    As it is, any player shows it (4:2:0; an odd last row or column is dropped). `faithful` keeps all pixels and all
    colours nearly as they are, for files to compute on.

    Raises:
        ImportError: PyAV is not installed.
    """

    def __init__(self, path: Path, fps: float, faithful: bool = False):
        try:
            import av
        except ImportError:
            raise ImportError(f"writing {path} needs PyAV; install it, or viewmend's extra 'video'") from None
        self._faithful = faithful
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(path), "w")
        self._stream = self._container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        self._stream.pix_fmt = "yuv444p" if faithful else "yuv420p"
        self._stream.options = {"crf": "8" if faithful else "18", "preset": "veryfast"}
        self._begun = False

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def add(self, rgb: UInt8[np.ndarray, "height width 3"]) -> None:
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
