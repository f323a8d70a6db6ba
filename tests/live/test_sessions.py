"""What a session requests next: the newest look, one frame at a time, and a better view once it is still."""

import itertools

import pytest
import torch
from live.live_servers import FakeClock
from reference.ball import photograph, ring

from viewmend.live import sessions
from viewmend.live.budget import CONTEXT_LADDER, FULL, MAX_WAIT_S, REFINE_LADDER, ResolutionLimit
from viewmend.live.frame_source import Span
from viewmend.live.poses import home_view
from viewmend.live.protocol import ClockChange, FrameTimes, Limits, Look, unpack
from viewmend.live.renderer import RenderResult
from viewmend.live.sessions import FULL_S, MAX_AWAITED_S, STILL_S, PlaybackState, SentFrame, ViewerSession
from viewmend.models.base import RenderQuality, State
from viewmend.utils.timing import StageTimes

HOME = home_view(ring(4), torch.zeros(3), None)
SPAN = Span(0, 20, 20, 10.0)
FRAME = photograph(ring(2))


class Desk:
    """A session, its clock, and the frames that are in memory."""

    def __init__(
        self, budget_ms=None, has_frame=lambda index: True, ladder=CONTEXT_LADDER, span=SPAN, paused=False
    ):
        self.sent, self.errors, self.clock = [], [], FakeClock()
        self.session = ViewerSession(self.sent.append, self.errors.append, budget_ms, ladder, self.clock)
        self.has_frame, self.span, self.edge, self.active_viewers = has_frame, span, 0.0, 1
        self.limit = ResolutionLimit()
        if paused:
            self.change_clock(playing=False)

    def look(self, **values):
        self.session.look(Look(**values))

    def due(self, after=0.01, edge=None):
        """The request some seconds later."""
        self.clock.advance(after)
        self.edge = self.edge if edge is None else edge
        playback = PlaybackState(self.span, self.edge, HOME, self.read, self.active_viewers, self.limit)
        return self.session.next_request(self.clock(), playback)

    def read(self, index):
        return FRAME if self.has_frame(index) else None

    def size(self, request):
        return tuple(request.cameras[0].size_px[0].tolist())

    def change_clock(self, **change):
        self.session.change_clock(ClockChange(**change), self.span, 0.0)


def test_the_newest_look_wins():
    desk = Desk()
    for azimuth in range(5):
        desk.look(id=azimuth)
    assert desk.due() is not None and desk.session.requested.look.id == 4
    assert desk.session.dropped == 4


def test_a_repeated_look_is_answered_again():
    desk = Desk(paused=True)
    for _ in range(3):
        desk.look(id=1)
        assert desk.due() is not None and desk.due() is None


def test_the_next_frame_waits_for_an_acknowledgement():
    desk = Desk()
    desk.look(id=1)
    assert desk.due() is not None
    desk.session.in_flight = 7
    desk.look(id=2)
    assert desk.due(edge=3.0) is None
    desk.session.ack(6)
    assert desk.due() is None
    desk.session.ack(7)
    assert desk.due().time == 3


def test_skipped_frames_are_counted():
    desk = Desk()
    desk.look(id=1)
    times = [desk.due(edge=edge).time for edge in (0.0, 1.2, 5.9)]
    assert times == [0, 1, 5] and desk.due() is None and desk.session.dropped == 3


def test_a_moving_view_is_small_and_a_still_one_full():
    desk = Desk(paused=True)
    desk.look(id=1, moving=True, width=200, height=100)
    request = desk.due()
    assert desk.size(request) == (100, 50) and request.quality.context_times == 0
    assert desk.due(1.0) is None, "a moving view is not refined"
    desk.look(id=2, width=200, height=100)
    request = desk.due()
    assert desk.size(request) == (200, 100) and request.quality == RenderQuality()
    assert desk.due(1.0) is None, "there is no better view"
    desk.look(id=3, moving=True, adaptive=False, width=200, height=100)
    assert desk.size(desk.due()) == (200, 100)


def test_a_client_that_draws_by_itself_gets_the_full_view_only():
    desk = Desk(budget_ms=5.0, paused=True)
    desk.look(id=1, full=True, width=200, height=100)
    request = desk.due()
    assert desk.size(request) == (200, 100) and request.quality == RenderQuality()
    assert desk.due(FULL_S + 1) is None, "there is no better view"


def test_a_cancelled_look_is_neither_rendered_nor_sent(ball_view):
    desk = Desk(paused=True)
    result = RenderResult(0, (ball_view,), State(), StageTimes())
    desk.look(id=1)
    request = desk.due()
    desk.session.cancel()
    desk.session.deliver(request, result)
    assert not desk.sent and desk.session.in_flight is None and desk.due(1.0) is None
    desk.look(id=2)
    desk.session.deliver(desk.due(), result)
    assert [unpack(message)[0]["look"] for message in desk.sent] == [2]


def test_a_look_after_a_cancelled_one_replaces_nothing():
    desk = Desk(paused=True)
    desk.look(id=1)
    assert desk.due() is not None
    desk.session.cancel()
    desk.look(id=2)
    assert desk.session.dropped == 0


