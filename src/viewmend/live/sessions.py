"""Viewers' sessions: what each wants to be rendered next, and where the result goes."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count
from math import sqrt
from typing import Any, Protocol, runtime_checkable

from viewmend.inpainting.protocol import RenderQuality, State
from viewmend.live.budget import CONTEXT_LADDER, FULL, Budget, Ladder, QualityLevel
from viewmend.live.clock import Clock, Span
from viewmend.live.pace import Pace
from viewmend.live.packing import Encoders, FrameInfo, frame_message
from viewmend.live.poses import RigFrame, view_camera
from viewmend.live.protocol import HULL_MODES, MENDED_MODES, ClockChange, FrameTimes, Look
from viewmend.live.renderer import RenderRequest, RenderResult

STILL_S, FULL_S = 0.25, 0.8
"""Seconds that a view has been still when it is rendered again. The sharp picture comes first, since whoever moves on
waits for it; then all that the model can do."""

AWAITED_S = 10.0
"""So long a time is waited for that the clock has passed."""


@dataclass(frozen=True)
class Playback:
    """What sessions choose their next view from."""

    span: Span
    edge: float
    """The position of the viewers who follow the edge."""
    rig_frame: RigFrame
    has_frame: Callable[[int], bool]
    """Whether a time's frame is at hand. If it is not, asking begins to read it."""
    active_viewers: int
    """Viewers that a frame was sent to within the last second, or who wait for one, this one included."""
    pace: Pace = field(default_factory=Pace)
    """How long pictures take."""
    company: bool = False
    """Whether there is more than one viewer, whether they wait for a view or not."""


@runtime_checkable
class Session(Protocol):
    """Asks for views. All calls come from the render thread; those but `show` come under the service's lock."""

    viewer: State | None

    def next_request(self, now: float, playback: Playback) -> RenderRequest | None:
        """The view that is wanted now."""
        ...

    def show(self, request: RenderRequest, result: RenderResult) -> FrameTimes:
        """Encode the view and pass it on; what all of it took."""
        ...

    def fail(self, message: str) -> None:
        """The view could not be rendered."""
        ...


@dataclass(frozen=True)
class SentFrame:
    """One frame that was sent, for statistics."""

    at: float
    times: FrameTimes
    size_bytes: int


