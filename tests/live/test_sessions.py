"""What a viewer is shown next: newest look, one frame in flight, better when still."""

import time

import pytest
import torch
from reference.ball import ring

from viewmend.inpainting.protocol import State
from viewmend.live import sessions
from viewmend.live.budget import CONTEXT_LADDER, FULL, READING_LADDER
from viewmend.live.clock import Span
from viewmend.live.poses import rig_frame
from viewmend.live.protocol import ClockChange, FrameTimes, Look, unpack
from viewmend.live.renderer import RenderResult
from viewmend.live.sessions import AWAITED_S, FULL_S, STILL_S, Playback, SentFrame, ViewerSession
from viewmend.timing import StageTimes

FRAME = rig_frame(ring(4), torch.zeros(3), None)
SPAN = Span(0, 20, 20, 10.0)


class Desk:
    """A session, and a hand that turns its clock and acknowledges."""

    def __init__(self, budget_ms=None, present=lambda time: True, ladder=CONTEXT_LADDER):
        self.sent, self.errors, self.now = [], [], 1000.0
        self.session = ViewerSession(self.sent.append, self.errors.append, budget_ms, ladder)
        self.session._last = self.now
        self.present, self.edge, self.active_viewers = present, 0.0, 1

    def look(self, **values):
        self.session.look(Look(**values))
        self.session._look_at = self.now

    def due(self, after=0.01, edge=None):
        self.now += after
        self.edge = self.edge if edge is None else edge
        return self.session.next_request(self.now, Playback(SPAN, self.edge, FRAME, self.present, self.active_viewers))

    def size(self, request):
        return tuple(request.cameras[0].size_px[0].tolist())

    def pause(self):
        self.session.change(ClockChange(playing=False), SPAN)


def test_nobody_is_served_who_does_not_look():
    assert Desk().due() is None


def test_the_newest_look_wins():
    desk = Desk()
    for azimuth in range(5):
        desk.look(id=azimuth)
    assert desk.due() is not None and desk.session._shown[0].id == 4
    assert desk.session.dropped == 4


def test_the_same_look_again_is_answered_again():
    desk = Desk()
    desk.pause()
    for _ in range(3):
        desk.look(id=1)
        assert desk.due() is not None and desk.due() is None


def test_one_frame_is_in_flight_until_it_is_acknowledged():
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


def test_time_goes_on_and_what_was_skipped_is_counted():
    desk = Desk()
    desk.look(id=1)
    times = [desk.due(edge=edge).time for edge in (0.0, 1.2, 5.9)]
    assert times == [0, 1, 5] and desk.due() is None and desk.session.dropped == 3


def test_a_moving_view_is_small_and_a_still_one_full():
    desk = Desk()
    desk.pause()
    desk.look(id=1, moving=True, width=200, height=100)
    request = desk.due()
    assert desk.size(request) == (100, 50) and request.quality.context_times == 0
    assert desk.due(1.0) is None, "a moving view is not refined"
    desk.look(id=2, width=200, height=100)
    request = desk.due()
    assert desk.size(request) == (200, 100) and request.quality.context_times == 7
    assert desk.due(1.0) is None, "nothing better follows"
    desk.look(id=3, moving=True, adaptive=False, width=200, height=100)
    assert desk.size(desk.due()) == (200, 100)


def test_a_still_view_is_refined_in_two_steps():
    desk = Desk(budget_ms=50.0)
    desk.pause()
    desk.look(id=1, scale=0.5, top_k=100)
    first = desk.due()
    assert desk.size(first)[0] < 160 and first.quality.top_k == 100
    assert desk.due(STILL_S / 2) is None
    better = desk.due(STILL_S)
    assert desk.size(better) == (160, 160) and better.quality.context_times == 0
    assert not desk.session._full and desk.due(0.1) is None
    best = desk.due(FULL_S)
    assert best.quality.context_times == FULL.context_times and desk.session._full
    assert best.quality.top_k == 100 and desk.due(1.0) is None


def test_a_model_that_tells_errors_reads_a_part_while_it_is_looked_for():
    desk = Desk(ladder=READING_LADDER)
    desk.pause()
    desk.look(id=1, moving=True, width=200, height=100)
    request = desk.due()
    assert desk.size(request) == (200, 100) and request.quality.read_fraction == 0
    desk = Desk(budget_ms=50.0, ladder=READING_LADDER)
    desk.pause()
    desk.look(id=1)
    assert desk.due().quality.read_fraction is not None
    assert desk.due(STILL_S).quality.read_fraction == READING_LADDER.still.read_fraction
    assert desk.due(FULL_S).quality.read_fraction is None


def test_budgets_are_shared_among_a_crowd():
    desk = Desk(budget_ms=80.0)
    desk.active_viewers = 4
    desk.look(id=1)
    desk.due()
    assert desk.session.budget.target_ms == 20


def test_a_frame_that_is_not_there_is_waited_for():
    there = set()
    desk = Desk(present=lambda time: time in there)
    desk.look(id=1)
    assert desk.due() is None and desk.session.buffering
    there.add(0)
    assert desk.due().time == 0 and not desk.session.buffering


def test_what_was_waited_for_is_shown_once_and_then_time_goes_on():
    there = set(range(20)) - {5}
    desk = Desk(present=lambda time: time in there)
    desk.look(id=1)
    assert desk.due(edge=5.0) is None and desk.session.buffering
    assert desk.due(edge=6.0) is None and desk.session.buffering, "6 is at hand, but 5 is on its way"
    there.add(5)
    assert [desk.due(edge=edge).time for edge in (6.5, 7.0, 8.0)] == [5, 7, 8]