def test_only_a_final_view_is_cancelled_by_what_replaces_it():
    desk = Desk(budget_ms=50.0, paused=True)
    desk.look(id=1)
    assert desk.due() is not None
    desk.look(id=2)
    assert not desk.session.is_cancelled, "the views of a movement are shown"
    assert desk.due() is not None and desk.due(FULL_S) is not None
    desk.look(id=3)
    assert desk.session.is_cancelled, "a better view of what was left behind"
    desk.session.give_up()
    desk.look(id=4, full=True)
    assert desk.due() is not None and not desk.session.is_cancelled
    desk.change_clock(seek=5)
    assert desk.session.is_cancelled
    desk.session.give_up()
    assert desk.due().time == 5 and desk.due() is None, "the same look is rendered at the new time"


def test_a_still_view_is_refined_in_two_steps():
    desk = Desk(budget_ms=50.0, paused=True)
    desk.look(id=1, scale=0.5, top_k=100)
    first = desk.due()
    assert desk.size(first)[0] < 160 and first.quality.top_k == 100
    assert desk.due(STILL_S / 2) is None
    better = desk.due(STILL_S)
    assert desk.size(better) == (160, 160) and better.quality.context_times == 0
    assert not desk.session._is_final and desk.due(0.1) is None
    best = desk.due(FULL_S)
    assert best.quality == RenderQuality(top_k=100) and desk.session._is_final and desk.due(1.0) is None


def test_a_model_that_predicts_errors_refines_less_of_a_moving_view():
    desk = Desk(ladder=REFINE_LADDER, paused=True)
    desk.look(id=1, moving=True, width=200, height=100)
    request = desk.due()
    assert desk.size(request) == (200, 100) and request.quality.refine_fraction == 0
    desk = Desk(budget_ms=50.0, ladder=REFINE_LADDER, paused=True)
    desk.look(id=1)
    assert desk.due().quality.refine_fraction is not None
    assert desk.due(STILL_S).quality.refine_fraction == REFINE_LADDER.still.refine_fraction
    assert desk.due(FULL_S).quality.refine_fraction is None


def test_the_budget_is_shared_by_all_active_viewers():
    desk = Desk(budget_ms=80.0)
    desk.active_viewers = 4
    desk.look(id=1)
    desk.due()
    assert desk.session.budget.target_ms == 20


def test_an_awaited_frame_is_shown_once():
    there = set(range(20)) - {5}
    desk = Desk(has_frame=lambda index: index in there)
    desk.look(id=1)
    assert desk.due(edge=5.0) is None and desk.session.buffering
    assert desk.due(edge=6.0) is None and desk.session.buffering, "6 is in memory, but 5 is being read"
    there.add(5)
    assert [desk.due(edge=edge).time for edge in (6.5, 7.0, 8.0)] == [5, 7, 8]


def test_a_viewer_counts_for_a_second_after_its_last_frame():
    desk = Desk()
    assert not desk.session.is_active(desk.clock()), "without a look it waits for nothing"
    desk.look(id=1)
    assert desk.session.is_active(desk.clock()), "waits for a first view"
    desk.due()
    assert not desk.session.is_active(desk.clock())
    desk.session.recent.append(SentFrame(desk.clock(), FrameTimes(), 1))
    assert desk.session.is_active(desk.clock() + 0.9) and not desk.session.is_active(desk.clock() + 1.1)
    desk.look(id=2)
    desk.session.in_flight = 3
    assert not desk.session.is_active(desk.clock() + 2), "it has a frame that it has not acknowledged"


def test_a_requested_key_frame_is_not_lost_with_a_dropped_look(monkeypatch):
    keys = []

    def encode(look, request, result, encoders, wait_ms, **fields):
        keys.append(encoders.key_frame)
        return b"", FrameTimes()

    monkeypatch.setattr(sessions, "encode_frame", encode)
    desk = Desk()
    for key in (True, False):
        desk.look(id=1, key=key)
    result = RenderResult(0, (), State(), StageTimes())
    for _ in range(2):
        desk.session.deliver(desk.due(), result)
        desk.session.ack(desk.session.in_flight)
        desk.look(id=2)
    assert keys == [True, False]


def test_statistics_of_the_last_second():
    desk = Desk()
    for geometry in (7.0, 0.0, 0.0):
        desk.session.recent.append(SentFrame(desk.clock(), FrameTimes(geometry=geometry, encode=2.0), 1500))
    desk.session.recent.appendleft(SentFrame(desk.clock() - 2, FrameTimes(geometry=900.0), 10**6))
    stats = desk.session.stats_json(4)
    assert (stats["shared"], stats["fps"], stats["kb_per_frame"], stats["viewers"]) == (0.667, 3, 1.5, 4)
    assert stats["stage_ms"]["geometry"] == pytest.approx(7 / 3, abs=0.01) and stats["budget"] is None


