"""Frames that another process reads: they come with their hulls, and lie in memory that processes share."""

import logging
import math
import threading
import time
from collections import OrderedDict
from dataclasses import replace

from viewmend.live.clock import Span, edge_of
from viewmend.live.frames import FrameSupply
from viewmend.live.ingest import IngestLink, SourceState
from viewmend.live.shared_time import SharedTime
from viewmend.observation import Observation
from viewmend.views import MultiViewFrame

WAIT_S = 1.0
"""How long one question waits for its answer."""
RETRY_S = 0.2
"""A process that is away is asked again after this long."""
WATCHED_S = 1.0
"""For so long the edge counts as watched."""
FRESH_S = 0.5
"""What nobody asked for again within this time is not fetched any more."""
AWAY = "the process that reads the cameras has ended; it is started again"

log = logging.getLogger("viewmend.live")


class SharedFrames(FrameSupply):
    """What an ingest reads, fetched when it is asked for, and the next time with it.

    Two threads ask: one what there is, one for times.
    """

    def __init__(self, ingest: IngestLink, memory_mb: float) -> None:
        """Follow an ingest; `memory_mb` is what the times that are kept may take of the shared memory."""
        super().__init__(Span())
        self._ingest, self._limit = ingest, 1e6 * memory_mb
        self._source = ""
        self._counts: dict[str, dict[str, int]] = {}
        self._lock = threading.Condition()
        self._kept: OrderedDict[int, SharedTime] = OrderedDict()
        self._wanted: dict[int, float] = {}
        """Times that are not here, and when each was asked for last; the first has waited longest."""
        self._ahead: int | None = None
        """What is fetched while nothing is wanted."""
        self._watched = -math.inf
        """When the edge's time was asked for last."""
        self.recording.playing = False  # it is where the ingest says
        self._stopped = False
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._follow, self._fetch)]

    def camera_counts(self) -> dict[str, dict[str, int]]:
        """What the ingest counts."""
        return self._counts

    def start(self) -> None:
        """Begin to ask."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End after the questions that are open."""
        with self._lock:
            self._stopped = True
            self._lock.notify_all()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=WAIT_S + 2)

    def read(self, time: int) -> MultiViewFrame | None:
        """The frame; None while it is on its way."""
        shared = self._find(time)
        return None if shared is None else shared.frame

    def made(self, time: int) -> Observation | None:
        """The frame with its hull, and what was encoded of it."""
        shared = self._find(time)
        return None if shared is None else shared.observation()

    def _find(self, at: int) -> SharedTime | None:
        with self._lock:
            if at == int(edge_of(self.span, self.recording)):
                self._watched = time.monotonic()
            if at in self._kept:
                self._kept.move_to_end(at)
            elif self.span.first <= at < self.span.end:
                self._wanted[at] = time.monotonic()
                self._lock.notify_all()
            return self._kept.get(at)

    def _follow(self) -> None:
        known = -1
        while not self._stopped:
            try:
                state = self._ingest.state(known, WAIT_S, self._is_edge_watched)
            except ConnectionError:
                self._lose()
                time.sleep(RETRY_S)
                known = -1
                continue
            self.recording.position = state.edge
            if state.version != known or state.source != self._source:
                known = state.version
                self._take(state)
                self.changed()

    def _lose(self) -> None:
        if self.status.error != AWAY:
            log.warning("while reading: %s", AWAY)
        self.status = replace(self.status, state="failing", error=AWAY)
        self.changed()

    def _take(self, state: SourceState) -> None:
        with self._lock:
            if state.source != self._source:
                self._source, self.rig = state.source, state.rig
                self._kept.clear()
                self._wanted, self._ahead = {}, None
            span, self.status = state.span, state.status
            # What has happened and is not made yet is nobody's to see.
            self.span = replace(span, end=int(state.edge) + 1) if span.live and state.edge >= span.first else span
            if self._is_edge_watched and int(state.edge) not in self._kept:
                self._ahead = int(state.edge)
                self._lock.notify_all()
            self.spread_ms, self._counts = state.spread_ms, state.camera_counts

    @property
    def _is_edge_watched(self) -> bool:
        return time.monotonic() - self._watched < WATCHED_S

    def _fetch(self) -> None:
        while not self._stopped:
            with self._lock:
                at = self._next()
                if at is None:
                    self._lock.wait(WAIT_S)
                    continue
            try:
                found = self._ingest.time(at, WAIT_S)
            except ConnectionError:  # which the other thread tells
                time.sleep(RETRY_S)
                continue
            with self._lock:
                self._keep(at, found)
            self.changed()

    def _next(self) -> int | None:
        """The time that has waited longest of those that are still wanted; else the one to have ahead."""
        oldest = time.monotonic() - FRESH_S
        self._wanted = {at: asked for at, asked in self._wanted.items() if asked > oldest}
        return next(iter(self._wanted), self._ahead)

    def _keep(self, at: int, found: tuple[str, SharedTime] | None) -> None:
        was_asked_for, self._ahead = self._wanted.pop(at, None) is not None, None
        if found is None or found[0] != self._source:
            return
        self._kept[at] = found[1]
        while len(self._kept) > 2 and sum(shared.bytes for shared in self._kept.values()) > self._limit:
            self._kept.popitem(last=False)
        soon = at + 1 if at + 1 < self.span.end or not self.span.complete else self.span.first
        is_edge = at == int(edge_of(self.span, self.recording))  # whose next time the ingest leads to
        if was_asked_for and not is_edge and soon not in self._kept and soon < self.span.end:
            self._ahead = soon
