"""The render service: one thread that renders for all sessions in turn."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from viewmend.live.budget import ResolutionLimit
from viewmend.live.completed_ahead import CompletedAhead
from viewmend.live.frame_source import FrameSource, Span
from viewmend.live.poses import HomeView
from viewmend.live.protocol import FrameTimes
from viewmend.live.render_jobs import RenderJob
from viewmend.live.renderer import FrameNotReadyError, Renderer, RenderRequest, RequestError
from viewmend.live.sessions import PlaybackState, ShownFrame, ViewerSession
from viewmend.utils.cancellation import CancelledError, cancellable
from viewmend.utils.heap import HeapTrimmer

TICK_S = 0.004
"""Seconds between checks whether a session needs a view."""
LOADING_S = 0.05
"""Seconds between these checks before the first frame."""
IDLE_S = 0.5
"""Seconds between these checks while no session wants views; the first that does wakes the thread."""
AFTER_ERROR_S = 0.5
"""Seconds of rest after an error."""
Session = ViewerSession | RenderJob[Any]
"""A viewer or a job, for which the render thread renders. This thread calls `next_request` while it
holds the service's lock, and `deliver`, `give_up` and `fail` without it."""

log = logging.getLogger("viewmend.live")


class RenderService:
    """Owns the renderer and its thread.

    Connections hold `lock` while they change sessions. All times are on the clock `now`, in seconds.
    """

    def __init__(
        self, renderer: Renderer, source: FrameSource, now: Callable[[], float] = time.monotonic
    ) -> None:
        self.renderer = renderer
        self.source = source
        self.now = now
        self.lock = threading.Condition()
        self.changed: Callable[[], None] = lambda: None
        """Called, on any thread, when the source has changed."""
        self.error: str | None = None
        """The error of the last view, unless its request was at fault; or of the rig's first frame."""
        self.ahead = CompletedAhead(renderer)
        """Completed virtual cameras of the frames that pages draw."""
        self.counts = Counter(frames=0, shared=0, errors=0, cancelled=0)
        """Events since the start, for /metrics."""
        self.times = FrameTimes()
        """The summed times of all frames, for /metrics."""
        self._sessions: list[Session] = []
        self._resolution_limit = ResolutionLimit()
        self._stopped = False
        self._edge_advanced_s = now()
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)
        source.changed = self.wake

    def start(self) -> None:
        """Start reading and rendering."""
        self.source.start()
        self._thread.start()

    def stop(self) -> None:
        """Stop after the view that is being rendered."""
        with self.lock:
            self._stopped = True
            self.lock.notify_all()
        self.source.stop()
        if self._thread.is_alive():
            self._thread.join(timeout=5)

    def wake(self) -> None:
        """Check at once whether a session needs a view, and call `changed`, because the source has changed."""
        with self.lock:
            self.lock.notify_all()
        self.changed()

    def join(self, session: Session) -> None:
        """Start serving a session."""
        with self.lock:
            self._sessions.append(session)
            self.lock.notify_all()

    def leave(self, session: Session) -> None:
        """Stop serving a session."""
        with self.lock:
            if session in self._sessions:
                self._sessions.remove(session)

    @property
    def _has_requests(self) -> bool:
        """Whether any session wants views."""
        return any(session.wants_views for session in list(self._sessions))

    @property
    def is_ready(self) -> bool:
        """Whether views can be rendered."""
        return self.renderer.home is not None and self.renderer.is_prepared_for(self.source.rig)

    def advance_edge(self) -> float:
        """Advance the edge to now; returns it as `FrameSource.edge` does."""
        with self.lock:
            now = self.now()
            self.source.recording.advance(now - self._edge_advanced_s, self.source.span)
            self._edge_advanced_s = now
            return self.source.edge

    def _run(self) -> None:
        trimmer = HeapTrimmer()
        while not self._stopped:
            try:
                worked = self._prepare() or self.serve_next() or self.make_ahead()
            except Exception as error:  # the thread goes on
                log.warning("while preparing: %s", error)
                self.error = f"{type(error).__name__}: {error}"[:400]
                worked = False
                with self.lock:
                    self.lock.wait_for(lambda: self._stopped, AFTER_ERROR_S)
            trimmer.trim_if_due(idle=not worked)
            with self.lock:
                if not worked and not self._stopped:
                    self.lock.wait(self._check_interval_s())

    def _check_interval_s(self) -> float:
        """Seconds until the sessions are checked again, unless something wakes the thread before."""
        if self._has_requests:
            return TICK_S
        return IDLE_S if self.is_ready else LOADING_S

    def _prepare(self) -> bool:
        """Prepare the renderer for a new rig, once there is a frame; returns whether it did so."""
        span = self.source.span
        if self.is_ready or span.end <= span.first:
            return False
        try:
            is_prepared = self.renderer.prepare(span.newest if span.live else span.first)
        except FrameNotReadyError:
            return False
        self.error = None
        return is_prepared

    def serve_next(self) -> bool:
        """Render and deliver one view; False if no session needs one. Called on the render thread."""
        now = self.now()
        span = self.source.span
        if not self._has_requests or not self.is_ready or self.renderer.home is None:
            return False
        with self.lock:
            found = self._next_request(now, span, self.renderer.home)
        if found is None:
            return False
        session, request = found
        try:
            with cancellable(lambda: session.is_cancelled or self._stopped):
                result = self.renderer.render(request, session.viewer)
            times = session.deliver(request, result)
            if isinstance(session, ViewerSession):
                pixels = sum(int(camera.size_px.prod()) for camera in request.cameras)
                self._resolution_limit.record(pixels, session.rendered_level, self.now() - now)
        except CancelledError:
            self.counts["cancelled"] += 1
            session.give_up()
            return True
        except FrameNotReadyError:  # the frame was dropped since `next_request`
            session.give_up()
            return True
        except Exception as error:  # reported to its session
            message = f"{type(error).__name__}: {error}"[:400]
            self.counts["errors"] += 1
            session.fail(message)
            if isinstance(error, RequestError):
                log.debug("a view that cannot be rendered: %s", message)
            else:
                log.exception("while rendering a view")
                self.error = message
            return True
        self.error = None
        self.counts.update(frames=1, shared=int(times.shares_geometry))
        self.times += times
        return True

    def make_ahead(self) -> bool:
        """Make one mesh or completed view of a frame that a page shows; False if there is nothing to make.

        Nothing is made ahead while a viewer or a job needs a view. What is being made is cancelled as
        soon as one does, or no page shows the frame any more. Called on the render thread.
        """
        task = self.ahead.choose(self._shown_frames_if_idle())
        if task is None or self.source.read(task.frame) is None:
            return False

        def is_needless() -> bool:
            return self._stopped or task.key not in [shown.key for shown in self._shown_frames_if_idle()]

        try:
            with cancellable(is_needless):
                self.ahead.make(task)
        except CancelledError:
            pass
        except Exception as error:
            self.ahead.note_failure(task, error)
        self.changed()
        return True

    def _shown_frames_if_idle(self) -> list[ShownFrame]:
        """The frames that pages show if no viewer or job needs a view; otherwise none."""
        home = self.renderer.home
        if home is None or not self.is_ready:
            return []
        span = self.source.span
        frames = []
        with self.lock:
            edge = self.advance_edge()
            for session in self._sessions:
                is_job = not isinstance(session, ViewerSession)  # a job needs views until it leaves
                if is_job or not session.is_up_to_date(span, edge):
                    return []
                shown = session.shown_frame(span, edge, home)
                if shown is not None:
                    frames.append(shown)
        return frames

    def _next_request(self, now: float, span: Span, home: HomeView) -> tuple[Session, RenderRequest] | None:
        """The first request in the order of the queue; its session moves to the end."""
        viewers = [session for session in self._sessions if isinstance(session, ViewerSession)]
        playback = PlaybackState(
            span,
            self.advance_edge(),
            home,
            self.source.read,
            active_viewers=max(1, sum(viewer.is_active(now) for viewer in viewers)),
            resolution_limit=self._resolution_limit,
            has_other_viewers=len(viewers) > 1,
        )
        for session in list(self._sessions):
            try:
                request = session.next_request(now, playback)
            except Exception as error:  # reported to this session only
                session.fail(str(error)[:400])
                continue
            if request is not None:
                self._sessions.remove(session)
                self._sessions.append(session)
                return session, request
        return None
