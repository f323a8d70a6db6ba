"""Turns: everybody is served, whatever the others do."""

from collections import Counter

import pytest
import torch
from reference.ball import ring

from viewmend.inpainting.protocol import RenderQuality, State
from viewmend.live.clock import Span
from viewmend.live.frames import FrameSupply, Rig, SourceStatus
from viewmend.live.poses import rig_frame, view_camera
from viewmend.live.protocol import Camera, FrameTimes
from viewmend.live.renderer import Renderer, RenderRequest, RenderResult
from viewmend.live.service import RenderService
from viewmend.timing import StageTimes

FRAME = rig_frame(ring(4), torch.zeros(3), None)
CAMERA = view_camera(Camera(), FRAME, (16, 16))


class Supply(FrameSupply):
    """Ten frames that are all there."""

    def __init__(self):
        super().__init__(Span(0, 10, 10, 10.0))
        self.status, self.rig = SourceStatus("ready"), Rig("x", None, None)

    def read(self, time):
        return object()


class Drawing(Renderer):
    """A renderer that renders nothing, and fails for one wish."""

    def __init__(self):
        self.frame = FRAME

    def is_of(self, rig):
        return True

    def render(self, request, viewer):
        if request.quality.top_k == 13:
            raise RuntimeError("bad luck")
        return RenderResult(request.time, (), State(), StageTimes(geometry=3.0, rendering=4.0))


class Eager:
    """Always wants a view."""

    viewer = None

    def __init__(self, name, log, top_k=None, bad=False):
        self.name, self.log, self.top_k, self.bad = name, log, top_k, bad
        self.failures = []

    def next_request(self, now, playback):
        if self.bad:
            raise KeyError("mine")
        return RenderRequest(0, (CAMERA,), RenderQuality(top_k=self.top_k))

    def show(self, request, rendered):
        self.log.append(self.name)
        return FrameTimes(**vars(rendered.times), encode=2.0)

    def fail(self, message):
        self.failures.append(message)


@pytest.fixture
def service():
    return RenderService(Drawing(), Supply())


def test_all_take_turns(service):
    log = []
    for name in "abc":
        service.join(Eager(name, log))
    for turn in range(9):
        if turn == 4:
            service.join(Eager("d", log))
        assert service._serve_next()
    assert max(Counter(log).values()) - min(Counter(log[4:]).values()) <= 2 and log[:3] == ["a", "b", "c"]


def test_who_fails_is_told_and_stops_nobody(service):
    log = []
    unlucky, odd = Eager("unlucky", log, top_k=13), Eager("odd", log, bad=True)
    for session in (odd, unlucky, Eager("a", log)):
        service.join(session)
    for _ in range(6):
        service._serve_next()
    assert log == ["a"] * 3 and unlucky.failures == ["RuntimeError: bad luck"] * 3 and len(odd.failures) >= 3
    assert service.counts == {"errors": 3, "frames": 3, "shared": 0}
    assert (service.times.encode, service.times.rendering, service.times.total) == (6.0, 12.0, 27.0)


def test_who_left_is_served_no_more(service):
    log = []
    session = Eager("a", log)
    service.join(session)
    service.leave(session)
    service.leave(session)
    assert not service._serve_next() and log == []
