"""A live rig whose cameras this machine reads itself (`viewmend serve rig.toml`), and their synchronisation."""

import logging
import math
import statistics
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.contrib.live_rig.frame_readers import Playback, pictures_of
from viewmend.contrib.live_rig.rig_file import LiveCamera, LiveRig, read_rig
from viewmend.contrib.live_rig.worker import CameraWorker
from viewmend.data.native_capture import CameraImages, pinhole_cameras, stack_images
from viewmend.data.prepare import PreparedCapture, prepare
from viewmend.data.video_clock import video_track
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND
from viewmend.live.frame_source import SourceStatus
from viewmend.live.push import LiveSource
from viewmend.types import MultiViewFrame

AWAY_S = 0.5
"""Frames do not wait for a camera that was silent for this long."""
FOLLOWS = 0.05
"""Fraction of the cameras' median offset by which the time line is corrected at each tick."""
SPARE = 4
"""Number of complete frames that are kept until they are taken; the oldest are dropped."""


@dataclass(frozen=True)
class Taken:
    """One camera's images and when they were taken, on this machine's monotonic clock."""

    taken_s: float
    images: CameraImages


@dataclass
class Together:
    """The cameras' images of one tick."""

    since_s: float
    """When the first of them arrived."""
    taken: dict[str, Taken] = field(default_factory=dict)

    @property
    def spread_s(self) -> float:
        """Time between the first and the last exposure."""
        times = [taken.taken_s for taken in self.taken.values()]
        return max(times) - min(times)


class Aligner:
    """Groups images, which arrive in any order, by tick. One thread at a time.

    Ticks are evenly spaced and follow the cameras' own rate and phase. A tick is complete when each camera has an image
    for it or a later one; cameras that are away do not count. An incomplete tick waits for `wait_s`.
    """

    def __init__(self, names: Sequence[str], interval_s: float, tolerance_s: float, wait_s: float) -> None:
        self._interval_s, self._tolerance_s, self._wait_s = interval_s, tolerance_s, wait_s
        self._origin_s: float | None = None
        """Time of tick 0."""
        self._most = SPARE + math.ceil(wait_s / interval_s)
        self._waiting: dict[int, Together] = {}
        self._done = -math.inf
        self._newest: dict[str, float] = dict.fromkeys(names, -math.inf)
        """The last tick of each camera."""
        self._heard_s: dict[str, float] = dict.fromkeys(names, -math.inf)
        self.counts: dict[str, Counter[str]] = {name: Counter() for name in names}

    def wants(self, taken_s: float, period_s: float) -> bool:
        """Whether an image of a camera with this period is the nearest to a tick."""
        return period_s > self._interval_s / 1.5 or abs(self._nearest(taken_s)[1]) <= period_s / 2

    def _nearest(self, taken_s: float) -> tuple[int, float]:
        """The nearest tick, and the offset from it; the first call sets tick 0."""
        if self._origin_s is None:
            self._origin_s = taken_s
        tick = math.floor((taken_s - self._origin_s) / self._interval_s + 0.5)
        return tick, taken_s - self._origin_s - tick * self._interval_s

    def put(self, name: str, taken: Taken, now_s: float) -> None:
        """Add one camera's image. One that is late, in the future or far from its tick is counted and dropped."""
        counts = self.counts[name]
        self._heard_s[name] = now_s
        if taken.taken_s > now_s + self._interval_s / 2:  # a clock that jumps must not affect the others
            counts["misaligned"] += 1
            return
        tick, offset_s = self._nearest(taken.taken_s)
        self._newest[name] = max(self._newest[name], tick)
        if tick <= self._done:
            counts["late"] += 1
        elif abs(offset_s) > self._tolerance_s:
            counts["misaligned"] += 1
        else:
            together = self._waiting.setdefault(tick, Together(now_s))
            other = together.taken.get(name)
            if other is not None:
                counts["surplus"] += 1
            if other is None or abs(offset_s) < abs(self._nearest(other.taken_s)[1]):
                together.taken[name] = taken
            while len(self._waiting) > self._most:
                self._done = min(self._waiting)
                for name in self._waiting.pop(self._done).taken:
                    self.counts[name]["replaced"] += 1

    def take(self, now_s: float) -> list[Together]:
        """Ticks that are complete or waited long enough, the oldest first."""
        out = []
        present = {name for name, heard_s in self._heard_s.items() if heard_s > now_s - AWAY_S}
        for tick in sorted(self._waiting):
            together = self._waiting[tick]
            if now_s < together.since_s + self._wait_s and any(self._newest[name] < tick for name in present):
                break
            del self._waiting[tick]
            self._done = tick
            for name in together.taken:
                self.counts[name]["used"] += 1
            for name in present - together.taken.keys():
                self.counts[name]["missing"] += 1
            offsets_s = [self._nearest(taken.taken_s)[1] for taken in together.taken.values()]
            assert self._origin_s is not None, "an image has set it"
            self._origin_s += FOLLOWS * statistics.median(offsets_s)
            out.append(together)
        return out


