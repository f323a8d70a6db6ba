"""A live rig: frames are pushed as they happen."""

import threading
from collections.abc import Callable
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.live.clock import Span
from viewmend.live.frames import FrameStore, Rig, SourceStatus, Supply
from viewmend.views import MultiViewFrame


class Pushed(Supply):
    """A live rig: frames as they are pushed, numbered as they come; the oldest are forgotten."""

    def __init__(self, fps: float | None = None, memory_mb: float = 500.0) -> None:
        self.changed: Callable[[], None] = lambda: None
        self._fps = fps
        self._store = FrameStore(memory_mb, by_use=False)
        self._lock = threading.Lock()
        self._status = SourceStatus(error="waiting for a rig to push frames")
        self._rig: Rig | None = None
        self._span = Span(live=True, fps=fps or 15.0)

    def start(self) -> None:
        """Nothing to do: frames come by themselves."""

    def stop(self) -> None:
        """Nothing to do."""

    def read(self, time: int) -> MultiViewFrame | None:
        """The frame, None once it is forgotten."""
        with self._lock:
            return self._store.get(time)

    def begin(self, name: str, fps: float, bounds: Bounds | None, up: Float[Tensor, "3"] | None) -> None:
        """A rig has connected. What another one pushed before cannot be asked for any more."""
        with self._lock:
            self._span = replace(self._span, first=self._span.end, fps=self._fps or fps)
            self._status = SourceStatus()
            self._rig = Rig(name, bounds, up, 1 if self._rig is None else self._rig.number + 1)
        self.changed()

    def push(self, frame: MultiViewFrame) -> int:
        """Take a frame in; the number it gets."""
        with self._lock:
            time = self._span.end
            self._store.put(time, frame)
            self._span = replace(self._span, first=max(self._span.first, self._store.oldest), end=time + 1)
            self._status = replace(self._status, state="ready", error=None)
        self.changed()
        return time

    def lost(self) -> None:
        """The rig has gone."""
        self._status = replace(self._status, state="failing", error="the rig has disconnected; waiting for it")
        self.changed()
