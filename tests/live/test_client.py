"""The Python client: it reconnects with its view and its clock, and keeps within the server's rate limit."""

import threading
from itertools import pairwise
from types import SimpleNamespace

import pytest
from live.live_servers import FakeClock, running, wait_until

from viewmend.live import client as client_module
from viewmend.live.client import Client, ConnectionLostError
from viewmend.live.protocol import Limits

POSE = {"azimuth": 77.0, "distance": 2.5}


def break_connections(server):
    """Break every connection without a close frame."""
    for connection in list(server.connections):
        connection.get_extra_info("socket").shutdown(2)


def same_pose(one, other):
    return one.header["cameras"][0]["R"] == pytest.approx(other.header["cameras"][0]["R"], abs=1e-6)


def test_it_reconnects_with_its_view_and_frame(ball):
    with Client(ball.ws, reconnect_s=60.0) as viewer:
        viewer.send("clock", playing=False, seek=2)
        look = viewer.look(camera=POSE, width=48, height=48)
        before = viewer.frame(look)
        while before.header["time"] != 2:
            before = viewer.frame()
        break_connections(ball)
        after = viewer.frame()
        assert viewer.connections == 2 and after.header["look"] == look and same_pose(before, after)
        while (state := viewer.messages["state"])["time"] != 2 or state["playing"]:
            viewer.wait_for("state")


def test_a_seek_is_repeated_until_its_frame_is_shown(ball):
    with Client(ball.ws, reconnect_s=60.0) as viewer:
        viewer.frame(viewer.look(camera=POSE, width=48, height=48))
        break_connections(ball)
        viewer.send("clock", playing=False, seek=2)
        while viewer.frame().header["time"] != 2:
            pass
        viewer.send("clock", live=True)
        assert viewer._clock == {}


def test_without_reconnecting_a_lost_connection_is_an_error(ball):
    with Client(ball.ws) as viewer:
        viewer.frame(viewer.look(width=48, height=48))
        break_connections(ball)
        with pytest.raises(ConnectionLostError, match="closed the connection"):
            viewer.frame()
        assert viewer.connections == 1


def test_a_refusal_is_not_a_lost_connection(ball):
    with running(limits=Limits(viewers=1), token="a token, long enough", ready=False) as server:
        for token, reason in (("no", r"refuses \(401\)"), ("a token, long enough", "at most 1 viewers")):
            with (
                Client(server.ws, "a token, long enough"),
                pytest.raises(ConnectionError, match=reason) as refused,
            ):
                Client(server.ws, token, reconnect_s=60.0).__enter__()
            assert not isinstance(refused.value, ConnectionLostError)
            wait_until(lambda: not server.live.registry.sessions)


def test_it_gives_up_when_no_server_comes_back():
    with running(ready=False) as server:
        viewer = Client(server.ws, reconnect_s=0.2).__enter__()
    with pytest.raises(ConnectionLostError):
        while True:
            viewer.frame()
    viewer.close()


def test_it_waits_for_a_server_that_comes_back(monkeypatch):
    with running() as first:
        viewer = Client(first.ws, reconnect_s=60.0).__enter__()
        before = viewer.frame(viewer.look(camera=POSE, width=48, height=48))
    attempts, has_failed, is_done = [], threading.Event(), threading.Event()
    connect = client_module.ServerSocket

    def count(*given):
        attempts.append(given)
        if len(attempts) == 3:
            has_failed.set()
        return connect(*given)

    monkeypatch.setattr(client_module, "ServerSocket", count)

    def serve():
        has_failed.wait()
        with running(port=first.port):
            is_done.wait()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        after = viewer.frame()
        while len(attempts) < 3:  # it was the first server's, and still on its way
            after = viewer.frame()
        assert same_pose(before, after)
    finally:
        viewer.close()
        has_failed.set()
        is_done.set()
        thread.join()


def test_it_sends_no_faster_than_the_server_accepts(monkeypatch):
    clock, sent_at = FakeClock(), []

    class FakeSocket:
        def __init__(self, url, token):
            pass

        def send(self, message):
            sent_at.append(clock())

        def receive(self, timeout_s):
            return {"type": "welcome", "limits": {"messages_per_s": 100}}

    monkeypatch.setattr(client_module, "ServerSocket", FakeSocket)
    fake_time = SimpleNamespace(monotonic=clock, sleep=clock.advance, perf_counter=clock)
    monkeypatch.setattr(client_module, "time", fake_time)
    viewer = Client().__enter__()
    began, rate = clock(), 0.9 * 100
    for _ in range(500):
        viewer.send("ping")
    assert all(later - earlier <= 1 / rate + 1e-6 for earlier, later in pairwise(sent_at))
    assert clock() - began == pytest.approx(500 / rate, abs=1.01), "with bursts of at most a second"
