"""A clock that runs ahead of the frames: late pictures are shown, rather than none."""

import itertools

import pytest
import torch

from viewmend.live.clock import Span
from viewmend.live.poses import RigFrame
from viewmend.live.protocol import ClockChange, Look
from viewmend.live.sessions import AWAITED_S, Playback, ViewerSession

AXES = torch.eye(3)
RIG = RigFrame(torch.zeros(3), AXES[1], AXES[2], AXES[0], 0.0, 0.0, 2.0, 50.0)
SPAN = Span(0, 1000, 1000, 30.0)


class Slow:
    """A viewer whose frames come so many steps after they were asked for; a step is a tenth of a second."""

    def __init__(self, steps):
        self.session = ViewerSession(lambda _: None, lambda _: None, None)
        self.session.change(ClockChange(seek=0, playing=True), SPAN)
        self.session.look(Look())
        self.steps, self.asked, self.step = steps, {}, 0
        self.span = SPAN
        self.start = self.session._last

    def has_frame(self, at):
        return self.step - self.asked.setdefault(at, self.step) >= self.steps

    def next(self):
        self.step += 1
        playback = Playback(self.span, 0.0, RIG, self.has_frame, 1)
        return self.session.next_request(self.start + 0.1 * self.step, playback)


def shown(slow, steps):
    return [request.time for request in (slow.next() for _ in range(steps)) if request is not None]


def test_frames_that_are_late_are_shown_late():
    times = shown(Slow(5), 60)
    assert len(times) >= 9, "one every six steps"
    assert all(10 <= later - earlier <= 25 for earlier, later in itertools.pairwise(times))


def test_one_time_is_waited_for_at_a_time():
    slow = Slow(5)
    times = shown(slow, 60)
    assert len(slow.asked) <= len(times) + 1


def test_who_pauses_waits_for_the_time_that_he_sees():
    slow = Slow(5)
    slow.next()
    slow.session.change(ClockChange(seek=700, playing=False), SPAN)
    assert shown(slow, 10) == [700]


@pytest.mark.parametrize("why", ["it never comes", "it is forgotten"])
def test_a_time_that_does_not_come_is_given_up(why):
    slow = Slow(2)
    slow.next()
    (lost,) = slow.asked
    slow.asked[lost] = 10**9
    if why == "it is forgotten":
        slow.span = Span(lost + 1, 1000, None, 30.0, live=True)
        assert shown(slow, 6)
    else:
        assert not shown(slow, 50) and shown(slow, int(10 * AWAITED_S))
