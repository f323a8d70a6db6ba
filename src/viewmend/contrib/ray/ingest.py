"""The process that reads a rig: it reads, carves and encodes every frame once, for all processes that render."""

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

WATCHED_S = 2.0
"""The frames of the edge are prepared for this long after a process reported that the edge is watched."""
LEAD_TICK_S = 0.005

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
    """Position of the viewers that follow the edge: while it is watched, the last frame that was prepared for them."""
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


class Ingest:
    """Reads a source for other processes. Any number of threads may call it.

    All viewers that follow the edge get the same frames: a thread prepares them one after the other, each time the one
    that is the edge at that moment.
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
        """Start reading.

        Args:
            source: the frames.
            inpainter: encodes the cameras.
            hull: how the hull is carved.
            memory_mb: memory for prepared frames; the least recently used are dropped.
            put: stores a frame where other processes can read it, and returns a reference to it.
            now: the clock, in seconds.
        """
        self._source, self._inpainter, self._hull, self._put, self._now = source, inpainter, hull, put, now
        self._max_bytes = 1e6 * memory_mb
        self._process = secrets.token_hex(8)
        self._changed = threading.Condition()
        self._version = 0
        self._advanced_at, self._watched_at = now(), -math.inf
        self._led = -1
        """The last frame of the edge that was prepared."""
        self._kept: OrderedDict[int, tuple[str, Any, int]] = OrderedDict()
        """Source, reference and bytes of each prepared frame, the least recently used first."""
        self._preparing = threading.Lock()
        source.changed = self._notify
        source.start()
        threading.Thread(target=self._lead, name="edge", daemon=True).start()

    def state(self, known: int, wait_s: float, watched: bool) -> SourceState:
        """As `IngestLink.state`."""
        source = self._source
        with self._changed:
            if watched:
                self._watched_at = self._now()
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._version != known, wait_s)
            span, edge = source.span, self._advance_edge()
            if self._is_watched and span.first <= self._led < span.end:
                edge = float(self._led)
            counts = source.camera_counts()
            return SourceState(
                self._version, self._source_id, source.status, span, source.rig, edge, source.spread_ms, counts
            )

    def frame(self, index: int, wait_s: float) -> tuple[str, Any] | None:
        """As `IngestLink.frame`, with the reference that `put` returned instead of the frame."""
        kept = self._find(index)
        if kept is None and (frame := self._read(index, wait_s)) is not None:
            with self._preparing:  # one after the other: each uses all cores
                kept = self._find(index) or self._prepare(frame)
        return kept

    def _advance_edge(self) -> float:
        """The present edge, whether its frame is prepared or not."""
        now, source = self._now(), self._source
        source.recording.advance(now - self._advanced_at, source.span)
        self._advanced_at = now
        return source.edge

    @property
    def _is_watched(self) -> bool:
        return self._now() - self._watched_at < WATCHED_S

    def _lead(self) -> None:
        """Prepare the frames of the edge while it is watched, as many as the machine can."""
        trimmer = HeapTrimmer()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_watched, WATCHED_S)
                index = int(self._advance_edge())
                if not self._is_watched or index == self._led or index < 0:
                    self._changed.wait(LEAD_TICK_S)
                    continue
            try:
                prepared = self.frame(index, WATCHED_S)
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

    def _read(self, index: int, wait_s: float) -> MultiViewFrame | None:
        with self._changed:
            self._changed.wait_for(lambda: self._source.read(index) is not None, wait_s)
        return self._source.read(index)

    def _find(self, index: int) -> tuple[str, Any] | None:
        with self._changed:
            if index not in self._kept:
                return None
            self._kept.move_to_end(index)
            return self._kept[index][:2]

    def _prepare(self, frame: MultiViewFrame) -> tuple[str, Any]:
        source_id, rig = self._source_id, self._source.rig
        shared = SharedFrame.prepare(frame, None if rig is None else rig.bounds, self._hull, self._inpainter)
        reference = self._put(shared)
        with self._changed:
            self._kept[frame.time] = source_id, reference, shared.size_bytes
            while sum(size for *_, size in self._kept.values()) > self._max_bytes and len(self._kept) > 1:
                self._kept.popitem(last=False)
        return source_id, reference
