"""Sources of frames for the live server: the base class, its playback clock, and recordings that are read ahead."""

import contextlib
import logging
import os
import threading
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from viewmend.data.prepare import PreparedCapture
from viewmend.data.source import CaptureSource
from viewmend.frame_cache import CachedFrame
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.live.protocol import ClockChange
from viewmend.types import MultiViewFrame
from viewmend.utils.tensors import size_bytes, to_mmap

RETRY_S = 1.0
"""A source that failed is tried again after this many seconds."""
READ_AHEAD = 3
"""Number of frames after the requested one that are read ahead."""

log = logging.getLogger("viewmend.live")


@dataclass(frozen=True)
class Span:
    """The frames that can be requested, from index `first` to `end` - 1."""

    first: int = 0
    end: int = 0
    total: int | None = None
    """The final number of frames; None for a live rig."""
    fps: float = 0.0
    """Frames per second; 0 if there is a single frame."""
    live: bool = False
    """True if frames arrive as they happen, False for a recording, which is played in a loop."""

    @property
    def newest(self) -> int:
        """The last index; -1 while there is none."""
        return self.end - 1

    @property
    def complete(self) -> bool:
        """Whether this is a recording with all of its frames."""
        return not self.live and self.end == self.total

    def clamp(self, position: float | int) -> float:
        """The nearest position within the span."""
        return float(max(self.first, min(max(self.first, self.newest), position)))


class Clock:
    """A playback position in a span, in frames. Each viewer has one, and each recording has one for its edge."""

    def __init__(self) -> None:
        self.position = 0.0
        self.playing = True
        self.speed = 1.0
        self.live = True
        """Whether the clock follows the edge."""

    def advance(self, seconds: float, span: Span, edge: float | None = None) -> None:
        """Advance by `seconds`, or to the `edge` if the clock follows it.

        A complete recording starts again after its last frame. One that is still being generated
        waits at its end.
        """
        if self.live and edge is not None:
            self.position = edge
            return
        if self.playing:
            self.position += seconds * span.fps * self.speed
        count = span.end - span.first
        if span.complete and count > 0 and self.position >= span.end:
            self.position = span.first + (self.position - span.first) % count
        elif not span.first <= self.position < span.end:
            self.position = span.clamp(self.position)

    def change(self, change: ClockChange, span: Span) -> None:
        """Apply a viewer's message `clock`."""
        if change.seek is not None:
            self.position = span.clamp(change.seek)
            self.live = False
        if change.speed is not None and not span.live:
            self.speed = change.speed
            self.live = self.live and change.speed == 1
        if change.playing is not None:
            self.playing = change.playing
            self.live = self.live and change.playing
        if change.live:
            self.live = True
            self.playing = True
            self.speed = 1.0

    def frame(self, span: Span) -> int:
        """The index of the frame to show; -1 while there is none."""
        return int(span.clamp(self.position)) if span.end > span.first else -1


@dataclass(frozen=True)
class RigInfo:
    """What a source knows about its rig."""

    name: str
    bounds: Bounds | None
    up: Float[Tensor, "3"] | None
    number: int = 0
    """Distinguishes a rig from the one that was connected before."""
    cameras: Cameras | None = None
    """All cameras that frames may have; None if they are those of the first frame."""


@dataclass(frozen=True)
class SourceStatus:
    """Whether a source works."""

    state: str = "loading"
    """One of loading, ready and failing."""
    error: str | None = None
    """The reason, as the page shows it."""


class FrameSource(ABC):
    """Where the render service takes frames from."""

    def __init__(self, span: Span) -> None:
        self.changed: Callable[[], None] = lambda: None
        """Called, on any thread, when span, rig or status has changed or a frame has been read."""
        self.status = SourceStatus()
        self.rig: RigInfo | None = None
        """None before the source is open."""
        self.span = span
        self.spread_ms: float | None = None
        """Time between the first and the last image of the newest frame, if this process
        reads the cameras."""
        self.recording = Clock()
        """The clock of a recording's edge, which all viewers that follow it share."""
        self.recording.live = False

    @property
    def edge(self) -> float:
        """The playback position of viewers that follow the edge.

        This is the newest frame of a live rig, or the position of a recording's common clock.
        """
        return float(self.span.newest) if self.span.live else self.recording.position

    def camera_counts(self) -> dict[str, dict[str, int]]:
        """Event counts by camera, if this process reads the cameras; "up" is 1 while a camera delivers images."""
        return {}

    @abstractmethod
    def read(self, index: int) -> MultiViewFrame | None:
        """The frame, or None while it is not in memory. Returns at once; reading goes on in the background."""

    def read_cached(self, index: int) -> CachedFrame | None:
        """The frame with the geometry and encodings that another process has computed; None if there are none."""
        return None

    def start(self) -> None:  # noqa: B027
        """Start reading, for sources that read by themselves."""

    def stop(self) -> None:  # noqa: B027
        """Stop reading and release threads."""


