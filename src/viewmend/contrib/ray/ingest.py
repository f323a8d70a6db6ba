"""The ingest: reads a source for other processes, and computes the hull of each frame once for all of them."""

import logging
import math
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from viewmend.contrib.ray.shared_frame import SharedFrame
from viewmend.geometry.hull import HullConfig
from viewmend.live.frame_source import FrameSource, RigInfo, SourceStatus, Span
from viewmend.models.base import Inpainter
from viewmend.types import MultiViewFrame
from viewmend.utils.heap import HeapTrimmer

LEAD_S = 2.0
"""The frames of the edge are prepared for this many seconds after a process reported that the edge
is watched."""
LEAD_TICK_S = 0.005
"""The edge is checked at this interval, in seconds, while it is watched."""

log = logging.getLogger("viewmend.live")


@dataclass(frozen=True)
class SourceState:
    """The state of the source, as the rendering processes need it."""

    version: int
    """Grows with every change."""
    source: str
    """Identifies the rig and the ingest process; frame indices belong to it."""
    status: SourceStatus
    span: Span
    rig: RigInfo | None
    edge: float
    """Position of the viewers that follow the edge: while it is watched, the last frame that was
    prepared for them."""
    spread_ms: float | None
    camera_counts: dict[str, dict[str, int]]


@runtime_checkable
class IngestLink(Protocol):
    """The connection from a rendering process to the ingest. Both calls block, and are made on threads.

    A ConnectionError means that the ingest process has ended; it may be restarted.
    """

    def state(self, known: int, wait_s: float, watched: bool) -> SourceState:
        """The state as soon as its version is not the `known` one, and after `wait_s` in any case.

        While a caller reports that the edge is `watched`, its frames are prepared without being requested.
        """
        ...

    def frame(self, index: int, wait_s: float) -> tuple[str, SharedFrame] | None:
        """The source's identifier and a frame; None if it is not available after `wait_s`."""
        ...


@dataclass(frozen=True)
class PreparedFrame:
    """A frame that the ingest has prepared."""

    source: str
    """Identifies the rig and the ingest process."""
    reference: Any
    """The result of the ingest's `put`."""
    size_bytes: int


class Ingest:
    """Reads a source for other processes. Any number of threads may call it.

    All viewers that follow the edge get the same frames: a thread prepares them one after the
    other, each time the one that is the edge at that moment.
    """

    def __init__(
        self,
        source: FrameSource,
        inpainter: Inpainter,
        hull: HullConfig,
        memory_mb: float,
        put: Callable[[SharedFrame], Any] = lambda shared: shared,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start reading."""
        self._source = source
        self._inpainter = inpainter
        self._hull = hull
        self._put = put
        self._now = now
        self._max_bytes = 1e6 * memory_mb
        self._process = secrets.token_hex(8)
        self._changed = threading.Condition()
        self._version = 0
        self._advanced_at = now()
        self._watched_at = -math.inf
        self._led = -1
        """The last frame of the edge that was prepared."""
        self._kept: OrderedDict[int, PreparedFrame] = OrderedDict()
        """The prepared frames, the least recently used first."""
        self._preparing = threading.Lock()
        source.changed = self._notify
        source.start()
        threading.Thread(target=self._lead, name="edge", daemon=True).start()

    def state(self, known: int, wait_s: float, watched: bool) -> SourceState:
        """See `IngestLink.state`."""
        source = self._source
        with self._changed:
            if watched:
                self._watched_at = self._now()
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._version != known, wait_s)
            span = source.span
            edge = self._advance_edge()
            if self._is_watched and span.first <= self._led < span.end:
                edge = float(self._led)
            return SourceState(
                version=self._version,
                source=self._source_id,
                status=source.status,
                span=span,
                rig=source.rig,
                edge=edge,
                spread_ms=source.spread_ms,
                camera_counts=source.camera_counts(),
            )

    def frame(self, index: int, wait_s: float) -> tuple[str, Any] | None:
        """See `IngestLink.frame`; returns the reference that `put` returned instead of the frame."""
        kept = self._find(index)
        if kept is not None:
            return kept
        with self._changed:
            self._changed.wait_for(lambda: self._source.read(index) is not None, wait_s)
        frame = self._source.read(index)
        if frame is None:
            return None
        with self._preparing:  # one after the other: each uses all cores
            return self._find(index) or self._prepare(frame)

    def _advance_edge(self) -> float:
        """The present edge, whether its frame is prepared or not."""
        now = self._now()
        source = self._source
        source.recording.advance(now - self._advanced_at, source.span)
        self._advanced_at = now
        return source.edge

    @property
    def _is_watched(self) -> bool:
        return self._now() - self._watched_at < LEAD_S

    def _lead(self) -> None:
        """Prepare the frames of the edge while it is watched, as many as the machine can."""
        trimmer = HeapTrimmer()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_watched, LEAD_S)
                index = int(self._advance_edge())
                if not self._is_watched or index == self._led or index < 0:
                    self._changed.wait(LEAD_TICK_S)
                    continue
            try:
                prepared = self.frame(index, LEAD_S)
            except Exception as error:  # the thread goes on; a request for the frame raises the error, too
                log.warning("while preparing frame %d: %s", index, error)
                prepared = None
            trimmer.trim_if_due(idle=False)
            if prepared is not None:
                self._led = index
                self._notify()

    @property
    def _source_id(self) -> str:
        rig = self._source.rig
        return f"{self._process} {-1 if rig is None else rig.number}"

    def _notify(self) -> None:
        with self._changed:
            self._version += 1
            self._changed.notify_all()

    def _find(self, index: int) -> tuple[str, Any] | None:
        with self._changed:
            if index not in self._kept:
                return None
            self._kept.move_to_end(index)
            kept = self._kept[index]
            return kept.source, kept.reference

    def _prepare(self, frame: MultiViewFrame) -> tuple[str, Any]:
        source_id = self._source_id
        rig = self._source.rig
        shared = SharedFrame.prepare(frame, None if rig is None else rig.bounds, self._hull, self._inpainter)
        reference = self._put(shared)
        with self._changed:
            self._kept[frame.time] = PreparedFrame(source_id, reference, shared.size_bytes)
            while (
                len(self._kept) > 1 and sum(kept.size_bytes for kept in self._kept.values()) > self._max_bytes
            ):
                self._kept.popitem(last=False)
        return source_id, reference
