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
from viewmend.types import MultiViewFrame

STILL_S = 0.25
"""A view that has been still for this many seconds is rendered again at the level `Ladder.still`."""
FULL_S = 0.8
"""A view that has been still for this many seconds is rendered again at full quality."""
MAX_AWAITED_S = 10.0
"""A playing viewer waits at most this many seconds for a frame to be read, while its clock runs on."""


@dataclass(frozen=True)
class PlaybackState:
    """The source's frames and the server's load, from which sessions choose their next views."""

    span: Span
    edge: float
    """Playback position, in frames, of all viewers that follow the edge."""
    home: HomeView
    read: Callable[[int], MultiViewFrame | None]
    """Returns a frame; None if it is not in memory, in which case it is requested from the source."""
    active_viewers: int
    """The number of viewers that were sent a frame within the last second or wait for one; at least 1."""
    resolution_limit: ResolutionLimit = field(default_factory=ResolutionLimit)
    has_other_viewers: bool = False
    """Whether more than one viewer is connected, active or not."""


@dataclass(frozen=True)
class ShownFrame:
    """The frame that a viewer's page shows, and how."""

    time: int
    """The frame's index."""
    without: tuple[str, ...]
    """Cameras that are not used."""
    eye: Cameras | None
    """The camera of the viewer's last look; None before the first."""
    interval_s: float
    """Seconds from one frame to the next; infinite while the clock is paused."""

    @property
    def key(self) -> FrameKey:
        """The frame and the cameras that are not used."""
        return frame_key(self.time, self.without)


@dataclass(frozen=True)
class SentFrame:
    """A frame that was sent, for statistics."""

    sent_s: float
    times: FrameTimes
    size_bytes: int


@dataclass(frozen=True)
class RequestedView:
    """The view that a session requested last."""

    look: Look | None = None
    """None before the first request."""
    index: int = -1
    """The frame's index; -1 before the first request."""


@dataclass(frozen=True)
class AwaitedFrame:
    """A frame that a session waits for."""

    index: int
    """The frame's index; -1 for none."""
    since_s: float
    """When the session began to wait."""