def test_what_never_comes_is_waited_for_some_seconds():
    desk = Desk(present=lambda time: time != 5)
    desk.look(id=1)
    assert desk.due(edge=5.0) is None
    assert desk.due(AWAITED_S - 0.1, edge=7.0) is None
    assert desk.due(0.2, edge=7.0).time == 7


def test_a_viewer_counts_for_a_second_after_its_last_frame():
    desk = Desk()
    assert not desk.session.is_active(desk.now), "who says nothing waits for nothing"
    desk.look(id=1)
    assert desk.session.is_active(desk.now), "waits for a first view"
    desk.due()
    assert not desk.session.is_active(desk.now)
    desk.session.recent.append(SentFrame(desk.now, FrameTimes(), 1))
    assert desk.session.is_active(desk.now + 0.9) and not desk.session.is_active(desk.now + 1.1)


def test_a_key_frame_is_owed_until_a_frame_has_it(monkeypatch):
    """A look that asks for one may be dropped for the next, which does not."""
    keys = []

    def message(look, request, result, info, encoders):
        keys.append(info.key)
        return b"", FrameTimes()

    monkeypatch.setattr(sessions, "frame_message", message)
    desk = Desk()
    for key in (True, False):
        desk.look(id=1, key=key)
    result = RenderResult(0, (), State(), StageTimes())
    for _ in range(2):
        desk.session.show(desk.due(), result)
        desk.session.ack(desk.session.in_flight)
        desk.look(id=2)
    assert keys == [True, False]


def test_statistics_tell_how_many_views_found_the_geometry_made():
    desk = Desk()
    for geometry in (7.0, 0.0, 0.0):
        desk.session.recent.append(SentFrame(time.monotonic(), FrameTimes(geometry=geometry, encode=2.0), 1500))
    desk.session.recent.appendleft(SentFrame(time.monotonic() - 2, FrameTimes(geometry=900.0), 10**6))
    stats = desk.session.stats_json(4)
    assert (stats["shared"], stats["fps"], stats["kb_per_frame"], stats["viewers"]) == (0.667, 3, 1.5, 4)
    assert stats["stage_ms"]["geometry"] == pytest.approx(7 / 3, abs=0.01) and stats["budget"] is None


def test_a_view_at_rest_that_failed_is_not_refined():
    desk = Desk(budget_ms=50.0)
    desk.pause()
    desk.look(id=1)
    assert desk.due() is not None
    desk.session.fail("no")
    assert desk.due(STILL_S) is None and desk.due(FULL_S) is None


def test_what_failed_is_said_and_not_tried_again_before_something_changes():
    desk = Desk()
    desk.look(id=1)
    desk.due()
    desk.session.fail("no")
    assert desk.errors == ["no"] and desk.due(1.0) is None
    assert desk.due(edge=1.0) is not None


def test_rendering_without_mending_costs_no_filling():
    desk = Desk()
    desk.look(id=1, modes=("rendered", "holes"))
    assert not desk.due().quality.mend
    desk.look(id=2, modes=("rendered", "mended"))
    assert desk.due().quality.mend
    desk.look(id=3, modes=("confidence",), error_rule="all")
    request = desk.due()
    assert request.quality.mend and request.error_rule == "all"


@pytest.mark.parametrize("mode", ["mended", "depth"])
def test_frames_say_what_they_are(ball_view, mode):
    desk = Desk()
    desk.look(id=5, sent_ms=12.5, modes=(mode,), depth=True)
    request = desk.due()
    desk.session.show(
        request,
        RenderResult(0, (ball_view,), State(), StageTimes(geometry=3.0, context=2.0, rendering=4.0, inpainting=5.0)),
    )
    header, parts = unpack(desk.sent[0])
    assert (header["look"], header["sent_ms"], header["frame"], header["full"]) == (5, 12.5, 0, True)
    assert [part["kind"] for part in header["parts"]] == ["image", "depth"] and parts[0][:2] == b"\xff\xd8"
    stages = header["stage_ms"]
    assert list(stages) == ["geometry", "context", "rendering", "inpainting", "encode", "wait", "total"]
    assert (stages["geometry"], stages["inpainting"]) == (3, 5) and stages["encode"] > 0 and 0 < header["holes"] < 1
    assert stages["total"] == pytest.approx(14 + stages["encode"] + stages["wait"], abs=0.02)
    assert desk.session.stats_json(1)["stage_ms"] == stages
    assert header["colours"][0] == [230, 120, 60] and len(header["cameras"][0]["K"]) == 9
    assert desk.session.in_flight == 0 and desk.session.stats_json(1)["viewers"] == 1


def test_a_view_at_rest_may_ask_for_more_pixels_and_the_budget_counts_in_those_of_moving_ones():
    desk = Desk(budget_ms=50.0)
    desk.pause()
    desk.look(id=1, moving=True, width=200, height=100)
    moving = desk.size(desk.due())
    desk.look(id=2, width=800, height=400)
    assert desk.size(desk.due()) == moving, "the first answer comes as soon as if nothing had been asked"
    assert desk.size(desk.due(STILL_S)) == desk.size(desk.due(FULL_S)) == (800, 400)
    assert desk.session._enlarged(desk.session._shown[0]) == 4, "sides four times as long"
    desk.look(id=3, moving=True, width=800, height=400)
    assert desk.size(desk.due())[0] == 4 * moving[0], "who moves in large pictures has meant it"
