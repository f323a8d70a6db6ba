"""One thread that renders for all sessions, in turn."""

import logging
import threading
import time
from collections import Counter

from viewmend.live.clock import Span, edge_of
from viewmend.live.frames import FrameSupply
from viewmend.live.memory import HeapTrimmer
from viewmend.live.pace import Pace
from viewmend.live.poses import RigFrame
from viewmend.live.protocol import FrameTimes
from viewmend.live.renderer import FrameNotReadyError, Renderer, RenderRequest
from viewmend.live.sessions import Playback, Session, ViewerSession

TICK_S = 0.004
"""Seconds between looks at the sessions' clocks."""
IDLE_S = 0.05
AFTER_ERROR_S = 0.5

log = logging.getLogger("viewmend.live")


class RenderService:
    """Owns the renderer and its thread. Sessions speak to it under `lock`."""

    def __init__(self, renderer: Renderer, supply: FrameSupply) -> None:
        self.renderer = renderer
        self.supply = supply
        self.lock = threading.Condition()
        self.error: str | None = None
        """What went wrong with the last view, or with the rig's first frame."""
        self.counts = Counter(frames=0, shared=0, errors=0)
        """Counts for /metrics."""
        self.times = FrameTimes()
        """Times of all frames together, for /metrics."""
        self._sessions: list[Session] = []
        self._pace = Pace()
        self._stopped = False
        self._last = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)
        supply.changed = self.wake

    def start(self) -> None:
        """Begin."""
        self.supply.start()
        self._thread.start()

    def stop(self) -> None:
        """End after the view that is being rendered."""
        with self.lock:
            self._stopped = True
            self.lock.notify_all()
        self.supply.stop()
        if self._thread.is_alive():
            self._thread.join(timeout=5)

    def wake(self) -> None:
        """Something has changed."""
        with self.lock:
            self.lock.notify_all()

    def join(self, session: Session) -> None:
        """Begin to serve a session."""
        with self.lock:
            self._sessions.append(session)
            self.lock.notify_all()

    def leave(self, session: Session) -> None:
        """End serving a session."""
        with self.lock:
            if session in self._sessions:
                self._sessions.remove(session)

    @property
    def edge(self) -> float:
        """The position of the viewers who follow the edge."""
        return edge_of(self.supply.span, self.supply.recording)

    @property
    def ready(self) -> bool:
        """Whether views can be rendered."""
        return self.renderer.frame is not None and self.renderer.is_of(self.supply.rig)

    def _run(self) -> None:
        trimmer = HeapTrimmer()
        while not self._stopped:
            try:
                worked = self._prepare() or self._serve_next()
            except Exception as error:  # nothing may end the thread
                log.warning("while preparing: %s", error)
                self.error, worked = f"{type(error).__name__}: {error}"[:400], False
                time.sleep(AFTER_ERROR_S)
            trimmer.when_due(idle=not worked)
            with self.lock:
                if not worked and not self._stopped:
                    self.lock.wait(TICK_S if self._sessions else IDLE_S)

    def _prepare(self) -> bool:
        """See a new rig's first frame."""
        span = self.supply.span
        if self.ready or span.end <= span.first:
            return False
        try:
            done = self.renderer.prepare(span.newest if span.live else span.first)
        except FrameNotReadyError:
            return False
        self.error = None
        return done

    def _serve_next(self) -> bool:
        """Render and show one view, if any session wants one."""
        now, span = time.monotonic(), self.supply.span
        self.supply.recording.advance(now - self._last, span)
        self._last = now
        if not self.ready or self.renderer.frame is None:
            return False
        with self.lock:
            found = self._next_request(now, span, self.renderer.frame)
        if found is None:
            return False
        session, request = found
        try:
            result = self.renderer.render(request, session.viewer)
            times = session.show(request, result)
            if isinstance(session, ViewerSession):
                pixels = sum(int(camera.size_px.prod()) for camera in request.cameras)
                self._pace.record(pixels, session.drawn, time.monotonic() - now)
        except Exception as error:  # one viewer's, who is told; the others go on
            log.exception("while rendering a view")
            self.error = f"{type(error).__name__}: {error}"[:400]
            self.counts["errors"] += 1
            session.fail(self.error)
            return True
        self.error = None
        self.counts.update(frames=1, shared=int(times.geometry == 0))
        self.times += times
        return True

    def _next_request(self, now: float, span: Span, rig_frame: RigFrame) -> tuple[Session, RenderRequest] | None:
        """The request of the session that has waited longest, which then is the last in turn."""
        viewers = [session for session in self._sessions if isinstance(session, ViewerSession)]
        active = max(1, sum(viewer.is_active(now) for viewer in viewers))
        has_frame = lambda at: self.supply.read(at) is not None  # noqa: E731
        playback = Playback(span, self.edge, rig_frame, has_frame, active, self._pace, len(viewers) > 1)
        for session in list(self._sessions):
            try:
                request = session.next_request(now, playback)
            except Exception as error:  # whatever one viewer asks for, the others are served
                session.fail(str(error)[:400])
                continue
            if request is not None:
                self._sessions.remove(session)
                self._sessions.append(session)
                return session, request
        return None