def test_a_failure_is_reported_and_not_tried_again_before_something_changes():
    desk = Desk(budget_ms=50.0)
    desk.look(id=1)
    desk.due()
    desk.session.fail("no")
    assert desk.errors == ["no"] and desk.due(STILL_S) is None and desk.due(FULL_S) is None, (
        "it is not refined"
    )
    assert desk.due(edge=1.0) is not None


def test_only_some_modes_need_inpainting():
    desk = Desk()
    desk.look(id=1, modes=("rendered", "holes"))
    assert not desk.due().quality.mend
    desk.look(id=2, modes=("rendered", "completed"))
    assert desk.due().quality.mend
    desk.look(id=3, modes=("confidence",), error_rule="all")
    request = desk.due()
    assert request.quality.mend and request.error_rule == "all"


@pytest.mark.parametrize("mode", ["completed", "depth"])
def test_the_header_describes_the_frame(ball_view, mode):
    desk = Desk()
    desk.look(id=5, sent_ms=12.5, modes=(mode,), depth=True)
    request = desk.due()
    desk.session.deliver(
        request,
        RenderResult(
            0, (ball_view,), State(), StageTimes(geometry=3.0, context=2.0, rendering=4.0, inpainting=5.0)
        ),
    )
    header, parts = unpack(desk.sent[0])
    assert (header["look"], header["sent_ms"], header["frame"], header["full"]) == (5, 12.5, 0, True)
    assert [part["kind"] for part in header["parts"]] == ["image", "depth"] and parts[0][:2] == b"\xff\xd8"
    stages = header["stage_ms"]
    assert list(stages) == ["geometry", "context", "rendering", "inpainting", "encode", "wait", "total"]
    assert (
        (stages["geometry"], stages["inpainting"]) == (3, 5)
        and stages["encode"] > 0
        and 0 < header["holes"] < 1
    )
    assert stages["total"] == pytest.approx(14 + stages["encode"] + stages["wait"], abs=0.02)
    assert desk.session.stats_json(1)["stage_ms"] == stages
    assert header["colours"][0] == [230, 120, 60] and len(header["cameras"][0]["K"]) == 9
    assert desk.session.in_flight == 0 and desk.session.stats_json(1)["viewers"] == 1


def test_a_still_view_may_have_more_pixels_than_the_budget_counts():
    desk = Desk(budget_ms=50.0, paused=True)
    desk.look(id=1, moving=True, width=200, height=100)
    moving = desk.size(desk.due())
    desk.look(id=2, width=800, height=400)
    assert desk.size(desk.due()) == moving, "the first answer is as fast as a moving one"
    assert desk.size(desk.due(STILL_S)) == desk.size(desk.due(FULL_S)) == (800, 400)
    assert desk.session._enlargement(desk.session.requested.look) == 4, "sides four times as long"
    desk.look(id=3, moving=True, width=800, height=400)
    assert desk.size(desk.due())[0] == 4 * moving[0], "a large moving view was requested on purpose"


@pytest.mark.parametrize(("active", "side"), [(1, 1448), (8, round(1448 * (MAX_WAIT_S / (8 * 2.0)) ** 0.5))])
def test_resolution_depends_on_the_number_of_active_viewers(active, side):
    desk = Desk()
    desk.limit.record(Limits().max_pixels, FULL, 2.0)
    desk.active_viewers = active
    desk.look(width=1448, height=1448, adaptive=False)
    assert desk.size(desk.due()) == pytest.approx((side, side), abs=1)


class SlowFrames(Desk):
    """A playing viewer whose frames are in memory some steps of 0.1 s after they were requested."""

    def __init__(self, steps):
        super().__init__(has_frame=self.is_read, span=Span(0, 1000, 1000, 30.0))
        self.change_clock(seek=0, playing=True)
        self.look()
        self.steps, self.requested = steps, {}

    def is_read(self, index):
        return self.clock() - self.requested.setdefault(index, self.clock()) > 0.1 * self.steps - 0.01

    def play(self, steps):
        """The frames that are shown within these steps."""
        return [request.time for request in (self.due(0.1) for _ in range(steps)) if request is not None]


def test_late_frames_are_shown_one_after_the_other():
    slow = SlowFrames(5)
    frames = slow.play(60)
    assert len(frames) >= 9, "one every six steps"
    assert all(10 <= later - earlier <= 25 for earlier, later in itertools.pairwise(frames))
    assert len(slow.requested) <= len(frames) + 1


def test_a_paused_viewer_waits_for_the_frame_of_its_clock():
    slow = SlowFrames(5)
    slow.due(0.1)
    slow.change_clock(seek=700, playing=False)
    assert slow.play(10) == [700]


@pytest.mark.parametrize("is_dropped", [False, True])
def test_playback_goes_on_without_a_frame_that_never_comes(is_dropped):
    slow = SlowFrames(2)
    slow.due(0.1)
    (lost,) = slow.requested
    slow.requested[lost] = 1e9
    if is_dropped:
        slow.span = Span(lost + 1, 1000, None, 30.0, live=True)
        assert slow.play(6)
    else:
        assert not slow.play(50) and slow.play(int(10 * MAX_AWAITED_S))
