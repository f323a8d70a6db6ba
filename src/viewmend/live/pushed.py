"""A live rig: frames as they happen, pushed by the rig."""

import threading
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.live.clock import Span
from viewmend.live.frames import FrameCache, FrameSupply, Rig, SourceStatus
from viewmend.views import MultiViewFrame


class LiveFrames(FrameSupply):
    """Frames as they happen, numbered as they come; the oldest are forgotten."""

    def __init__(self, fps: float | None = None, memory_mb: float = 500.0) -> None:
        super().__init__(Span(live=True, fps=fps or 15.0))
        self._fps = fps
        self._cache = FrameCache(memory_mb, by_last_use=False)
        self._lock = threading.Lock()

    def read(self, time: int) -> MultiViewFrame | None:
        """The frame, None once it is forgotten."""
        with self._lock:
            return self._cache.get(time)

    def begin(self, name: str, fps: float, bounds: Bounds | None, up: Float[Tensor, "3"] | None) -> None:
        """A rig is there. What another one pushed before cannot be asked for any more."""
        with self._lock:
            self.span = replace(self.span, first=self.span.end, fps=self._fps or fps)
            self.status = SourceStatus()
            self.rig = Rig(name, bounds, up, 1 if self.rig is None else self.rig.number + 1)
        self.changed()

    def push(self, frame: MultiViewFrame) -> int:
        """Take a frame in; the number it gets."""
        with self._lock:
            time = self.span.end
            self._cache.put(time, frame)
            self.span = replace(self.span, first=max(self.span.first, self._cache.oldest), end=time + 1)
            self.status = replace(self.status, state="ready", error=None)
        self.changed()
        return time


class PushedFrames(LiveFrames):
    """A live rig that pushes its frames."""

    def __init__(self, fps: float | None = None, memory_mb: float = 500.0) -> None:
        super().__init__(fps, memory_mb)
        self.status = SourceStatus(error="waiting for a rig to push frames")

    def lost(self) -> None:
        """The rig has gone."""
        self.status = replace(self.status, state="failing", error="the rig has disconnected; waiting for it")
        self.changed()
