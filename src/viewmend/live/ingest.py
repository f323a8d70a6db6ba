"""The one process that reads a rig: every time is read, carved and encoded once, for all who render."""

import logging
import math
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from viewmend.geometry.hull import HullConfig
from viewmend.inpainting.protocol import ViewInpainter
from viewmend.live.clock import Span, edge_of
from viewmend.live.frames import FrameSupply, Rig, SourceStatus
from viewmend.live.memory import HeapTrimmer
from viewmend.live.shared_time import SharedTime
from viewmend.views import MultiViewFrame

WATCHED_S = 2.0
"""The edge's times are made for so long after somebody said that they are watched."""
LEAD_TICK_S = 0.005

log = logging.getLogger("viewmend.live")


@dataclass(frozen=True)
class SourceState:
    """What those who render are told of the source."""

    version: int
    """Grows with every change."""
    source: str
    """Tells a rig of this process from any other; the numbers of times are a rig's own."""
    status: SourceStatus
    span: Span
    rig: Rig | None
    edge: float
    """The position of those who follow the edge: while they watch, the last time that was made for them."""
    spread_ms: float | None
    camera_counts: dict[str, dict[str, int]]


@runtime_checkable
class IngestLink(Protocol):
    """The way from a process that renders to the one that reads. Both calls wait, and are made by threads.

    ConnectionError says that the other process is away; it may come back.
    """

    def state(self, known: int, wait_s: float, watched: bool) -> SourceState:
        """The state as soon as its version is not the `known` one; after `wait_s` in any case.

        While somebody says that the edge is `watched`, its times are made without being asked for.
        """
        ...

    def time(self, at: int, wait_s: float) -> tuple[str, SharedTime] | None:
        """A time, and the source it is of; None where it is not there after `wait_s`."""
        ...


class Ingest:
    """Reads a supply for others. Any number of threads may call it.

    All who follow the edge see the same times: a thread makes them, one after the other, each of what is the edge then.
    """

    def __init__(
        self,
        supply: FrameSupply,
        inpainter: ViewInpainter,
        hull: HullConfig,
        memory_mb: float,
        put: Callable[[SharedTime], Any] = lambda shared: shared,
    ) -> None:
        """Begin to read.

        Args:
            supply: where frames come from.
            inpainter: what encodes the cameras.
            hull: how the proxy is carved.
            memory_mb: what the times that are kept may take; those asked for longest ago are dropped.
            put: puts a time where others can read it, and gives what they find it by.
        """
        self._supply, self._inpainter, self._hull, self._put = supply, inpainter, hull, put
        self._limit = 1e6 * memory_mb
        self._process = secrets.token_hex(8)
        self._changed = threading.Condition()
        self._version = 0
        self._last, self._watched = time.monotonic(), -math.inf
        self._led = -1
        """The edge's time that was made last."""
        self._kept: OrderedDict[int, tuple[str, Any, int]] = OrderedDict()
        """Each time with its source, what it is found by, and its bytes; the one asked for longest ago first."""
        self._making = threading.Lock()
        supply.changed = self._tell
        supply.start()
        threading.Thread(target=self._lead, name="edge", daemon=True).start()

    def state(self, known: int, wait_s: float, watched: bool) -> SourceState:
        """As `IngestLink.state`."""
        supply = self._supply
        with self._changed:
            if watched:
                self._watched = time.monotonic()
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._version != known, wait_s)
            span, edge = supply.span, self._edge()
            if self._is_watched and span.first <= self._led < span.end:
                edge = float(self._led)
            counts = supply.camera_counts()
            return SourceState(
                self._version, self._source, supply.status, span, supply.rig, edge, supply.spread_ms, counts
            )

    def time(self, at: int, wait_s: float) -> tuple[str, Any] | None:
        """As `IngestLink.time`, with what `put` gave in place of the time."""
        kept = self._at_hand(at)
        if kept is None and (frame := self._frame(at, wait_s)) is not None:
            with self._making:  # one after the other: each uses what the processor has
                kept = self._at_hand(at) or self._made(frame)
        return kept

    def _edge(self) -> float:
        """Where the edge is now, whether that time is made or not."""
        now, supply = time.monotonic(), self._supply
        supply.recording.advance(now - self._last, supply.span)
        self._last = now
        return edge_of(supply.span, supply.recording)

    @property
    def _is_watched(self) -> bool:
        return time.monotonic() - self._watched < WATCHED_S

    def _lead(self) -> None:
        """Make the edge's times while somebody watches; how many of them is how fast this machine is."""
        trimmer = HeapTrimmer()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_watched, WATCHED_S)
                at = int(self._edge())
                if not self._is_watched or at == self._led or at < 0:
                    self._changed.wait(LEAD_TICK_S)
                    continue
            try:
                made = self.time(at, WATCHED_S)
            except Exception as error:  # nothing may end the thread; who asks for the time is told
                log.warning("while making time %d: %s", at, error)
                made = None
            trimmer.when_due(idle=False)
            if made is not None:
                self._led = at
                self._tell()

    @property
    def _source(self) -> str:
        rig = self._supply.rig
        return f"{self._process} {-1 if rig is None else rig.number}"

    def _tell(self) -> None:
        with self._changed:
            self._version += 1
            self._changed.notify_all()

    def _frame(self, at: int, wait_s: float) -> MultiViewFrame | None:
        with self._changed:
            self._changed.wait_for(lambda: self._supply.read(at) is not None, wait_s)
        return self._supply.read(at)

    def _at_hand(self, at: int) -> tuple[str, Any] | None:
        with self._changed:
            if at not in self._kept:
                return None
            self._kept.move_to_end(at)
            return self._kept[at][:2]

    def _made(self, frame: MultiViewFrame) -> tuple[str, Any]:
        source, rig = self._source, self._supply.rig
        shared = SharedTime.of(frame, None if rig is None else rig.bounds, self._hull, self._inpainter)
        found_by = self._put(shared)
        with self._changed:
            self._kept[frame.time] = source, found_by, shared.bytes
            while sum(size for *_, size in self._kept.values()) > self._limit and len(self._kept) > 1:
                self._kept.popitem(last=False)
        return source, found_by
