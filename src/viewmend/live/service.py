"""One thread that renders for everybody, in turn."""

import logging
import threading
import time
from collections import Counter

from viewmend.live.clock import Clock, edge_of
from viewmend.live.frames import FrameSupply
from viewmend.live.memory import HeapTrimmer
from viewmend.live.renderer import NotThereError, Renderer
from viewmend.live.sessions import Scene, Session, ViewerSession

TICK_S = 0.004
"""How often clocks are looked at while somebody is there."""
IDLE_S = 0.05
AFTER_ERROR_S = 0.5

STAGES = ("geometry", "context", "rendering", "inpainting", "encode")
COUNTED = ("frames", "shared", "errors", *(f"{stage}_us" for stage in STAGES))

log = logging.getLogger("viewmend.live")


class RenderService:
    """Owns the renderer and its thread; everything else speaks to it through seats, under `lock`."""

    def __init__(self, renderer: Renderer, supply: FrameSupply) -> None:
        self.renderer = renderer
        self.supply = supply
        self.lock = threading.Condition()
        self.error: str | None = None
        """What went wrong with the last view, or with the rig's first frame."""
        self.counts = Counter(dict.fromkeys(COUNTED, 0))
        """For /metrics: frames and milliseconds by stage."""
        self.recording = Clock()
        """The edge of a recording."""
        self.recording.live = False
        self._seats: list[Session] = []
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
            self._thread.join(timeout=30)

    def wake(self) -> None:
        """Something has changed."""
        with self.lock:
            self.lock.notify_all()

    def join(self, seat: Session) -> None:
        """Serve this one, too."""
        with self.lock:
            self._seats.append(seat)
            self.lock.notify_all()

    def leave(self, seat: Session) -> None:
        """Serve it no more."""
        with self.lock:
            if seat in self._seats:
                self._seats.remove(seat)

    @property
    def edge(self) -> float:
        """Where those are who follow the edge."""
        return edge_of(self.supply.span, self.recording)

    @property
    def ready(self) -> bool:
        """Whether there is something to look at."""
        return self.renderer.frame is not None and self.renderer.is_of(self.supply.rig)

    def _run(self) -> None:
        tidying = HeapTrimmer()
        while not self._stopped:
            try:
                worked = self._prepare() or self._turn()
            except Exception as error:  # nothing may end the thread
                log.warning("while preparing: %s", error)
                self.error, worked = f"{type(error).__name__}: {error}"[:400], False
                time.sleep(AFTER_ERROR_S)
            tidying.when_due(idle=not worked)
            with self.lock:
                if not worked and not self._stopped:
                    self.lock.wait(TICK_S if self._seats else IDLE_S)

    def _prepare(self) -> bool:
        """See a new rig's first frame."""
        span = self.supply.span
        if self.ready or span.end <= span.first:
            return False
        try:
            done = self.renderer.prepare(span.newest if span.live else span.first)
        except NotThereError:
            return False
        self.error = None
        return done

    def _turn(self) -> bool:
        """Serve the seat that has waited longest, if one is due."""
        now, span = time.monotonic(), self.supply.span
        self.recording.advance(now - self._last, span)
        self._last = now
        if not self.ready or self.renderer.frame is None:
            return False
        with self.lock:
            crowd = sum(
                isinstance(s, ViewerSession) and bool(s.recent) and s.recent[-1].at > now - 1 for s in self._seats
            )
            scene = Scene(span, self.edge, self.renderer.frame, self._present, max(1, crowd))
            for seat in list(self._seats):
                try:
                    ask = seat.due(now, scene)
                except Exception as error:  # whatever one viewer asks for, the others are served
                    seat.fail(str(error)[:400])
                    continue
                if ask is not None:
                    self._seats.remove(seat)
                    self._seats.append(seat)
                    break
            else:
                return False
        try:
            rendered = self.renderer.render(ask, seat.viewer)
            start = time.perf_counter()
            seat.show(ask, rendered)
            encode_ms = 1000 * (time.perf_counter() - start)
        except Exception as error:  # one viewer's, who is told; the others go on
            log.exception("while rendering a view")
            self.error = f"{type(error).__name__}: {error}"[:400]
            self.counts["errors"] += 1
            seat.fail(self.error)
            return True
        self.error = None
        self.counts.update({"frames": 1, "shared": int(rendered.times.geometry == 0)})
        taken = [*(getattr(rendered.times, stage) for stage in STAGES[:-1]), encode_ms]
        self.counts.update({f"{stage}_us": round(1000 * ms) for stage, ms in zip(STAGES, taken, strict=True)})
        return True

    def _present(self, at: int) -> bool:
        return self.supply.read(at) is not None
