"""Who is waiting for views: what each wants next, and where it goes."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, Protocol, runtime_checkable

from viewmend.inpainting.protocol import RenderQuality, State
from viewmend.live.budget import FULL, Budget, FrameMs, Level
from viewmend.live.clock import Clock, Span
from viewmend.live.packing import Encoders, FrameInfo, frame_message
from viewmend.live.poses import RigFrame, view_camera
from viewmend.live.protocol import ClockChange, Look
from viewmend.live.renderer import RenderRequest, RenderResult

REFINEMENTS = ((0.25, Level(1.0, 0, None)), (0.8, FULL))
"""What a view is rendered with once it has been still for so many seconds: sharp first, since whoever moves on waits
for it; then with all that the model can do."""
MOVING = Level(0.5, 0, 256)
"""What a moving view is made with where no budget says."""


@dataclass(frozen=True)
class Scene:
    """What there is to look at now."""

    span: Span
    edge: float
    """Where those are who follow the edge."""
    frame: RigFrame
    present: Callable[[int], bool]
    """Whether a time's frame is at hand; asking makes it come."""
    crowd: int
    """Viewers that were served in the last second, this one included."""


@runtime_checkable
class Session(Protocol):
    """Somebody who wants views; all calls come from the render thread, under the service's lock but for `show`."""

    viewer: State | None

    def due(self, now: float, scene: Scene) -> RenderRequest | None:
        """The view that is wanted now."""
        ...

    def show(self, ask: RenderRequest, rendered: RenderResult) -> None:
        """It is there."""
        ...

    def fail(self, message: str) -> None:
        """It could not be rendered."""
        ...


@dataclass(frozen=True)
class Shown:
    """One frame that was sent, for statistics."""

    at: float
    stage_ms: dict[str, float]
    size: int
    shared: bool
    """Another viewer had paid for its geometry."""


