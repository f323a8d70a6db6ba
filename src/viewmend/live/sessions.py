"""Viewers' sessions: which view each one needs next, and where the result is sent."""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

from viewmend.geometry.cameras import Cameras
from viewmend.live.assets import FrameKey, frame_key
from viewmend.live.budget import CONTEXT_LADDER, FULL, Budget, ResolutionLimit
from viewmend.live.encoding import Encoders, encode_frame
from viewmend.live.frame_source import Clock, Span
from viewmend.live.poses import HomeView, view_camera
from viewmend.live.protocol import COMPLETED_MODES, EXTRA_MODES, ClockChange, FrameTimes, Look
from viewmend.live.quality import Ladder, QualityLevel
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.models.base import RenderQuality, State

STILL_S = 0.25
"""A view that has been still for this many seconds is rendered again, sharp and quickly."""
FULL_S = 0.8
"""A view that has been still for this many seconds is rendered again at full quality."""
MAX_AWAITED_S = 10.0
"""Playback waits at most this many seconds for a frame that its clock has passed."""


@dataclass(frozen=True)
class PlaybackState:
    """What sessions choose their next view from."""

    span: Span
    edge: float
    """Position of the viewers that follow the edge."""
    home: HomeView
    has_frame: Callable[[int], bool]
    """Whether a frame is in memory; the call requests it if it is not."""
    active_viewers: int
    """Viewers that were sent a frame within the last second or wait for one, including this one."""
    resolution_limit: ResolutionLimit = field(default_factory=ResolutionLimit)
    has_company: bool = False
    """Whether several viewers are connected, active or not."""


@dataclass(frozen=True)
class ShownFrame:
    """What a page shows now."""

    time: int
    """The frame's index."""
    without: tuple[str, ...]
    """Cameras that are not used."""
    eye: Cameras | None
    """The camera of the viewer's last view; None if there was none yet."""
    frame_s: float
    """Seconds until the next frame is shown; infinite while the clock is paused."""

    @property
    def key(self) -> FrameKey:
        """The frame and the cameras that are not used."""
        return frame_key(self.time, self.without)


@dataclass(frozen=True)
class SentFrame:
    """One sent frame, for statistics."""

    sent_s: float
    times: FrameTimes
    size_bytes: int


@dataclass(frozen=True)
class RequestedView:
    """The view of a session's last request."""

    look: Look | None = None
    index: int = -1
    """The frame's index; -1 before the first request."""


@dataclass(frozen=True)
class AwaitedFrame:
    """A frame that is being read for a session."""

    index: int
    """The frame's index; -1 for none."""
    since_s: float


