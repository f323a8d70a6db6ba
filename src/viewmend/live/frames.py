"""Frames of a recording, read or generated ahead on a thread of their own, and what all supplies of frames share."""

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

from viewmend.capture.source import CaptureSource
from viewmend.geometry.bounds import Bounds
from viewmend.live.clock import Clock, Span
from viewmend.observation import Observation
from viewmend.own_pages import to_own_pages
from viewmend.views import MultiViewFrame

RETRY_S = 1.0
"""A source that failed is tried again after this long."""
AHEAD = 3
"""Frames that are read before they are asked for."""

log = logging.getLogger("viewmend.live")


@dataclass(frozen=True)
class Rig:
    """What is known of a source's cameras and stage."""

    name: str
    bounds: Bounds | None
    up: Float[Tensor, "3"] | None
    number: int = 0
    """Tells a rig from the one that was connected before."""


@dataclass(frozen=True)
class SourceStatus:
    """Whether a source works."""

    state: str = "loading"
    """One of loading, ready and failing."""
    error: str | None = None
    """What people are told of it."""


class FrameSupply(ABC):
    """Where the service takes frames from."""

    def __init__(self, span: Span) -> None:
        self.changed: Callable[[], None] = lambda: None
        """Called, on any thread, when there is more to see."""
        self.status = SourceStatus()
        self.rig: Rig | None = None
        """What is known of the cameras; None before the source is open."""
        self.span = span
        """The times that can be asked for."""
        self.spread_ms: float | None = None
        """How far apart the newest frame's pictures were taken, where this machine reads the cameras itself."""
        self.recording = Clock()
        """The edge of a recording: one position for all who follow it."""
        self.recording.live = False

    def camera_counts(self) -> dict[str, dict[str, int]]:
        """What was counted of each camera, where this machine reads them itself; "up" is 1 while it is there."""
        return {}

    @abstractmethod
    def read(self, time: int) -> MultiViewFrame | None:
        """The frame; None while it is not there. It never waits."""

    def made(self, time: int) -> Observation | None:
        """What another process has made of a frame that `read` gives; None where nobody has."""
        return None

    def start(self) -> None:  # noqa: B027
        """Begin to read; nothing to do where frames come by themselves."""

    def stop(self) -> None:  # noqa: B027
        """End, and let go of threads."""


class FrameCache:
    """Frames by time, bounded by bytes.

    The oldest are dropped first, or with `by_last_use` those that were asked for longest ago.
    """

    def __init__(self, memory_mb: float, by_last_use: bool) -> None:
        self._by_last_use = by_last_use
        self._limit = 1e6 * memory_mb
        self._frames: OrderedDict[int, MultiViewFrame] = OrderedDict()
        self._bytes = 0

    def __contains__(self, time: int) -> bool:
        return time in self._frames

    def put(self, time: int, frame: MultiViewFrame) -> None:
        """Keep a frame as that of this time."""
        frame = to_own_pages(replace(frame, depth=None, time=time))
        self._frames[time] = frame
        self._bytes += _size(frame)
        while self._bytes > self._limit and len(self._frames) > 1:
            self._bytes -= _size(self._frames.popitem(last=False)[1])

    def get(self, time: int) -> MultiViewFrame | None:
        """The frame, None where it is not at hand."""
        if self._by_last_use and time in self._frames:
            self._frames.move_to_end(time)
        return self._frames.get(time)

    @property
    def room(self) -> int:
        """How many frames like the newest fit in."""
        newest = next(reversed(self._frames.values()), None)
        return 1 if newest is None else max(1, int(self._limit // _size(newest)))

    @property
    def oldest(self) -> int:
        """The first time at hand."""
        return min(self._frames, default=0)


def _size(frame: MultiViewFrame) -> int:
    return frame.rgb.numel() + (0 if frame.mask is None else frame.mask.numel())


class ReadAhead(FrameSupply):
    """A recording, read on a thread of low priority: the frame that was asked for, and the next ones.

    The frames of a `generated` source are made one after the other (the studio); only those that are there can be
    asked for.
    """

    def __init__(
        self,
        open_source: Callable[[], CaptureSource],
        fps: float | None = None,
        generated: bool = False,
        memory_mb: float = 1500.0,
    ) -> None:
        super().__init__(Span())
        self._open, self._fps, self._generated = open_source, fps, generated
        self._cache = FrameCache(memory_mb, by_last_use=True)
        self._lock = threading.Condition()
        self._wanted = 0
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="frames", daemon=True)

    def start(self) -> None:
        """Open the source and read ahead."""
        self._thread.start()

    def stop(self) -> None:
        """End after the frame that is being read."""
        with self._lock:
            self._stopped = True
            self._lock.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=3)

    def read(self, time: int) -> MultiViewFrame | None:
        """The frame; None while it is on its way."""
        with self._lock:
            if self._wanted != time:
                self._wanted = time
                self._lock.notify_all()
            return self._cache.get(time)

    def _run(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # Linux counts a thread as a process here
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        source: CaptureSource | None = None
        while not self._stopped:
            try:
                if source is None:
                    source = self._opened()
                self._step(source)
            except Exception as error:  # whatever a source does wrong, it is said, and tried again
                self._failed(f"{type(error).__name__}: {error}"[:400])
                with self._lock:
                    self._lock.wait_for(lambda: self._stopped, RETRY_S)

    def _failed(self, said: str) -> None:
        """Tell viewers by the status; the terminal too, once until it works again or something else fails."""
        if self.status.error != said:
            log.warning("while reading: %s", said)
        self.status = replace(self.status, state="failing", error=said)
        self.changed()

    def _opened(self) -> CaptureSource:
        source = self._open()
        total = len(source.frame_ids)
        fps = (self._fps or source.fps or 0.0) if total > 1 else 0.0
        self.span = Span(0, 0 if self._generated else total, total, fps)
        self.rig = Rig(source.name, source.bounds, source.up)
        return source

    def _step(self, source: CaptureSource) -> None:
        with self._lock:
            time = self._next()
            if time is None:
                self._lock.wait_for(lambda: self._stopped or self._next() is not None)
                return
        frame = source.read(time)
        with self._lock:
            self._cache.put(time, frame)
            if self._generated:
                self.span = replace(self.span, end=max(self.span.end, time + 1))
            self.status = replace(self.status, state="ready", error=None)
        self.changed()

    def _next(self) -> int | None:
        """The time to read next."""
        total = self.span.total or 0
        if self._generated and self.span.end < total:
            return self.span.end
        soon = [(self._wanted + n) % max(1, total) for n in range(min(AHEAD + 1, total, self._cache.room))]
        return next((time for time in soon if time not in self._cache), None)