WATCH_S = 1.0
"""Seconds between checks of the rig's file."""
REPORT_S = 30.0
"""Seconds between reports of losses."""
GATHER_S = 3.0
"""How long the first frame, which sets alignment and axes, waits for all cameras."""
WORTH_SAYING = ("late", "missing", "duplicated", "torn", "misaligned", "replaced", "refused")

log = logging.getLogger("viewmend.live")


@dataclass(frozen=True)
class _OneTime:
    """One frame of a rig as a source."""

    name: str
    cameras: Cameras
    bounds: Bounds | None
    up: Float[Tensor, "3"] | None
    frame: MultiViewFrame
    frame_ids: tuple[str, ...] = ("live",)
    fps: float | None = None

    def read(self, time: int) -> MultiViewFrame:
        """The frame."""
        return self.frame


class RigSource(LiveSource):
    """Synchronised frames of the cameras in a `rig.toml`.

    The file is read again when it changes: cameras are added, removed and replaced while the others continue.
    """

    def __init__(
        self,
        path: Path,
        fps: float | None = None,
        memory_mb: float = 500.0,
        max_image_size: int | None = None,
        align: bool = True,
        match_colours: bool = True,
    ) -> None:
        """Read the rig; its cameras are opened by `start`.

        Raises:
            CaptureError: the rig's file, its calibration, a clean plate or a recording cannot be used.
        """
        super().__init__(fps, memory_mb)
        self.status = SourceStatus(error="waiting for the cameras")
        self._path, self._max_image_size, self._align, self._match = path, max_image_size, align, match_colours
        self._lock_cameras = threading.Condition()
        self._playback = Playback()
        self._aligner = Aligner((), 1.0, 1.0, 1.0)
        self._workers: dict[str, CameraWorker] = {}
        self._gather_until: float | None = None
        self._stopped = False
        self._file = _stamp(path)
        self._said: dict[str, dict[str, int]] = {}
        self._prepared: PreparedCapture | None = None
        self._take_on(read_rig(path, max_image_size))
        self._thread = threading.Thread(target=self._run, name="rig", daemon=True)

    def start(self) -> None:
        """Open the cameras."""
        self._begin_rig()
        self._thread.start()

    def stop(self) -> None:
        """End, and close the cameras."""
        self._stopped = True
        with self._lock_cameras:
            self._lock_cameras.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=10)
        for worker in self._workers.values():
            worker.ask_to_stop()
        for worker in self._workers.values():
            worker.stop()

    def camera_counts(self) -> dict[str, dict[str, int]]:
        """Event counts of each camera, and whether it is connected."""
        with self._lock_cameras:
            each = {name: (worker, self._aligner.counts[name]) for name, worker in self._workers.items()}
            return {name: {"up": int(w.up), **w.counts, **counts} for name, (w, counts) in each.items()}

    def _take_on(self, rig: LiveRig) -> None:
        """Switch to this rig. Unchanged cameras continue; new ones are opened by `_begin_rig`.

        Raises:
            CaptureError: a clean plate or a recording cannot be used; nothing has changed then.
        """
        unchanged = {repr(camera) for camera in rig.cameras}
        kept = {name: worker for name, worker in self._workers.items() if repr(worker.camera) in unchanged}
        new = {camera.name: self._worker_of(camera) for camera in rig.cameras if camera.name not in kept}
        tracks = [video_track(c.name, "images", Path(c.url)) for c in rig.cameras if c.is_file]
        if tracks:
            self._playback.follow(tracks)
        names = tuple(camera.name for camera in rig.cameras)
        gone = [worker for name, worker in self._workers.items() if name not in kept]
        aligner = Aligner(names, 1 / (self._fps or rig.fps), rig.tolerance_s, rig.wait_s)
        with self._lock_cameras:
            aligner.counts.update({name: self._aligner.counts[name] for name in kept})
            self._rig_file, self._prepared, self._aligner = rig, None, aligner
            self._workers = {name: (kept | new)[name] for name in names}
        self._cameras = pinhole_cameras([camera.calibration for camera in rig.cameras])
        self._gather_until = None
        self._new = list(new.values())
        for worker in gone:
            worker.ask_to_stop()

    def _worker_of(self, camera: LiveCamera) -> CameraWorker:
        def connect(worker: CameraWorker) -> Any:
            return pictures_of(camera, worker.counts, self._playback, worker.wait)

        return CameraWorker(camera, connect, self._deliver, lambda at_s, period_s: self._aligner.wants(at_s, period_s))

    def _begin_rig(self) -> None:
        """Announce the rig to viewers, and open its new cameras."""
        rig = self._rig_file
        bounds = None if rig.bounds_m is None else Bounds(*torch.tensor(rig.bounds_m, dtype=torch.float32).unbind(0))
        self.begin(rig.name, rig.fps, bounds, None if rig.up is None else torch.tensor(rig.up, dtype=torch.float32))
        for worker in self._new:
            worker.start()

    def _run(self) -> None:
        watch_s = report_s = time.monotonic()
        while not self._stopped:
            try:
                with self._lock_cameras:
                    self._lock_cameras.wait(0.1)
                    complete = self._aligner.take(time.monotonic())
                for together in complete:
                    self._show(together)
            except Exception as error:  # nothing may end the thread
                self._is_wrong(f"{type(error).__name__}: {error}"[:400])
            now_s = time.monotonic()
            if now_s > watch_s + WATCH_S:
                watch_s = now_s
                self._follow_file()
                self._miss_cameras()
            if now_s > report_s + REPORT_S:
                report_s = now_s
                self._report()

    def _show(self, together: Together) -> None:
        """Add one frame, prepared as in `viewmend mend`."""
        taken = {name: images for name, images in together.taken.items() if name in self._cameras.names}
        names = [name for name in self._cameras.names if name in taken]
        if len(names) < 2:
            return
        now_s = time.monotonic()
        self._gather_until = self._gather_until or now_s + GATHER_S
        if self._prepared is None and len(names) < len(self._cameras) and now_s < self._gather_until:
            return  # the first frame waits for more cameras
        frame = stack_images([taken[name].images for name in names], self._cameras.select(names), 0)
        assert frame.mask is not None, "live cameras are masked"
        if self._prepared is None and int((frame.mask.amax((1, 2)) > FOREGROUND).sum()) < 2:
            self.status = replace(self.status, error="the masks are empty: no subject is visible")
            return
        rig = self.rig
        assert rig is not None, "the rig has begun"
        source = _OneTime(rig.name, self._cameras, rig.bounds, rig.up, frame)
        if self._prepared is None:
            self._prepared = prepare(source, align=self._align, match_colours=self._match)
            for text in self._prepared.changes:
                log.warning("%s", text)
        self.spread_ms = 1000 * together.spread_s
        self.add(replace(self._prepared, source=source).read(0))

    def _deliver(self, name: str, taken_s: float, images: CameraImages) -> None:
        """Called by the cameras' workers."""
        with self._lock_cameras:
            if name in self._aligner.counts:  # else the camera has just left the rig
                self._aligner.put(name, Taken(taken_s, images), time.monotonic())
                self._lock_cameras.notify()

    def _follow_file(self) -> None:
        """Reload the rig file if it has changed; an invalid file is reported and ignored."""
        stamp = _stamp(self._path)
        if stamp == self._file:
            return
        self._file = stamp
        try:
            self._take_on(read_rig(self._path, self._max_image_size))
        except ValueError as error:
            log.warning("the rig stays as it was: %s", error)
            return
        self._begin_rig()
        log.warning("the rig has changed: %d cameras, %d of them new", len(self._workers), len(self._new))

    def _miss_cameras(self) -> None:
        """Report an error while there are too few cameras."""
        gone = [worker for worker in self._workers.values() if not worker.up]
        there = len(self._workers) - len(gone)
        if there < 2:
            missed = f"'{gone[0].camera.name}': {gone[0].error or 'silent'}"
            self._is_wrong(f"two cameras or more are needed, {there} there; {missed}")

    def _is_wrong(self, error: str) -> None:
        """Report an error in the status, and to the terminal once until it changes."""
        if self.status.error != error:
            log.warning("%s", error)
        self.status = replace(self.status, state="failing", error=error)
        self.changed()

    def _report(self) -> None:
        """Log what was lost since the last report, if anything."""
        lines = []
        counted = self.camera_counts()
        for name, counts in counted.items():
            before = self._said.get(name, {})
            new = {event: counts.get(event, 0) - before.get(event, 0) for event in WORTH_SAYING}
            if lost := [f"{count} {event}" for event, count in new.items() if count > 0]:
                lines.append(f"{name} {', '.join(lost)}")
        self._said = counted
        if lines:
            log.warning("in the last %.0f s: %s", REPORT_S, "; ".join(lines))


def _stamp(path: Path) -> tuple[int, int] | None:
    """Time and size of a file; None if it does not exist."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
