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
from viewmend.live.renderer import FrameNotReadyError, Renderer, RenderRequest
from viewmend.live.sessions import PlaybackState, ShownFrame, ViewerSession
from viewmend.utils.cancellation import CancelledError, cancellable
from viewmend.utils.heap import HeapTrimmer

TICK_S = 0.004
"""Seconds between checks of the sessions' clocks."""
LOADING_S = 0.05
"""Seconds between these checks before the first frame."""
IDLE_S = 0.5
"""Seconds between these checks while no session wants a view; the first that does wakes the thread."""
AFTER_ERROR_S = 0.5
"""Seconds of rest after an error."""
Session = ViewerSession | RenderJob[Any]
"""What requests views. The render thread makes all calls, and holds the service's lock in all of
them but `deliver` and `is_cancelled`."""

log = logging.getLogger("viewmend.live")


class RenderService:
    """Owns the renderer and its thread. Sessions are changed while holding `lock`; `now` is the clock of all."""

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
        """The error of the last view, or of the rig's first frame."""
        self.ahead = CompletedAhead(renderer)
        """Completed virtual cameras of the frames that pages draw."""
        self.counts = Counter(frames=0, shared=0, errors=0, cancelled=0)
        self.times = FrameTimes()
        """Times of all frames together; like the counts, for /metrics."""
        self._sessions: list[Session] = []
        self._resolution_limit = ResolutionLimit()
        self._stopped = False
        self._advanced_at = now()
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
        """Check at once whether a session needs a view."""
        with self.lock:
            self.lock.notify_all()
        self.changed()

    def join(self, session: Session) -> None:
        """Begin to serve a session."""
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

    @property
    def edge(self) -> float:
        """The position of all who follow the edge, now."""
        with self.lock:
            now = self.now()
            self.source.recording.advance(now - self._advanced_at, self.source.span)
            self._advanced_at = now
            return self.source.edge

    def _run(self) -> None:
        trimmer = HeapTrimmer()
        while not self._stopped:
            try:
                worked = self._prepare() or self.serve_next() or self.complete_ahead()
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
        """Seconds until the sessions are checked again, if nothing wakes the thread."""
        if self._has_requests:
            return TICK_S
        return IDLE_S if self.is_ready else LOADING_S

    def _prepare(self) -> bool:
        span = self.source.span
        if self.is_ready or span.end <= span.first:
            return False
        try:
            done = self.renderer.prepare(span.newest if span.live else span.first)
        except FrameNotReadyError:
            return False
        self.error = None
        return done

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
        except Exception as error:  # reported to this session only
            log.exception("while rendering a view")
            self.error = f"{type(error).__name__}: {error}"[:400]
            self.counts["errors"] += 1
            session.fail(self.error)
            return True
        self.error = None
        self.counts.update(frames=1, shared=int(times.geometry == 0))
        self.times += times
        return True

    def complete_ahead(self) -> bool:
        """Complete one virtual camera of a frame that is shown; False if there is none, or a viewer waits.

        It is given up as soon as a viewer asks for a view, or the frame is no longer shown.
        Called on the render thread.
        """
        order = self.ahead.choose(self._shown_frames())
        if order is None or self.source.read(order.key[0]) is None:
            return False

        def is_needless() -> bool:
            return self._stopped or order.key not in [view.key for view in self._shown_frames()]

        try:
            with cancellable(is_needless):
                self.ahead.make(order)
        except CancelledError:
            pass
        except Exception as error:
            self.ahead.give_up(order, error)
        self.changed()
        return True

    def _shown_frames(self) -> list[ShownFrame]:
        """What viewers' pages show; nothing while a viewer waits for a view."""
        home = self.renderer.home
        if home is None or not self.is_ready:
            return []
        span = self.source.span
        shown = []
        with self.lock:
            edge = self.edge
            for session in self._sessions:
                if not isinstance(session, ViewerSession) or not session.is_content(span, edge):
                    return []
                view = session.shown_frame(span, edge, home)
                if view is not None:
                    shown.append(view)
        return shown

    def _next_request(self, now: float, span: Span, home: HomeView) -> tuple[Session, RenderRequest] | None:
        """The request of the session that has waited longest, which goes to the end of the queue."""
        viewers = [session for session in self._sessions if isinstance(session, ViewerSession)]
        playback = PlaybackState(
            span,
            self.edge,
            home,
            has_frame=lambda index: self.source.read(index) is not None,
            active_viewers=max(1, sum(viewer.is_active(now) for viewer in viewers)),
            resolution_limit=self._resolution_limit,
            has_company=len(viewers) > 1,
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