class FrameCache:
    """Frames by index, bounded by bytes: the oldest are dropped, or with `by_last_use` the least recently used."""

    def __init__(self, memory_mb: float, by_last_use: bool) -> None:
        self._by_last_use = by_last_use
        self._max_bytes = 1e6 * memory_mb
        self._frames: OrderedDict[int, MultiViewFrame] = OrderedDict()
        self._bytes = 0

    def __contains__(self, index: int) -> bool:
        return index in self._frames

    def put(self, index: int, frame: MultiViewFrame) -> None:
        """Store a frame under this index."""
        frame = to_mmap(replace(frame, depth=None, time=index))
        self._frames[index] = frame
        self._bytes += size_bytes((frame.rgb, frame.mask))
        while self._bytes > self._max_bytes and len(self._frames) > 1:
            _, oldest = self._frames.popitem(last=False)
            self._bytes -= size_bytes((oldest.rgb, oldest.mask))

    def get(self, index: int) -> MultiViewFrame | None:
        """The frame, or None."""
        if self._by_last_use and index in self._frames:
            self._frames.move_to_end(index)
        return self._frames.get(index)

    @property
    def capacity(self) -> int:
        """The number of frames of the newest one's size that fit."""
        newest = next(reversed(self._frames.values()), None)
        return 1 if newest is None else max(1, int(self._max_bytes // size_bytes((newest.rgb, newest.mask))))

    @property
    def oldest(self) -> int:
        """The first index in the cache."""
        return min(self._frames, default=0)


class RecordedSource(FrameSource):
    """A recording, read on a thread of low priority: the requested frame and the following ones.

    Frames of a `generated` one (the studio) are made one after the other, and can be
    requested once they exist.
    """

    def __init__(
        self,
        open_capture: Callable[[], CaptureSource],
        fps: float | None = None,
        generated: bool = False,
        memory_mb: float = 1500.0,
    ) -> None:
        super().__init__(Span())
        self._open_capture = open_capture
        self._fps = fps
        self._generated = generated
        self._cache = FrameCache(memory_mb, by_last_use=True)
        self._lock = threading.Condition()
        self._wanted = 0
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="frames", daemon=True)

    def start(self) -> None:
        """Open the capture and read ahead."""
        self._thread.start()

    def stop(self) -> None:
        """Stop after the frame that is being read."""
        with self._lock:
            self._stopped = True
            self._lock.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=3)

    def read(self, index: int) -> MultiViewFrame | None:
        """The frame, or None while it is being read."""
        with self._lock:
            if self._wanted != index:
                self._wanted = index
                self._lock.notify_all()
            return self._cache.get(index)

    def _run(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # on Linux, priorities are per thread
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        capture: CaptureSource | None = None
        while not self._stopped:
            try:
                if capture is None:
                    capture = self._open()
                self._step(capture)
            except (
                Exception
            ) as error:  # reported, in the log unless it is the same as before, and tried again
                reason = f"{type(error).__name__}: {error}"[:400]
                if self.status.error != reason:
                    log.warning("while reading: %s", reason)
                self.status = replace(self.status, state="failing", error=reason)
                self.changed()
                with self._lock:
                    self._lock.wait_for(lambda: self._stopped, RETRY_S)

    def _open(self) -> CaptureSource:
        capture = self._open_capture()
        total = len(capture.frame_ids)
        fps = (self._fps or capture.fps or 0.0) if total > 1 else 0.0
        self.span = Span(0, 0 if self._generated else total, total, fps)
        cameras = capture.usable_cameras if isinstance(capture, PreparedCapture) else capture.cameras
        self.rig = RigInfo(capture.name, capture.bounds, capture.up, cameras=cameras)
        return capture

    def _step(self, capture: CaptureSource) -> None:
        with self._lock:
            index = self._next_index()
            if index is None:
                self._lock.wait_for(lambda: self._stopped or self._next_index() is not None)
                return
        frame = capture.read(index)
        with self._lock:
            self._cache.put(index, frame)
            if self._generated:
                self.span = replace(self.span, end=max(self.span.end, index + 1))
            self.status = replace(self.status, state="ready", error=None)
        self.changed()

    def _next_index(self) -> int | None:
        """The index to read next; None if all that is wanted is in memory."""
        total = self.span.total or 0
        if self._generated and self.span.end < total:
            return self.span.end
        ahead = [
            (self._wanted + n) % max(1, total)
            for n in range(min(READ_AHEAD + 1, total, self._cache.capacity))
        ]
        return next((index for index in ahead if index not in self._cache), None)