class ViewerSession:
    """One viewer: the newest look replaces earlier ones, and one frame at a time waits for its acknowledgement."""

    def __init__(
        self,
        send: Callable[[bytes], None],
        report_error: Callable[[str], None],
        budget_ms: float | None,
        ladder: Ladder = CONTEXT_LADDER,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin a session; `send` gets frames and `report_error` messages, on the render thread.

        `budget_ms` is the time that a view may take if there are no other viewers; None for no limit.
        """
        self.viewer: State | None = None
        self.clock = Clock()
        self.clock_changes = 0
        self.buffering = False
        self.dropped = 0
        """Looks and frames that were replaced before they were rendered."""
        self.recent: deque[SentFrame] = deque(maxlen=120)
        self.in_flight: int | None = None
        """The frame that is not acknowledged yet."""
        self.in_flight_since = 0.0
        self.budget = None if budget_ms is None else Budget(budget_ms, ladder.levels)
        self.rendered_level = FULL
        """The level of the last view, after the limit on its resolution."""
        self._ladder = ladder
        self._send = send
        self._report_error = report_error
        self._now = now
        self._frame_numbers = count()
        self.newest_look: Look | None = None
        """The view to show; None before the first look, and after it was cancelled."""
        self._last_look: Look | None = None
        """The last look, also if it was cancelled; None before the first."""
        self._look_at = 0.0
        self._advanced_at = now()
        self.requested = RequestedView()
        self.is_cancelled = False
        """Whether the view that is being rendered is not needed any more."""
        self._is_full = False
        """Whether the requested view has the highest quality."""
        self._is_refined = False
        """Whether the requested view replaces one of the same look and frame."""
        self._awaited = AwaitedFrame(-1, 0.0)
        self._level = FULL
        """The level of the requested view, before the limit on its resolution."""
        self._wait_ms = 0.0
        """How long the requested look has waited."""
        self._moving_px = 0.0
        """Pixels of the last look that moved or played. The budget's scales are relative to these: a
        view at rest may have more."""
        self._encoders = Encoders()

    def look(self, look: Look) -> None:
        """Set the view to show; a look that was not rendered yet is dropped."""
        if self.newest_look is not self.requested.look:
            self.dropped += 1
        self.newest_look = look
        self._last_look = look
        self._look_at = self._now()
        self._cancel_final_view()
        self._encoders.key_frame |= look.key  # kept until a frame is encoded, even if this look is dropped

    def cancel(self) -> None:
        """Drop the look, and the view that is being rendered for it."""
        self.newest_look = None
        self.is_cancelled = True

    def _cancel_final_view(self) -> None:
        """Cancel the view being rendered if only a viewer at rest needs it; views of a movement are finished."""
        look = self.requested.look
        self.is_cancelled |= look is not None and (look.full or self._is_refined)

    def give_up(self) -> None:
        """Forget a request that was cancelled, so that its view is rendered if it is still wanted."""
        self.requested = RequestedView()

    @property
    def wants_views(self) -> bool:
        """Whether there is a look; pages that draw by themselves have none while they move."""
        return self.newest_look is not None

    def is_content(self, span: Span, edge: float) -> bool:
        """Whether no view has to be rendered: the newest look is shown at full quality, or the page draws itself."""
        look = self.newest_look
        if look is None:
            return True
        shown = self.requested
        return look is shown.look and self.frame(span, edge) == shown.index and self._is_full

    def shown_frame(self, span: Span, edge: float, home: HomeView) -> ShownFrame | None:
        """What the page shows now; None before the first frame."""
        index = self.frame(span, edge)
        if index < 0:
            return None
        look = self._last_look
        eye = None if look is None else view_camera(look.cameras[0], home, (look.width, look.height))
        plays = self.clock.playing and span.fps > 0
        frame_s = 1 / (span.fps * self.clock.speed) if plays else math.inf
        return ShownFrame(index, () if look is None else look.without, eye, frame_s)

    def frame(self, span: Span, edge: float) -> int:
        """The index of the frame to show now; -1 while there is none."""
        now = self._now()
        self.clock.advance(now - self._advanced_at, span, edge)
        self._advanced_at = now
        return self.clock.frame(span)

    def change_clock(self, change: ClockChange, span: Span, edge: float) -> None:
        """Play, pause, seek, change the speed, or follow the edge."""
        self.frame(span, edge)
        self.clock.change(change, span)
        self.clock_changes += 1
        self._cancel_final_view()

    def is_active(self, now: float) -> bool:
        """Whether a frame was sent within the last second, or the newest look waits for its first one."""
        is_new = self.newest_look is not None and self.newest_look is not self.requested.look
        return (is_new and self.in_flight is None) or self.sent_since(now - 1)

    def sent_since(self, since_s: float) -> bool:
        """Whether a frame was sent after this moment."""
        return bool(self.recent) and self.recent[-1].sent_s > since_s

    def ack(self, frame: int) -> None:
        """Note that a frame has arrived."""
        if frame == self.in_flight:
            self.in_flight = None

    def next_request(self, now: float, playback: PlaybackState) -> RenderRequest | None:
        """The newest look at the clock's frame, or the same view again at a better level; None for no view."""
        self.buffering = False
        look = self.newest_look
        if look is None or self.in_flight is not None:
            return None
        due = self.frame(playback.span, playback.edge)
        if due < 0:
            return None

        # the quality level; none if the same view was rendered as well already
        is_new_look = look is not self.requested.look  # by identity: a repeated look is answered again
        is_new = is_new_look or due != self.requested.index
        level = self._next_level(look, is_new, now, playback)
        if level is None:
            return None

        # the frame, or an earlier one that is still being read
        index = self._available_frame(due, now, playback)
        if index is None:
            self.buffering = True
            return None
        if is_new and not is_new_look and self.clock.playing:
            self.dropped += max(0, index - self.requested.index - 1)

        # the state of the new request
        self._level = level
        self._is_full = level == FULL
        self._is_refined = not is_new
        self.is_cancelled = False
        self.rendered_level = playback.resolution_limit.apply(
            level, look.pixels, playback.active_viewers, playback.has_company
        )
        self._wait_ms = max(0.0, 1000 * (now - self._look_at)) if is_new_look else 0.0
        self.requested = RequestedView(look, index)
        return self._request(look, index, playback.home)

    def _next_level(
        self, look: Look, is_new: bool, now: float, playback: PlaybackState
    ) -> QualityLevel | None:
        """The level of a new view, or a better one for a view that is still; None if there is nothing to render."""
        plays = self.clock.playing and playback.span.fps > 0
        at_rest = not look.moving and not plays
        if is_new:
            if not at_rest or not self._moving_px:
                self._moving_px = look.pixels
            return self._choose_level(look, playback.active_viewers)
        return self._refine(now - self._look_at) if at_rest else None

    def _available_frame(self, due: int, now: float, playback: PlaybackState) -> int | None:
        """The frame that is due, or an earlier one that is still being read; None while it is not in memory."""
        awaited = self._awaited
        keeps_waiting = self.clock.playing and playback.span.first <= awaited.index < due
        index = awaited.index if keeps_waiting and now - awaited.since_s < MAX_AWAITED_S else due
        if playback.has_frame(index):
            self._awaited = AwaitedFrame(-1, now)
            return index
        if index != awaited.index:
            self._awaited = AwaitedFrame(index, now)
        return None

    def _refine(self, still_s: float) -> QualityLevel | None:
        """The level for a view that has been still for this long; None if it has been rendered as well already."""
        if self._is_full:
            return None
        cost = self._level.relative_cost
        steps = ((STILL_S, self._ladder.still), (FULL_S, FULL))
        better = [level for after_s, level in steps if still_s >= after_s and level.relative_cost > cost]
        return better[-1] if better else None

    def _choose_level(self, look: Look, active_viewers: int) -> QualityLevel:
        if look.full:
            return FULL
        if self.budget is None:
            level = self._ladder.moving if look.moving else FULL
            return level if look.adaptive else replace(level, scale=1.0)
        self.budget.target_ms = self.budget.budget_ms / active_viewers
        level = self.budget.level
        scale = level.scale * min(1.0, 1 / self._enlargement(look)) if look.adaptive else 1.0
        return replace(level, scale=scale)

    def _enlargement(self, look: Look) -> float:
        """Ratio of the side lengths of this look's image to those of a moving one."""
        return math.sqrt(look.pixels / self._moving_px)

    def _request(self, look: Look, index: int, home: HomeView) -> RenderRequest:
        level = self._level
        top_k = min((k for k in (level.top_k, look.top_k) if k is not None), default=None)
        quality = RenderQuality(
            mend=not COMPLETED_MODES.isdisjoint(look.modes),
            top_k=top_k,
            context_times=level.context_times,
            refine_fraction=level.refine_fraction,
        )
        scale = look.scale * self.rendered_level.scale
        cameras = tuple(view_camera(eye, home, (look.width, look.height), scale) for eye in look.cameras)
        return RenderRequest(
            time=index,
            cameras=cameras,
            quality=quality,
            error_rule=look.error_rule,
            extra_modes=EXTRA_MODES & {*look.modes},
            without=look.without,
            model=look.model,
        )

    def deliver(self, request: RenderRequest, result: RenderResult) -> FrameTimes:
        """Encode and send a frame, and record its times."""
        look = self.requested.look
        assert look is not None, "a view is rendered for a look"
        self.viewer = result.viewer
        if self.is_cancelled:
            self.give_up()
            return FrameTimes(**vars(result.times))
        fields = {"frame": next(self._frame_numbers), "full": self._is_full, "dropped": self.dropped}
        message, times = encode_frame(look, request, result, self._encoders, self._wait_ms, **fields)
        self._encoders.key_frame = False
        self.record(look, times, len(message))
        self.in_flight = fields["frame"]
        self.in_flight_since = self._now()
        self._send(message)
        return times

    def record(self, look: Look, times: FrameTimes, size_bytes: int) -> None:
        """Add a frame's times to the statistics and the budget."""
        self.recent.append(SentFrame(self._now(), times, size_bytes))
        if self.budget is not None:
            level = self.rendered_level
            self.budget.record(replace(level, scale=level.scale * self._enlargement(look)), times)

    def fail(self, message: str) -> None:
        """Report an error once; the same view is not tried again."""
        self._is_full = True
        self._report_error(message)

    def state_json(self, span: Span, edge: float) -> dict[str, Any]:
        """This viewer's part of the message `state`, under the service's lock."""
        index = self.frame(span, edge)
        clock = self.clock
        return {
            "time": index,
            "playing": clock.playing,
            "speed": clock.speed,
            "live": clock.live,
            "behind": max(0, int(edge) - index) if span.live or not span.complete else 0,
            "buffering": self.buffering,
        }

    def stats_json(self, viewers: int) -> dict[str, Any]:
        """The message `stats`, about the last second."""
        since = self._now() - 1
        recent = [sent for sent in list(self.recent) if sent.sent_s > since]
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
