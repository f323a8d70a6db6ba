"""Frames of a video file, each exactly once its index says."""

import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from viewmend.capture.errors import CaptureError

VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")

MOST_CLAIMED = 30
"""How many frames a container may claim beyond those that it has."""


def is_video(path: str) -> bool:
    """Whether a file's name is that of a video."""
    return path.lower().endswith(VIDEO_SUFFIXES)


@dataclass(frozen=True)
class VideoFacts:
    """What a video says of itself."""

    width: int
    height: int
    fps: float | None
    frames: int
    """How many can be decoded; containers often claim a few more."""


def video_facts(path: Path) -> VideoFacts:
    """Size, rate and length of a video, of which only the end is decoded.

    Raises:
        CaptureError: none of the decoders opens it, or it has no frames.
    """
    import cv2

    decoder = cv2.VideoCapture(str(path))
    width, height = (int(decoder.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    frames, fps = int(decoder.get(cv2.CAP_PROP_FRAME_COUNT)), float(decoder.get(cv2.CAP_PROP_FPS))
    for last in range(frames - 1, max(-1, frames - 1 - MOST_CLAIMED), -1):
        decoder.set(cv2.CAP_PROP_POS_FRAMES, last)
        if decoder.grab():
            break
        frames = last
    decoder.release()
    if min(width, height, frames) < 1:
        raise CaptureError(f"{path}: expected a video, got a file without frames for the decoders; export it again")
    return VideoFacts(width, height, fps if fps > 0 else None, frames)


class VideoFile:
    """A video, read by frame index, from any thread.

    Seeking in compressed video is not exact in general, so nothing seeks: reading onward decodes what lies between,
    and going back starts again at the beginning. Read in order of time.
    """

    def __init__(self, path: Path):
        self.path = path
        self._lock = threading.Lock()
        self._decoder = None
        self._decoded = 0  # frames taken from the decoder; the last of them can be had again
        self._last: UInt8[np.ndarray, "height width 3"] | None = None

    def read(self, index: int, where: str) -> UInt8[np.ndarray, "height width 3"]:
        """The frame at `index` as RGB; do not write to it. `where` begins the messages: file, camera, frame.

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
            raise CaptureError(
                f"{where}: expected a video, got a file that none of the decoders opens; export it again"
            )

    def _advance(self, index: int, where: str) -> None:
        import cv2

        assert self._decoder is not None
        bgr = None
        if self._decoder.grab():
            if self._decoded < index:  # on the way: decoded by need, but not converted
                self._decoded += 1
                return
            bgr = self._decoder.retrieve()[1]
        if bgr is None:
            end, self._decoder = self._decoded, None
            raise CaptureError(
                f"{where}: expected at least {index + 1} frames in the video, got {end}; "
                f"shorten 'frames' in cameras.json, or export the video again"
            )
        self._last = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        self._decoded += 1
