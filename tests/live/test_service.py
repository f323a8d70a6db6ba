"""The render thread serves all sessions in turn, whatever happens to one of them."""

from collections import Counter

import pytest
import torch
from reference.ball import ring

from viewmend.live.frame_source import FrameSource, RigInfo, SourceStatus, Span
from viewmend.live.poses import home_view, view_camera
from viewmend.live.protocol import Camera, FrameTimes
from viewmend.live.render_jobs import RenderJob
from viewmend.live.renderer import FrameNotReadyError, Renderer, RenderRequest, RenderResult, RequestError
from viewmend.live.service import RenderService
from viewmend.models.base import RenderQuality, State
from viewmend.utils.cancellation import stop_if_cancelled
from viewmend.utils.timing import StageTimes

HOME = home_view(ring(4), torch.zeros(3), None)
CAMERA = view_camera(Camera(), HOME, (16, 16))


class FakeSource(FrameSource):
    """Ten frames in memory."""

    def __init__(self):
        super().__init__(Span(0, 10, 10, 10.0))
        self.status, self.rig = SourceStatus("ready"), RigInfo("x", None, None)

    def read(self, index):
        return object()


class FakeRenderer(Renderer):
    """Renders nothing, and fails for one request."""

    def __init__(self):
        self.home = HOME

    def is_prepared_for(self, rig):
        return True

    def render(self, request, viewer):
        if request.quality.top_k == 13:
            raise RuntimeError("bad luck")
        stop_if_cancelled()
        return RenderResult(request.time, (), State(), StageTimes(geometry=3.0, rendering=4.0))


class Eager(RenderJob):
    """A session that always requests a view."""

    viewer = encode = None
    is_cancelled = False

    def __init__(self, name, log, top_k=None, bad=False):
        self.name, self.log, self.top_k, self.bad = name, log, top_k, bad
        self.failures = []

    def next_request(self, now, playback):
        if self.bad:
            raise KeyError("mine")
        return RenderRequest(0, (CAMERA,), RenderQuality(top_k=self.top_k))

    def deliver(self, request, result):
        self.log.append(self.name)
        return FrameTimes(encode=2.0) + result.times

    def give_up(self):
        self.log.append(f"{self.name} gave up")

    def fail(self, message):
        self.failures.append(message)


@pytest.fixture
def service():
    return RenderService(FakeRenderer(), FakeSource())


def test_sessions_are_served_in_turn(service):
    log = []
    for name in "abc":
        service.join(Eager(name, log))
    for turn in range(9):
        if turn == 4:
            service.join(Eager("d", log))
        assert service.serve_next()
    assert max(Counter(log).values()) - min(Counter(log[4:]).values()) <= 2 and log[:3] == ["a", "b", "c"]


def test_a_failure_is_reported_to_its_session_only(service):
    log = []
    unlucky, odd = Eager("unlucky", log, top_k=13), Eager("odd", log, bad=True)
    for session in (odd, unlucky, Eager("a", log)):
        service.join(session)
    for _ in range(6):
        service.serve_next()
    assert log == ["a"] * 3 and unlucky.failures == ["RuntimeError: bad luck"] * 3 and len(odd.failures) >= 3
    assert service.counts == {"errors": 3, "frames": 3, "shared": 0, "cancelled": 0}
    assert (service.times.encode, service.times.rendering, service.times.total) == (6.0, 12.0, 27.0)


@pytest.mark.parametrize(("error", "is_shared"), [(RequestError, False), (ValueError, True)])
def test_an_error_of_one_request_is_not_the_services(service, monkeypatch, error, is_shared):
    def fail(request, viewer):
        raise error("mine")

    session = Eager("a", [])
    service.join(session)
    monkeypatch.setattr(service.renderer, "render", fail)
    assert service.serve_next() and session.failures == [f"{error.__name__}: mine"]
    assert (service.error is not None) is is_shared and service.counts["errors"] == 1


def test_a_frame_that_was_dropped_meanwhile_is_requested_again(service, monkeypatch):
    def fail(request, viewer):
        raise FrameNotReadyError

    log = []
    session = Eager("a", log)
    service.join(session)
    monkeypatch.setattr(service.renderer, "render", fail)
    assert service.serve_next() and log == ["a gave up"]
    assert not session.failures and service.error is None and service.counts["errors"] == 0


def test_a_cancelled_view_is_neither_delivered_nor_a_failure(service):
    log = []
    session = Eager("a", log)
    service.join(session)
    session.is_cancelled = True
    assert service.serve_next()
    session.is_cancelled = False
    assert service.serve_next()
    assert log == ["a gave up", "a"] and service.counts["cancelled"] == 1 and not session.failures
    assert service.error is None


def test_a_session_that_left_is_not_served(service):
    log = []
    session = Eager("a", log)
    service.join(session)
    service.leave(session)
    service.leave(session)
    assert not service.serve_next() and log == []