class ViewerSession:
    """One viewer: a new look replaces earlier ones, and one frame at a time waits for its acknowledgement."""

    def __init__(
        self,
        send: Callable[[bytes], None],
        report_error: Callable[[str], None],
        budget_ms: float | None,
        ladder: Ladder = CONTEXT_LADDER,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Set up a session.

        Args:
            send: called with each encoded frame, on the render thread.
            report_error: called with each error message, on the render thread.
            budget_ms: the time that a view may take if there are no other viewers; None for no limit.
            ladder: the model's quality levels.
            now: the service's clock, in seconds.
        """
        self.viewer: State | None = None
        self.clock = Clock()
        self.clock_changes = 0
        self.buffering = False
        self.dropped = 0
        """Looks and frames that were replaced before they were rendered."""
        self.recent: deque[SentFrame] = deque(maxlen=120)
        self.in_flight: int | None = None
        """The number of the frame that was sent and not yet acknowledged; None if there is none."""
        self.in_flight_since = 0.0
        self.budget = None if budget_ms is None else Budget(budget_ms, ladder.levels)
        self.rendered_level = FULL
        """The level of the requested view, as lowered by `ResolutionLimit`."""
        self._ladder = ladder
        self._send = send
        self._report_error = report_error
        self._now = now
        self._frame_numbers = count()
        self.wanted_look: Look | None = None
        """The look to show; None before the first one, and after it was cancelled."""
        self._last_look: Look | None = None
        """The last look, even if it was cancelled; None before the first."""
        self._look_arrived_s = 0.0
        self._clock_advanced_s = now()
        self.requested = RequestedView()
        self.is_cancelled = False
        """Whether the result of the last request is no longer needed."""
        self._is_final = False
        """Whether no better view of the requested look and frame will be requested."""
        self._is_refinement = False
        """Whether the requested view repeats the previous look and frame at a better level."""
        self._awaited = AwaitedFrame(-1, 0.0)
        self._chosen_level = FULL
        """The level of the requested view, before `ResolutionLimit` lowers it."""
        self._wait_ms = 0.0
        """Time from the arrival of the requested look to its request."""
        self._moving_px = 0.0
        """Pixels of the last look while the view moved or the clock played. Scales of the budget are
        relative to this number; a look at rest may have more pixels."""
        self._encoders = Encoders()

    def look(self, look: Look) -> None:
        """Set the look to show; an earlier one whose view was not requested yet is dropped."""
        if self._has_new_look:
            self.dropped += 1
        self.wanted_look = look
        self._last_look = look
        self._look_arrived_s = self._now()
        self._cancel_view_at_rest()
        self._encoders.key_frame |= look.key  # kept until a frame is encoded, even if this look is dropped

    def cancel(self) -> None:
        """Drop the look, and the view that is being rendered for it."""
        self.wanted_look = None
        self.is_cancelled = True

    def _cancel_view_at_rest(self) -> None:
        """Cancel the last request if it was for a viewer at rest; a moving viewer is sent every view."""
        look = self.requested.look
        self.is_cancelled |= look is not None and (look.full or self._is_refinement)

    def give_up(self) -> None:
        """Forget the last request, which was cancelled; its view is requested again if it is still wanted."""
        self.requested = RequestedView()

    @property
    def wants_views(self) -> bool:
        """Whether there is a look to show; pages that draw by themselves cancel theirs while they move."""
        return self.wanted_look is not None

    @property
    def _has_new_look(self) -> bool:
        """Whether no view of the wanted look was requested yet. A repeated look is a new one."""
        return self.wanted_look is not None and self.wanted_look is not self.requested.look

    def is_up_to_date(self, span: Span, edge: float) -> bool:
        """Whether no view is left to render, because the best view of the wanted look was, or there is no look."""
        if self.wanted_look is None:
            return True
        is_requested = not self._has_new_look and self.advance_clock(span, edge) == self.requested.index
        return is_requested and self._is_final

    def shown_frame(self, span: Span, edge: float, home: HomeView) -> ShownFrame | None:
        """The frame that the page shows now; None if there is none yet."""
        index = self.advance_clock(span, edge)
        if index < 0:
            return None
        look = self._last_look
        eye = None if look is None else view_camera(look.cameras[0], home, (look.width, look.height))
        plays = self.clock.playing and span.fps > 0
        interval_s = 1 / (span.fps * self.clock.speed) if plays else math.inf
        return ShownFrame(index, () if look is None else look.without, eye, interval_s)

    def advance_clock(self, span: Span, edge: float) -> int:
        """Advance the viewer's clock to now; returns the index of the frame to show, -1 if there is none."""
        now = self._now()
        self.clock.advance(now - self._clock_advanced_s, span, edge)
        self._clock_advanced_s = now
        return self.clock.frame(span)

    def change_clock(self, change: ClockChange, span: Span, edge: float) -> None:
        """Play, pause, seek, change the speed, or follow the edge."""
        self.advance_clock(span, edge)
        self.clock.change(change, span)
        self.clock_changes += 1
        self._cancel_view_at_rest()

    def is_active(self, now: float) -> bool:
        """Whether a frame was sent within the last second, or the viewer waits for a look's first view."""
        return (self._has_new_look and self.in_flight is None) or self.sent_since(now - 1)

    def sent_since(self, since_s: float) -> bool:
        """Whether a frame was sent after this moment."""
        return bool(self.recent) and self.recent[-1].sent_s > since_s

    def ack(self, frame: int) -> None:
        """Note that a frame has arrived."""
        if frame == self.in_flight:
            self.in_flight = None

    def next_request(self, now: float, playback: PlaybackState) -> RenderRequest | None:
        """The wanted look at the clock's frame, or the same view at a better level; None if no view is due."""
        self.buffering = False
        look = self.wanted_look
        if look is None or self.in_flight is not None:
            return None
        due = self.advance_clock(playback.span, playback.edge)
        if due < 0:
            return None

        # Choose the quality level.
        is_new_look = self._has_new_look
        is_new = is_new_look or due != self.requested.index
        level = self._next_level(look, is_new, now, playback)
        if level is None:
            return None

        # Choose the frame, and count the frames that playback skips.
        index = self._available_frame(due, now, playback)
        if index is None:
            self.buffering = True
            return None
        if is_new and not is_new_look and self.clock.playing:
            self.dropped += max(0, index - self.requested.index - 1)

        # Remember what is requested.
        self._chosen_level = level
        self._is_final = level == FULL
        self._is_refinement = not is_new
        self.is_cancelled = False
        self.rendered_level = playback.resolution_limit.apply(
            level, look.pixels, playback.active_viewers, playback.has_other_viewers
        )
        self._wait_ms = max(0.0, 1000 * (now - self._look_arrived_s)) if is_new_look else 0.0
        self.requested = RequestedView(look, index)
        return self._request(look, index, playback.home)

    def _next_level(
        self, look: Look, is_new: bool, now: float, playback: PlaybackState
    ) -> QualityLevel | None:
        """The level of a new view, or a better one for a view that is still; None if no view is due."""
        plays = self.clock.playing and playback.span.fps > 0
        is_at_rest = not look.moving and not plays
        if not is_new:
            return self._better_level(now - self._look_arrived_s) if is_at_rest else None
        is_first = self._moving_px == 0
        if is_first or not is_at_rest:
            self._moving_px = look.pixels
        return self._choose_level(look, playback.active_viewers)

    def _available_frame(self, due: int, now: float, playback: PlaybackState) -> int | None:
        """The frame to render if it is in memory; None while it is being read.

        This is the frame that is due. But a playing viewer that has requested an earlier frame keeps
        waiting for it: if frames are read more slowly than they play, none would be shown otherwise.
        """
        awaited = self._awaited
        is_behind = self.clock.playing and playback.span.first <= awaited.index < due
        keeps_waiting = is_behind and now - awaited.since_s < MAX_AWAITED_S
        index = awaited.index if keeps_waiting else due
        if playback.read(index) is not None:
            self._awaited = AwaitedFrame(-1, now)
            return index
        if index != awaited.index:
            self._awaited = AwaitedFrame(index, now)
        return None

    def _better_level(self, still_s: float) -> QualityLevel | None:
        """A better level for a view that has been still for this many seconds; None if none is due."""
        if self._is_final:
            return None
        cost = self._chosen_level.relative_cost
        steps = ((STILL_S, self._ladder.still), (FULL_S, FULL))
        better = [level for after_s, level in steps if still_s >= after_s and level.relative_cost > cost]
        return better[-1] if better else None

    def _choose_level(self, look: Look, active_viewers: int) -> QualityLevel:
        """The level of the first view of a look or frame."""
        if look.full:
            return FULL
        if self.budget is None:
            level = self._ladder.moving if look.moving else FULL
            return level if look.adaptive else replace(level, scale=1.0)
        self.budget.target_ms = self.budget.budget_ms / active_viewers
        level = self.budget.level
        if not look.adaptive:
            return replace(level, scale=1.0)
        # A larger image at rest first gets no more pixels than a moving one.
        return replace(level, scale=level.scale / max(1.0, self._enlargement(look)))

    def _enlargement(self, look: Look) -> float:
        """Side length of a look's image, relative to that of a moving view."""
        return math.sqrt(look.pixels / self._moving_px)

    def _request(self, look: Look, index: int, home: HomeView) -> RenderRequest:
        level = self._chosen_level
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
            return FrameTimes() + result.times
        number = next(self._frame_numbers)
        message, times = encode_frame(
            look,
            request,
            result,
            self._encoders,
            self._wait_ms,
            frame=number,
            full=self._is_final,
            dropped=self.dropped,
        )
        self._encoders.key_frame = False
        self.record(look, times, len(message))
        self.in_flight = number
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
        """Report an error once; the same view is not requested again."""
        self._is_final = True
        self._report_error(message)

    def state_json(self, span: Span, edge: float) -> dict[str, Any]:
        """This viewer's part of the message `state`, under the service's lock."""
        index = self.advance_clock(span, edge)
        clock = self.clock
        has_moving_edge = span.live or not span.complete
        return {
            "time": index,
            "playing": clock.playing,
            "speed": clock.speed,
            "live": clock.live,
            "behind": max(0, int(edge) - index) if has_moving_edge else 0,
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
            "shared": round(sum(sent.times.shares_geometry for sent in recent) / frames, 3),
            "budget": None if self.budget is None else self.budget.as_json(),
        }