class ViewerSession:
    """One viewer of the page: newest look wins, one frame in flight."""

    def __init__(
        self,
        deliver: Callable[[bytes], None],
        complain: Callable[[str], None],
        budget_ms: float | None,
    ) -> None:
        """Take a seat.

        Args:
            deliver: called with each frame's message, on the render thread.
            complain: called with what went wrong, likewise.
            budget_ms: milliseconds that a view may take when alone; None without a limit.
        """
        self.viewer: State | None = None
        self.clock = Clock()
        self.buffering = False
        self.dropped = 0
        self.recent: deque[Shown] = deque(maxlen=120)
        self.in_flight: int | None = None
        self.in_flight_since = 0.0
        self.budget = None if budget_ms is None else Budget(budget_ms)
        self._budget_ms = budget_ms
        self._deliver, self._complain = deliver, complain
        self._numbers = count()
        self._look: Look | None = None
        self._look_at = 0.0
        self._last = time.monotonic()
        self._shown: tuple[Look | None, int] = (None, -1)
        self._full = False
        self._level, self._wait_ms = FULL, 0.0
        self._encoders, self._wants_key = Encoders(), False

    def look(self, look: Look) -> None:
        """What to show from now on; one that was not shown yet is dropped."""
        if self._look is not self._shown[0]:
            self.dropped += 1
        self._look, self._look_at = look, time.monotonic()
        self._wants_key = self._wants_key or look.key

    def change(self, change: ClockChange, span: Span) -> None:
        """Play, pause, seek, speed, edge."""
        self.clock.change(change, span)

    def ack(self, frame: int) -> None:
        """A frame has arrived."""
        if frame == self.in_flight:
            self.in_flight = None

    def due(self, now: float, scene: Scene) -> RenderRequest | None:
        """The view that is wanted now: the newest look at the clock's time, or the same again, better."""
        seconds, self._last = now - self._last, now
        self.clock.advance(seconds, scene.span, scene.edge)
        look, at = self._look, self.clock.time(scene.span)
        self.buffering = False
        if look is None or at < 0 or self.in_flight is not None:
            return None
        fresh = look is not self._shown[0] or at != self._shown[1]  # asked again in the same words is asked again
        rests = not look.moving and not (self.clock.playing and scene.span.fps > 0)
        level = self._choose(look, scene.crowd) if fresh else self._better(now - self._look_at) if rests else None
        if level is None:
            return None
        if not scene.present(at):
            self.buffering = True
            return None
        if fresh and look is self._shown[0]:
            self.dropped += max(0, at - self._shown[1] - 1) if self.clock.playing else 0
        self._level, self._full = level, level == FULL
        self._wait_ms = 1000 * (now - self._look_at) if look is not self._shown[0] else 0.0
        self._shown = (look, at)
        return self._ask(look, at, scene.frame)

    def _better(self, still_s: float) -> Level | None:
        """What to render a view again with that has been still for so long; None for what it was rendered with."""
        if self._full:
            return None
        due = [
            level
            for after_s, level in REFINEMENTS
            if still_s >= after_s and level.relative_cost > self._level.relative_cost
        ]
        return due[-1] if due else None

    def _choose(self, look: Look, crowd: int) -> Level:
        if self.budget is not None and self._budget_ms is not None:
            self.budget.target_ms = self._budget_ms / max(1, crowd)
            level = self.budget.level
        else:
            level = MOVING if look.moving else FULL
        return level if look.adaptive else replace(level, scale=1.0)

    def _ask(self, look: Look, at: int, frame: RigFrame) -> RenderRequest:
        level = self._level
        top_k = min((k for k in (level.top_k, look.top_k) if k is not None), default=None)
        quality = RenderQuality(mend="mended" in look.modes, top_k=top_k, context_times=level.context_times)
        scale = look.scale * level.scale
        cameras = tuple(view_camera(eye, frame, (look.width, look.height), scale) for eye in look.cameras)
        return RenderRequest(at, cameras, quality)

    def show(self, ask: RenderRequest, rendered: RenderResult) -> None:
        """Encode and send a frame, and learn from what it took."""
        look = self._shown[0]
        assert look is not None, "views are rendered for those who look"
        self.viewer = rendered.viewer
        # Once for each look that asks; a look that is dropped leaves its wish to the next.
        key, self._wants_key = self._wants_key, False
        info = FrameInfo(next(self._numbers), self._full, max(0.0, self._wait_ms), self.dropped, key)
        message, stage_ms = frame_message(look, ask, rendered, info, self._encoders)
        now = time.monotonic()
        self.recent.append(Shown(now, stage_ms, len(message), rendered.times.geometry == 0))
        if self.budget is not None:
            pixels = stage_ms["rendering"] + stage_ms["encode"]
            filling = stage_ms["inpainting"] if ask.quality.mend else None
            context = stage_ms["context"] if filling is not None and self._level.context_times else None
            self.budget.record(self._level, FrameMs(stage_ms["geometry"], pixels, filling, context))
        self.in_flight, self.in_flight_since = info.frame, now
        self._deliver(message)

    def fail(self, message: str) -> None:
        """Say so once; the same view is not tried again, the next one is."""
        self._full = True
        self._complain(message)

    def state_json(self, span: Span, edge: float) -> dict[str, Any]:
        """This viewer's part of the message `state`."""
        clock = self.clock
        now = clock.time(span)
        behind = max(0, int(edge) - now) if span.live or not span.whole else 0
        return {
            "time": now,
            "playing": clock.playing,
            "speed": clock.speed,
            "live": clock.live,
            "behind": behind,
            "buffering": self.buffering,
        }

    def stats_json(self, viewers: int) -> dict[str, Any]:
        """The message `stats`: of the last second."""
        now = time.monotonic()
        recent = [shown for shown in list(self.recent) if shown.at > now - 1]
        stages = recent[0].stage_ms if recent else {}
        budget = None
        if self.budget is not None:
            level = self.budget.level
            budget = {
                "target_ms": round(self.budget.target_ms, 1),
                "predicted_ms": round(self.budget.predicted_ms(level), 1),
                "measured_ms": round(self.budget.measured_ms, 1),
                "scale": level.scale,
                "top_k": level.top_k,
                "context_times": level.context_times,
                "level": self.budget.index,
                "levels": len(self.budget.levels),
            }
        count_of = max(1, len(recent))
        return {
            "type": "stats",
            "fps": len(recent),
            "stage_ms": {s: round(sum(shown.stage_ms[s] for shown in recent) / count_of, 2) for s in stages},
            "kb_per_frame": round(sum(shown.size for shown in recent) / 1000 / count_of, 2),
            "dropped": self.dropped,
            "viewers": viewers,
            "shared": round(sum(shown.shared for shown in recent) / count_of, 3),
            "budget": budget,
        }
