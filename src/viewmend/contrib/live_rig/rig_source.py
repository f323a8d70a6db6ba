"""The frame source of `viewmend serve rig.toml`: cameras whose images this process reads itself."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Generator
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from viewmend.contrib.live_rig.aligner import Aligner, ImageGroup, TimedImages
from viewmend.contrib.live_rig.frame_readers import DecodedImage, Playback, read_images
from viewmend.contrib.live_rig.rig_file import LiveCamera, LiveRig, read_rig
from viewmend.contrib.live_rig.worker import CameraWorker
from viewmend.data.camera_images import CameraImages, stack_images
from viewmend.data.capture_folder import pinhole_cameras
from viewmend.data.errors import CaptureError
from viewmend.data.prepare import PreparedCapture, prepare
from viewmend.data.source import MemoryCapture
from viewmend.data.video_clock import video_track
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import FOREGROUND
from viewmend.live.push import LiveSource
from viewmend.types import MultiViewFrame

WATCH_S = 1.0
"""The rig's file is checked for changes at this interval, in seconds."""
UNMATCHED_S = 5.0
"""No images of two connected cameras at the same time for this many seconds and `UNMATCHED_TICKS` are an error."""
UNMATCHED_TICKS = 3.0
"""Two cameras that send an image per tick have images of the same tick after at most this many."""
REPORT_S = 30.0
"""Losses are reported at this interval, in seconds."""
FIRST_FRAME_S = 3.0
"""A rig's first frame waits this many seconds for all cameras, because alignment and the axes of the
page's orbit are found in it."""
REPORTED_EVENTS = ("late", "missing", "duplicated", "torn", "misaligned", "replaced", "refused")
"""Events that are reported as losses; docs/guide/live-rig.md describes them."""

log = logging.getLogger("viewmend.live")


@dataclass(frozen=True)
class FileStamp:
    """Identifies a version of a file."""

    modified_ns: int
    size_bytes: int

    @classmethod
    def of(cls, path: Path) -> "FileStamp | None":
        """The file's present version; None if it does not exist."""
        try:
            status = path.stat()
        except OSError:
            return None
        return cls(status.st_mtime_ns, status.st_size)


