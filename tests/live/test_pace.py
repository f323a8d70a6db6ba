"""Several viewers who ask for the largest pictures wait seconds, not minutes."""

import threading
import time
from math import sqrt

import pytest
import torch
from live_servers import running
from reference.ball import ring

from viewmend.live.budget import FULL, QualityLevel
from viewmend.live.client import Client
from viewmend.live.clock import Span
from viewmend.live.pace import ALONE_S, LONGEST_S, Pace
from viewmend.live.poses import rig_frame
from viewmend.live.protocol import Limits, Look
from viewmend.live.sessions import Playback, ViewerSession

LARGEST = Limits().max_pixels
MOVING = QualityLevel(1.0, 0, 256)


def paced(seconds_of_the_largest, level=MOVING):
    pace = Pace()
    pace.record(LARGEST, level, seconds_of_the_largest)
    return pace


@pytest.mark.parametrize("seconds", [0.3, 1.0, 6.0])
def test_eight_who_wait_are_served_within_seconds(seconds):
    for level in (MOVING, QualityLevel(0.5, 0, 256)):
        drawn = paced(seconds).bounded(level, LARGEST, 8)
        took = 8 * seconds * drawn.scale**2
        assert took <= LONGEST_S * 1.001
        assert drawn == level or took == pytest.approx(LONGEST_S), "no smaller than it must be"
        assert (drawn.context_times, drawn.top_k) == (level.context_times, level.top_k)


def test_one_viewer_and_quick_pictures_are_as_large_as_they_like():
    assert paced(60.0).bounded(FULL, LARGEST, 1) == FULL
    assert paced(0.01).bounded(MOVING, LARGEST, 8) == MOVING
    assert Pace().bounded(FULL, 320 * 320, 4) == FULL, "of a machine that nothing is known of"
    assert Pace().bounded(MOVING, LARGEST, 8).scale < 1


def test_who_looks_on_may_ask_next():
    alone = paced(3.0).bounded(MOVING, LARGEST, 1, company=True)
    assert 3.0 * alone.scale**2 == pytest.approx(ALONE_S)
    assert paced(0.9).bounded(MOVING, LARGEST, 1, company=True) == MOVING


def test_what_costs_more_is_smaller_and_the_slowest_of_late_counts():
    pace = paced(1.0)
    assert pace.bounded(FULL, LARGEST, 8).scale < pace.bounded(MOVING, LARGEST, 8).scale < 1
    pace.record(100, MOVING, 50.0)
    assert pace.bounded(MOVING, LARGEST, 8) == paced(1.0).bounded(MOVING, LARGEST, 8), "small ones say nothing"
    for _ in range(16):
        pace.record(LARGEST, MOVING, 0.1)
    assert pace.bounded(MOVING, LARGEST, 8) == MOVING


@pytest.mark.parametrize(("waiting", "side"), [(1, 1448), (8, round(1448 * sqrt(LONGEST_S / (8 * 2.0))))])
def test_a_session_draws_what_all_have_time_for(waiting, side):
    session = ViewerSession(lambda message: None, lambda message: None, None)
    session.look(Look(width=1448, height=1448, adaptive=False))
    frame, pace = rig_frame(ring(4), torch.zeros(3), None), paced(2.0, FULL)
    request = session.next_request(1000.0, Playback(Span(0, 20, 20, 10.0), 0.0, frame, lambda at: True, waiting, pace))
    assert request is not None and request.cameras[0].size_px[0].tolist() == pytest.approx([side, side], abs=1)


def test_eight_viewers_at_their_limits_wait_for_seconds(monkeypatch):
    """Of a machine that takes three seconds for the largest picture: 24 s for eight."""
    waits = []

    def look(url):
        with Client(url, timeout_s=60.0) as viewer:
            barrier.wait(60.0)
            for azimuth in (0.0, 90.0):
                began = time.monotonic()
                viewer.frame(viewer.look(camera={"azimuth": azimuth}, width=1448, height=1448, adaptive=False))
                waits.append(time.monotonic() - began)

    with running(limits=Limits(viewers=8)) as server:
        render = server.service.renderer.render

        def slowly(request, viewer):
            time.sleep(3.0 * sum(int(camera.size_px.prod()) for camera in request.cameras) / LARGEST)
            return render(request, viewer)

        monkeypatch.setattr(server.service.renderer, "render", slowly)
        barrier = threading.Barrier(8)
        threads = [threading.Thread(target=look, args=(server.ws,)) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(waits) == 16 and max(waits) < 15, sorted(waits)


def test_who_waits_for_a_picture_is_counted():
    session = ViewerSession(lambda message: None, lambda message: None, None)
    assert not session.is_active(1000.0)
    session.look(Look())
    assert session.is_active(1000.0)
    session.in_flight = 3
    assert not session.is_active(1000.0), "it has one that it has not read"