class ViewerSession:
    """One viewer of the page: the newest look wins, one frame is in flight."""

    def __init__(
        self,
        deliver: Callable[[bytes], None],
        report_error: Callable[[str], None],
        budget_ms: float | None,
        ladder: Ladder = CONTEXT_LADDER,
    ) -> None:
        """Begin a session.

        Args:
            deliver: called with each frame's message, on the render thread.
            report_error: called with what went wrong, on the render thread.
            budget_ms: milliseconds that a view may take when alone; None without a limit.
            ladder: what views may be made with.
        """
        self.viewer: State | None = None
        self.clock = Clock()
        self.buffering = False
        self.dropped = 0
        self.recent: deque[SentFrame] = deque(maxlen=120)
        self.in_flight: int | None = None
        self.in_flight_since = 0.0
        self.budget = None if budget_ms is None else Budget(budget_ms, ladder.levels)
        self._ladder = ladder
        self._budget_ms = budget_ms
        self._deliver, self._report_error = deliver, report_error
        self._frame_numbers = count()
        self._look: Look | None = None
        self._look_at = 0.0
        self._last = time.monotonic()
        self._shown: tuple[Look | None, int] = (None, -1)
        """Look and time of the last request."""
        self._full = False
        self._awaited = (-1, 0.0)
        """The time that is on its way, and since when; -1 for none."""
        self._level, self._wait_ms = FULL, 0.0
        self.drawn = FULL
        """What the last view was made with: its level, smaller where many wait."""
        self._moving_px = 0.0
        """Pixels of the last look that moved or played. The budget counts in them: a view at rest may ask for more."""
        self._encoders, self._wants_key_frame = Encoders(), False

    def look(self, look: Look) -> None:
        """Set what to show from now on; a look that was not shown yet is dropped."""
        if self._look is not self._shown[0]:
            self.dropped += 1
        self._look, self._look_at = look, time.monotonic()
        self._wants_key_frame = self._wants_key_frame or look.key

    @property
    def newest_look(self) -> Look | None:
        """What the viewer wants to see; None before it said."""
        return self._look

    def change(self, change: ClockChange, span: Span) -> None:
        """Play, pause, seek, change speed, or follow the edge."""
        self.clock.change(change, span)

    def is_active(self, now: float) -> bool:
        """Whether a frame was sent within the last second, or the newest look waits for its first one."""
        waits = self.in_flight is None and self._look is not None and self._look is not self._shown[0]
        return waits or (bool(self.recent) and self.recent[-1].at > now - 1)

    def ack(self, frame: int) -> None:
        """A frame has arrived."""
        if frame == self.in_flight:
            self.in_flight = None

    def next_request(self, now: float, playback: Playback) -> RenderRequest | None:
        """The newest look at the clock's time, or the same view again at a better level."""
        seconds, self._last = now - self._last, now
        self.clock.advance(seconds, playback.span, playback.edge)
        look, at = self._look, self.clock.time(playback.span)
        self.buffering = False
        if look is None or at < 0 or self.in_flight is not None:
            return None
        is_new_look = look is not self._shown[0]  # by identity: the same look sent again is answered again
        is_new = is_new_look or at != self._shown[1]
        at_rest = not look.moving and not (self.clock.playing and playback.span.fps > 0)
        if is_new:
            self._moving_px = self._moving_px if at_rest and self._moving_px else look.pixels
            level = self._level_for(look, playback.active_viewers)
        else:
            level = self._refinement(now - self._look_at) if at_rest else None
        if level is None:
            return None
        if (at := self._at_hand(at, now, playback)) is None:
            self.buffering = True
            return None
        if is_new and not is_new_look and self.clock.playing:
            self.dropped += max(0, at - self._shown[1] - 1)
        self._level, self._full = level, level == FULL
        self.drawn = playback.pace.bounded(level, look.pixels, playback.active_viewers, playback.company)
        self._wait_ms = max(0.0, 1000 * (now - self._look_at)) if is_new_look else 0.0
        self._shown = (look, at)
        return self._request(look, at, playback.rig_frame)

    def _at_hand(self, at: int, now: float, playback: Playback) -> int | None:
        """The time to show: the clock's, or where that runs ahead of what comes, the one that was waited for."""
        awaited, since = self._awaited
        if self.clock.playing and playback.span.first <= awaited < at and now - since < AWAITED_S:
            at = awaited
        if playback.has_frame(at):
            self._awaited = (-1, now)
            return at
        if at != awaited:
            self._awaited = (at, now)
        return None

    def _refinement(self, still_s: float) -> QualityLevel | None:
        """The level for a view that has been still so long; None where it was rendered as well already."""
        if self._full:
            return None
        cost = self._level.relative_cost
        steps = ((STILL_S, self._ladder.still), (FULL_S, FULL))
        better = [level for after_s, level in steps if still_s >= after_s and level.relative_cost > cost]
        return better[-1] if better else None

    def _level_for(self, look: Look, active_viewers: int) -> QualityLevel:
        if self.budget is not None and self._budget_ms is not None:
            self.budget.target_ms = self._budget_ms / max(1, active_viewers)
            level = self.budget.level
        else:
            level = self._ladder.moving if look.moving else FULL
        if not look.adaptive:
            return replace(level, scale=1.0)
        return level if self.budget is None else replace(level, scale=level.scale * min(1.0, 1 / self._enlarged(look)))

    def _enlarged(self, look: Look) -> float:
        """How much longer the sides of this look's picture are than those of one that moves."""
        return sqrt(look.pixels / self._moving_px)

    def _request(self, look: Look, at: int, rig_frame: RigFrame) -> RenderRequest:
        level = self._level
        top_k = min((k for k in (level.top_k, look.top_k) if k is not None), default=None)
        mend = not MENDED_MODES.isdisjoint(look.modes)
        quality = RenderQuality(
            mend=mend, top_k=top_k, context_times=level.context_times, read_fraction=level.read_fraction
        )
        scale = look.scale * self.drawn.scale
        cameras = tuple(view_camera(eye, rig_frame, (look.width, look.height), scale) for eye in look.cameras)
        return RenderRequest(at, cameras, quality, look.error_rule, HULL_MODES & {*look.modes})

    def show(self, request: RenderRequest, result: RenderResult) -> FrameTimes:
        """Encode and send a frame, and learn from what it took."""
        look = self._shown[0]
        assert look is not None, "views are rendered for those who look"
        self.viewer = result.viewer
        # Reset by the frame that has it: a look that is dropped leaves its wish to the next.
        key_frame, self._wants_key_frame = self._wants_key_frame, False
        info = FrameInfo(next(self._frame_numbers), self._full, self._wait_ms, self.dropped, key_frame)
        message, times = frame_message(look, request, result, info, self._encoders)
        self._learn(look, times, len(message))
        self.in_flight, self.in_flight_since = info.frame, time.monotonic()
        self._deliver(message)
        return times

    def _learn(self, look: Look, times: FrameTimes, size_bytes: int) -> None:
        """Remember what a view took."""
        self.recent.append(SentFrame(time.monotonic(), times, size_bytes))
        if self.budget is not None:
            self.budget.record(replace(self.drawn, scale=self.drawn.scale * self._enlarged(look)), times)

    def fail(self, message: str) -> None:
        """Report it once; the same view is not tried again, the next one is."""
        self._full = True
        self._report_error(message)

    def state_json(self, span: Span, edge: float) -> dict[str, Any]:
        """This viewer's part of the message `state`."""
        clock = self.clock
        now = clock.time(span)
        return {
            "time": now,
            "playing": clock.playing,
            "speed": clock.speed,
            "live": clock.live,
            "behind": max(0, int(edge) - now) if span.live or not span.complete else 0,
            "buffering": self.buffering,
        }

    def stats_json(self, viewers: int) -> dict[str, Any]:
        """The message `stats`: of the last second."""
        now = time.monotonic()
        recent = [sent for sent in list(self.recent) if sent.at > now - 1]
        frames = max(1, len(recent))
        return {
            "type": "stats",
            "fps": len(recent),
            "stage_ms": sum((sent.times for sent in recent), FrameTimes()).as_json(frames) if recent else {},
            "kb_per_frame": round(sum(sent.size_bytes for sent in recent) / 1000 / frames, 2),
            "dropped": self.dropped,
            "viewers": viewers,
            "shared": round(sum(sent.times.geometry == 0 for sent in recent) / frames, 3),
            "budget": None if self.budget is None else self.budget.as_json(),
        }