class RigFileSource(LiveSource):
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
        tighten_masks: bool = True,
    ) -> None:
        """Read the rig; its cameras are opened by `start`.

        Raises:
            CaptureError: the rig's file, its calibration, a clean plate or a recording cannot be used.
        """
        super().__init__(fps, memory_mb)
        self._path = path
        self._max_image_size = max_image_size
        self._align = align
        self._match_colours = match_colours
        self._tighten_masks = tighten_masks
        self._cameras_lock = threading.Condition()
        self._playback = Playback()
        self._aligner = Aligner(names=(), interval_s=1.0, tolerance_s=1.0, wait_s=1.0)
        """A placeholder without cameras, until `_switch_to` replaces it."""
        self._workers: dict[str, CameraWorker] = {}
        self._new_workers: list[CameraWorker] = []
        """Workers that `_begin_rig` is going to start."""
        self._first_frame_deadline_s: float | None = None
        """When the first frame is added even if cameras are missing; None until two cameras have sent images."""
        self._matched_s = 0.0
        """When images of two cameras matched last, or could not because fewer were connected."""
        self._stopped = False
        self._stamp = FileStamp.of(path)
        self._reported: dict[str, dict[str, int]] = {}
        """The cameras' event counts at the last report."""
        self._prepared: PreparedCapture | None = None
        """The rig with its alignment and colour matching; None before its first frame."""
        self._switch_to(read_rig(path, max_image_size, fps))
        self._thread = threading.Thread(target=self._run, name="rig", daemon=True)

    def start(self) -> None:
        """Open the cameras."""
        self._begin_rig()
        self._thread.start()

    def stop(self) -> None:
        """Stop reading, and close the cameras."""
        self._stopped = True
        with self._cameras_lock:
            self._cameras_lock.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=10)
        for worker in self._workers.values():
            worker.ask_to_stop()
        for worker in self._workers.values():
            worker.stop()

    def camera_counts(self) -> dict[str, dict[str, int]]:
        """Event counts of each camera. The key "up" is 1 if the camera delivers images, else 0."""
        with self._cameras_lock:
            counts: dict[str, dict[str, int]] = {}
            for name, worker in self._workers.items():
                # The copy is made in one step, while the worker goes on counting
                own = Counter(worker.counts)
                counts[name] = {"up": int(worker.up), **(own + self._aligner.counts[name])}
            return counts

    def _switch_to(self, rig: LiveRig) -> None:
        """Replace the current rig. Unchanged cameras continue; new ones are opened by `_begin_rig`.

        Raises:
            CaptureError: a clean plate or a recording cannot be used. The current rig stays as it is.
        """
        # Workers of unchanged cameras are kept. Cameras are compared as text, because they hold arrays, for which
        # == gives one truth value per entry.
        unchanged = {repr(camera) for camera in rig.cameras}
        kept = {name: worker for name, worker in self._workers.items() if repr(worker.camera) in unchanged}
        new = {camera.name: self._make_worker(camera) for camera in rig.cameras if camera.name not in kept}
        gone = [worker for name, worker in self._workers.items() if name not in kept]

        # Recordings are played on one timeline.
        recordings = [camera for camera in rig.cameras if camera.is_file]
        if recordings:
            tracks = [video_track(camera.name, "images", Path(camera.url)) for camera in recordings]
            try:
                timecode_note = self._playback.synchronise(tracks)
            except ValueError as error:
                raise CaptureError(f"{rig.name}: {error}") from None
            if timecode_note is not None:
                log.warning("%s", timecode_note)

        # Unchanged cameras keep their event counts.
        names = tuple(camera.name for camera in rig.cameras)
        aligner = Aligner(names, 1 / rig.fps, rig.tolerance_s, rig.wait_s)
        with self._cameras_lock:
            aligner.counts.update({name: self._aligner.counts[name] for name in kept})
            self._rig = rig
            self._prepared = None
            self._aligner = aligner
            workers = kept | new
            self._workers = {name: workers[name] for name in names}
        self._cameras = pinhole_cameras([camera.calibration for camera in rig.cameras])
        self._first_frame_deadline_s = None
        self._new_workers = list(new.values())
        for worker in gone:
            worker.ask_to_stop()

    def _make_worker(self, camera: LiveCamera) -> CameraWorker:
        def connect(worker: CameraWorker) -> Generator[DecodedImage, None, None]:
            return read_images(camera, worker.counts, self._playback, worker.wait, 1 / self._rig.fps)

        def wants(taken_s: float, period_s: float) -> bool:
            # A changed rig gets a new aligner, so the attribute is read at each call
            with self._cameras_lock:
                return self._aligner.wants(taken_s, period_s)

        return CameraWorker(camera, connect, self._add_image, wants)

    def _begin_rig(self) -> None:
        """Announce the rig to viewers, and open its new cameras."""
        rig = self._rig
        bounds = None
        if rig.bounds_m is not None:
            low, high = torch.tensor(rig.bounds_m, dtype=torch.float32)
            bounds = Bounds(low, high)
        up = None if rig.up is None else torch.tensor(rig.up, dtype=torch.float32)
        self.begin(rig.name, rig.fps, bounds, up)
        self.status = replace(self.status, error="waiting for the cameras")
        self._matched_s = time.monotonic()
        for worker in self._new_workers:
            worker.start()

    def _run(self) -> None:
        watched_s = time.monotonic()
        reported_s = watched_s
        while not self._stopped:
            now_s = time.monotonic()
            try:
                with self._cameras_lock:
                    self._cameras_lock.wait(0.1)
                    groups = self._aligner.take(time.monotonic())
                for group in groups:
                    self._add_group(group)
            except Exception as error:  # the thread goes on, whatever happens to a frame
                self._set_error(f"{type(error).__name__}: {error}"[:400])
            if now_s > watched_s + WATCH_S:
                watched_s = now_s
                self._reload_if_changed()
                self._check_cameras(now_s)
            if now_s > reported_s + REPORT_S:
                reported_s = now_s
                self._report_losses()

    def _add_group(self, group: ImageGroup) -> None:
        """Add a group's images as a frame, aligned and colour-matched, if it has enough cameras."""
        names = [name for name in self._cameras.names if name in group.by_camera]
        if len(names) < 2:
            return
        self._matched_s = time.monotonic()

        # The first frame waits for all cameras.
        if self._prepared is None and len(names) < len(self._cameras):
            now_s = time.monotonic()
            if self._first_frame_deadline_s is None:
                self._first_frame_deadline_s = now_s + FIRST_FRAME_S
            if now_s < self._first_frame_deadline_s:
                return

        images = [group.by_camera[name].images for name in names]
        frame = stack_images(images, self._cameras.select(names), 0)
        if self._prepared is None:
            self._prepared = self._prepare(frame)
        if self._prepared is None:
            self.status = replace(self.status, error="fewer than two masks show a subject")
            return
        adjusted = self._prepared.adjust(frame, label="the newest frame")
        if len(adjusted.cameras) < 2:
            got = len(adjusted.cameras)
            self._set_error(
                f"expected at least two usable cameras, got {got}; the log names the others' faults"
            )
            return
        self.spread_ms = 1000 * group.spread_s
        self.add(adjusted)

    def _prepare(self, frame: MultiViewFrame) -> PreparedCapture | None:
        """Check, align and colour-match the rig by its first frame; None if fewer than two masks have a subject."""
        assert frame.mask is not None, "live cameras are masked"
        shows_subject = frame.mask.amax((1, 2)) > FOREGROUND  # one value per camera
        if int(shows_subject.sum()) < 2:
            return None
        assert self.rig is not None, "the rig has begun"
        capture = MemoryCapture(
            self.rig.name, self._cameras, (frame,), bounds=self.rig.bounds, up=self.rig.up
        )
        prepared = prepare(
            capture,
            align=self._align,
            match_colours=self._match_colours,
            tighten_masks=self._tighten_masks,
        )
        for change in prepared.changes:
            log.warning("%s", change)
        self.rig = replace(self.rig, cameras=prepared.usable_cameras)
        return prepared

    def _add_image(self, worker: CameraWorker, taken_s: float, images: CameraImages) -> None:
        """Add a camera's image and mask to the aligner. Called on the threads of the cameras' workers."""
        name = worker.camera.name
        with self._cameras_lock:
            if self._workers.get(name) is worker:  # otherwise the camera has just been removed or replaced
                self._aligner.put(name, TimedImages(taken_s, images), time.monotonic())
                self._cameras_lock.notify()

    def _reload_if_changed(self) -> None:
        """Reload the rig file if it has changed; a file that cannot be used is reported and ignored."""
        stamp = FileStamp.of(self._path)
        if stamp == self._stamp:
            return
        self._stamp = stamp
        try:
            self._switch_to(read_rig(self._path, self._max_image_size, self._fps))
        except Exception as error:  # the thread goes on, whatever happens while files are being replaced
            log.warning("the rig stays as it was: %s", str(error) or type(error).__name__)
            return
        self._begin_rig()
        log.warning(
            "the rig has changed: %d cameras, %d of them new", len(self._workers), len(self._new_workers)
        )

    def _check_cameras(self, now_s: float) -> None:
        """Report an error while there are too few cameras, or their images do not match."""
        silent = [worker for worker in self._workers.values() if not worker.up]
        connected = len(self._workers) - len(silent)
        if connected < 2:
            first = f"'{silent[0].camera.name}': {silent[0].error or 'silent'}"
            self._set_error(f"expected at least two cameras, got {connected}; {first}")
            self._matched_s = now_s
        elif now_s > self._matched_s + UNMATCHED_S + UNMATCHED_TICKS / self._rig.fps + self._rig.wait_s:
            faulty = [worker for worker in self._workers.values() if worker.error]
            reason = (
                f"'{faulty[0].camera.name}': {faulty[0].error}" if faulty else "check clock and offset_ms"
            )
            self._set_error(f"expected images of two cameras at the same time, got none; {reason}")

    def _set_error(self, error: str) -> None:
        """Set the status to an error, and log it if it is a new one."""
        if self.status.error != error:
            log.warning("%s", error)
        self.status = replace(self.status, state="failing", error=error)
        self.changed()

    def _report_losses(self) -> None:
        """Log each camera's losses since the last report, if there are any."""
        lines: list[str] = []
        counted = self.camera_counts()
        for name, counts in counted.items():
            before = self._reported.get(name, {})
            new = {event: counts.get(event, 0) - before.get(event, 0) for event in REPORTED_EVENTS}
            losses = [f"{count} {event}" for event, count in new.items() if count > 0]
            if losses:
                lines.append(f"{name} {', '.join(losses)}")
        self._reported = counted
        if lines:
            log.warning("in the last %.0f s: %s", REPORT_S, "; ".join(lines))
