"""Frames that processes share: one reads the rig and computes the hull, the others render; arrays are not copied."""

import copyreg
import io
import logging
import math
import pickle
import secrets
import threading
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from viewmend.frame_cache import CachedFrame, cache_frame
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import HullConfig
from viewmend.live.frame_source import FrameSource, RigInfo, SourceStatus, Span
from viewmend.models.base import ContextProvider, Inpainter
from viewmend.types import MultiViewFrame
from viewmend.utils.heap import HeapTrimmer
from viewmend.utils.tensors import size_bytes


@dataclass(frozen=True)
class SharedFrame:
    """A frame and everything that is computed from it whatever the view.

    It is pickled as a few hundred bytes and out-of-band arrays (pickle protocol 5). If these are kept in shared memory,
    as in Ray's object store, the tensors of all processes lie there, read-only.
    """

    frame: MultiViewFrame
    cached: CachedFrame | None
    """The frame with its hull, its depth in each camera, and the inpainter's encodings; None if no hull can be carved,
    in which case the renderer raises the reason again."""

    @classmethod
    def prepare(
        cls, frame: MultiViewFrame, bounds: Bounds | None, hull: HullConfig, inpainter: Inpainter
    ) -> "SharedFrame":
        """Carve the hull of a frame, render its depth in the cameras, and encode these with the inpainter."""
        try:
            cached = cache_frame(frame, bounds, hull)
        except ValueError:
            return cls(frame, None)
        cached.pop_geometry_ms()  # it was spent elsewhere
        views = cached.context(frame.cameras.names)
        if views is not None:
            context = ContextProvider(lambda _, names: cached.context(names), memory=lambda _: cached.encoded)
            inpainter.encode_cameras(views, context)
        return cls(frame, cached)

    @cached_property
    def size_bytes(self) -> int:
        """Bytes of all arrays."""
        return size_bytes([self.frame.rgb, self.frame.mask]) if self.cached is None else self.cached.size

    def __reduce__(self) -> tuple[Any, ...]:
        content, buffers = io.BytesIO(), []
        pickler = pickle.Pickler(content, 5, buffer_callback=buffers.append)
        pickler.dispatch_table = copyreg.dispatch_table | {Tensor: _as_array}
        pickler.dump((self.frame, self.cached))
        return _unpickle, (content.getvalue(), buffers)


def _as_array(tensor: Tensor) -> tuple[Any, ...]:
    """A tensor for pickle: an array, whose buffer is out of band."""
    return torch.from_numpy, (tensor.detach().contiguous().numpy(),)


def _unpickle(content: bytes, buffers: Sequence[Any]) -> SharedFrame:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")  # they are only read
        return SharedFrame(*pickle.loads(content, buffers=buffers))


LEAD_S = 2.0
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
        """Start reading."""
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
            now = source.status, span, source.rig, edge, source.spread_ms, source.camera_counts()
            return SourceState(self._version, self._source_id, *now)

    def frame(self, index: int, wait_s: float) -> tuple[str, Any] | None:
        """As `IngestLink.frame`, with the reference that `put` returned instead of the frame."""
        if (kept := self._find(index)) is not None:
            return kept
        with self._changed:
            self._changed.wait_for(lambda: self._source.read(index) is not None, wait_s)
        if (frame := self._source.read(index)) is None:
            return None
        with self._preparing:  # one after the other: each uses all cores
            return self._find(index) or self._prepare(frame)

    def _advance_edge(self) -> float:
        """The present edge, whether its frame is prepared or not."""
        now, source = self._now(), self._source
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


WAIT_S = 1.0
"""How long one request to the ingest waits."""
RETRY_S = 0.2
"""Pause before a request is repeated after the ingest process has ended."""
WATCHED_S = 1.0
"""The edge counts as watched for this long after its frame was requested."""
FRESH_S = 0.5
"""A frame that was not requested again for this long is no longer fetched."""
INGEST_ENDED = "the process that reads the cameras has ended; it is being restarted"


class SharedSource(FrameSource):
    """Fetches requested frames from an ingest, and the following one with them.

    One thread follows the ingest's state, another one fetches frames.
    """

    def __init__(self, ingest: IngestLink, memory_mb: float, now: Callable[[], float] = time.monotonic) -> None:
        """Follow an ingest; `memory_mb` bounds the frames that are kept in shared memory."""
        super().__init__(Span())
        self._ingest, self._max_bytes, self._now = ingest, 1e6 * memory_mb, now
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
            if state.source != self._source_id:
                self._source_id, self.rig = state.source, state.rig
                self._kept.clear()
                self._wanted, self._ahead = {}, None
            span, self.status = state.span, state.status
            # Frames of a live rig that are not prepared yet cannot be requested.
            self.span = replace(span, end=int(state.edge) + 1) if span.live and state.edge >= span.first else span
            if self._is_edge_watched and int(state.edge) not in self._kept:
                self._ahead = int(state.edge)
                self._lock.notify_all()
            self.spread_ms, self._counts = state.spread_ms, state.camera_counts

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
        was_wanted, self._ahead = self._wanted.pop(index, None) is not None, None
        if found is None or found[0] != self._source_id:
            return
        self._kept[index] = found[1]
        while len(self._kept) > 2 and sum(shared.size_bytes for shared in self._kept.values()) > self._max_bytes:
            self._kept.popitem(last=False)
        following = index + 1 if index + 1 < self.span.end or not self.span.complete else self.span.first
        is_edge = index == int(self.edge)  # the ingest announces the frame that follows it
        if was_wanted and not is_edge and following not in self._kept and following < self.span.end:
            self._ahead = following
