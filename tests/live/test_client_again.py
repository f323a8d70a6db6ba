"""A viewer in Python whose connection is lost comes back with its pose and its clock."""

import threading
import time

import pytest
from live_servers import running

from viewmend.live.client import Client, ConnectionLostError
from viewmend.live.protocol import Limits

POSE = {"azimuth": 77.0, "distance": 2.5}


def lose(server):
    """Every connection breaks, without a word."""
    loop = server.server.servers[0].get_loop()
    for connection in list(server.server.server_state.connections):
        loop.call_soon_threadsafe(connection.transport.abort)


def same_pose(one, other):
    return one.header["cameras"][0]["R"] == pytest.approx(other.header["cameras"][0]["R"], abs=1e-6)


def test_it_comes_back_with_its_pose_and_time(ball):
    with Client(ball.ws, again_s=10.0) as viewer:
        viewer.send("clock", playing=False, seek=2)
        look = viewer.look(camera=POSE, width=48, height=48)
        before = viewer.frame(look)
        while before.header["time"] != 2:
            before = viewer.frame()
        lose(ball)
        start = time.monotonic()
        after = viewer.frame()
        assert time.monotonic() - start < 3 and viewer.connections == 2
        assert after.header["look"] == look and same_pose(before, after)
        while viewer.messages.get("state", {}).get("time") != 2:
            viewer.wait_for("state")
        assert viewer.messages["state"]["playing"] is False


def test_a_place_that_was_sought_is_sought_again_until_it_is_shown(ball):
    with Client(ball.ws, again_s=10.0) as viewer:
        viewer.frame(viewer.look(camera=POSE, width=48, height=48))
        lose(ball)
        viewer.send("clock", playing=False, seek=2)
        while viewer.frame().header["time"] != 2:
            pass
        viewer.send("clock", live=True)
        assert viewer._clock == {}


def test_without_being_asked_to_it_says_that_the_connection_is_lost(ball):
    with Client(ball.ws) as viewer:
        viewer.frame(viewer.look(width=48, height=48))
        lose(ball)
        with pytest.raises(ConnectionLostError, match="closed the connection"):
            viewer.frame()
        assert viewer.connections == 1


def test_who_is_refused_does_not_insist():
    with running(limits=Limits(viewers=1)) as server, Client(server.ws):
        start = time.monotonic()
        with pytest.raises(ConnectionError, match="at most 1 viewers") as refused, Client(server.ws, again_s=30.0):
            pass
        assert not isinstance(refused.value, ConnectionLostError) and time.monotonic() - start < 5


def test_a_wrong_token_is_no_lost_connection():
    with running(token="a token, long enough") as server:
        with pytest.raises(ConnectionError, match=r"refuses \(401\)") as refused, Client(server.ws, "no", again_s=30.0):
            pass
        assert not isinstance(refused.value, ConnectionLostError)


def test_it_gives_up_in_time():
    with running() as server:
        viewer = Client(server.ws, again_s=0.5).__enter__()
        server.server.should_exit = True
        start = time.monotonic()
        with pytest.raises(ConnectionLostError):
            while True:
                viewer.frame()
        assert time.monotonic() - start < 10
        viewer.__exit__()


def test_it_waits_for_a_server_that_comes_later():
    with running() as first:
        port = int(first.url.rsplit(":", 1)[1])
        viewer = Client(first.ws, again_s=20.0).__enter__()
        before = viewer.frame(viewer.look(camera=POSE, width=48, height=48))
    later = threading.Event()

    def serve():
        time.sleep(0.5)
        with running(port=port):
            later.wait(20)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert same_pose(before, viewer.frame())
    finally:
        viewer.__exit__()
        later.set()
        thread.join()
