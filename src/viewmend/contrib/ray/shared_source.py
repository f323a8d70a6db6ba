"""The source of a rendering process, which fetches its frames from an ingest."""

import logging
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace

from viewmend.contrib.ray.ingest import IngestLink, SourceState
from viewmend.contrib.ray.shared_frame import SharedFrame
from viewmend.frame_cache import CachedFrame
from viewmend.live.frame_source import FrameSource, Span
from viewmend.types import MultiViewFrame

WAIT_S = 1.0
"""One request to the ingest waits for at most this many seconds."""
RETRY_S = 0.2
"""A request is repeated this many seconds after the ingest process has ended."""
WATCHED_S = 1.0
"""The edge counts as watched for this many seconds after its frame was requested."""
FRESH_S = 0.5
"""A frame that was not requested again for this many seconds is no longer fetched."""
INGEST_ENDED = "the process that reads the cameras has ended; it is being restarted"

log = logging.getLogger("viewmend.live")


class SharedSource(FrameSource):
    """Fetches requested frames from an ingest, and the following one with them.

    One thread follows the ingest's state, another one fetches frames.
    """

    def __init__(
        self, ingest: IngestLink, memory_mb: float, now: Callable[[], float] = time.monotonic
    ) -> None:
        """Follow an ingest; `memory_mb` bounds the frames that are kept in shared memory."""
        super().__init__(Span())
        self._ingest = ingest
        self._max_bytes = 1e6 * memory_mb
        self._now = now
        self._source_id = ""
        self._counts: dict[str, dict[str, int]] = {}
        self._lock = threading.Condition()
        self._kept: OrderedDict[int, SharedFrame] = OrderedDict()
        self._wanted: dict[int, float] = {}
        """Missing frames and when each was requested last; the first has waited longest."""
        self._ahead: int | None = None
        """The frame that is fetched while no other is requested."""
        self._watched_at = -math.inf
        """When the edge's frame was requested last."""
        self.recording.playing = False  # the ingest sets the position
        self._stopped = threading.Event()
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._follow, self._fetch)]

    def camera_counts(self) -> dict[str, dict[str, int]]:
        """The ingest's counts."""
        return self._counts

    def start(self) -> None:
        """Start following and fetching."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop after the requests that are under way."""
        self._stopped.set()
        with self._lock:
            self._lock.notify_all()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=WAIT_S + 2)

    def read(self, index: int) -> MultiViewFrame | None:
        """The frame, or None while it is being fetched."""
        shared = self._find(index)
        return None if shared is None else shared.frame

    def read_cached(self, index: int) -> CachedFrame | None:
        """The frame with its hull and encodings, or None while it is being fetched."""
        shared = self._find(index)
        return None if shared is None else shared.cached

    def _find(self, index: int) -> SharedFrame | None:
        with self._lock:
            if index == int(self.edge):
                self._watched_at = self._now()
            if index in self._kept:
                self._kept.move_to_end(index)
            elif self.span.first <= index < self.span.end:
                self._wanted[index] = self._now()
                self._lock.notify_all()
            return self._kept.get(index)

    def _follow(self) -> None:
        known = -1
        while not self._stopped.is_set():
            try:
                state = self._ingest.state(known, WAIT_S, self._is_edge_watched)
            except ConnectionError:
                if self.status.error != INGEST_ENDED:
                    log.warning("while reading: %s", INGEST_ENDED)
                self.status = replace(self.status, state="failing", error=INGEST_ENDED)
                self.changed()
                self._stopped.wait(RETRY_S)
                known = -1
                continue
            self.recording.position = state.edge
            if state.version != known or state.source != self._source_id:
                known = state.version
                self._apply(state)
                self.changed()

    def _apply(self, state: SourceState) -> None:
        with self._lock:
            if state.source != self._source_id or self.span.end <= self.span.first:
                self.rig = state.rig  # complete once there is a frame
            if state.source != self._source_id:
                self._source_id = state.source
                self._kept.clear()
                self._wanted = {}
                self._ahead = None
            self.status = state.status
            span = state.span
            # Frames of a live rig that are not prepared yet cannot be requested.
            self.span = (
                replace(span, end=int(state.edge) + 1) if span.live and state.edge >= span.first else span
            )
            if self._is_edge_watched and int(state.edge) not in self._kept:
                self._ahead = int(state.edge)
                self._lock.notify_all()
            self.spread_ms = state.spread_ms
            self._counts = state.camera_counts

    @property
    def _is_edge_watched(self) -> bool:
        return self._now() - self._watched_at < WATCHED_S

    def _fetch(self) -> None:
        while not self._stopped.is_set():
            with self._lock:
                oldest = self._now() - FRESH_S
                self._wanted = {index: asked for index, asked in self._wanted.items() if asked > oldest}
                index = next(iter(self._wanted), self._ahead)  # the frame that has waited longest
                if index is None:
                    self._lock.wait(WAIT_S)
                    continue
            try:
                found = self._ingest.frame(index, WAIT_S)
            except ConnectionError:  # reported by the other thread
                self._stopped.wait(RETRY_S)
                continue
            with self._lock:
                self._keep(index, found)
            self.changed()

    def _keep(self, index: int, found: tuple[str, SharedFrame] | None) -> None:
        was_wanted = self._wanted.pop(index, None) is not None
        self._ahead = None
        if found is None:
            return
        source_id, shared = found
        if source_id != self._source_id:
            return
        self._kept[index] = shared
        while len(self._kept) > 2 and sum(kept.size_bytes for kept in self._kept.values()) > self._max_bytes:
            self._kept.popitem(last=False)
        following = index + 1 if index + 1 < self.span.end or not self.span.complete else self.span.first
        is_edge = index == int(self.edge)  # the ingest announces the frame that follows it
        if was_wanted and not is_edge and following not in self._kept and following < self.span.end:
            self._ahead = following
