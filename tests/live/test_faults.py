"""Malformed messages, floods, slow clients and broken connections leave the server as it was."""

import asyncio
import contextlib
import http.client
import json
import random
import threading

import pytest
from live.live_servers import (
    FakeClock,
    close_code,
    get,
    open_socket,
    open_websocket,
    running,
    say_hello,
    wait_until,
)
from websockets.exceptions import ConnectionClosed

from viewmend.live import connection, connection_limits
from viewmend.live.client import Client
from viewmend.live.protocol import Limits
from viewmend.live.sessions import ViewerSession


def malformed(chance: random.Random):
    """One malformed message: random data, part of a message, or a message with an invalid value."""
    whole = json.dumps(
        {"type": "look", "id": 1, "camera": {"azimuth": 3, "target": [1, 2, 3]}, "modes": ["completed"]}
    )
    wrong = chance.choice([None, -1, 1e30, "x", [], {}, True, [[1]], {"a": {}}, 0.5])
    key = chance.choice(
        ["type", "width", "camera", "modes", "eyes", "scale", "moving", "quality", "id", "codec"]
    )
    return chance.choice(
        [
            chance.randbytes(chance.randrange(60)),
            "".join(chr(chance.randrange(32, 0x2FF)) for _ in range(chance.randrange(60))),
            whole[: chance.randrange(len(whole))],
            json.dumps({"type": "look", key: wrong}),
            json.dumps(
                {"type": chance.choice(["ack", "clock", "ping", "hello"]), "frame": wrong, "seek": wrong}
            ),
            "[" * chance.randrange(2000),
        ]
    )


def test_thousands_of_malformed_messages_change_nothing(monkeypatch):
    monkeypatch.setattr(connection, "REJECTED_PER_S", 1e9)
    monkeypatch.setattr(connection, "REJECTED_AT_ONCE", 1e9)
    chance = random.Random(0)
    with running(limits=Limits(messages_per_s=100_000)) as server:
        with open_websocket(server) as bad:
            say_hello(bad)
            threading.Thread(target=close_code, args=(bad,), daemon=True).start()
            for _ in range(2000):
                bad.send(malformed(chance))
            assert server.is_serving()
        wait_until(lambda: not server.live.registry.sessions)
        assert server.is_serving() and get(f"{server.url}/health")[0] == 200


def test_clients_that_break_the_protocol_are_disconnected(ball):
    with open_websocket(ball) as bad:
        say_hello(bad)
        for _ in range(20):
            bad.send("nonsense")
        assert close_code(bad) == 4400
    for first, code in (('{"type": "look"}', 4400), ('{"type": "hello", "version": 99}', 4426)):
        with open_websocket(ball) as bad:
            bad.send(first)
            assert close_code(bad) == code
    with open_websocket(ball) as huge:
        say_hello(huge)
        with contextlib.suppress(ConnectionClosed):
            huge.send("x" * 2_000_000)
        # None: unread input can make the system drop the connection before the close code is read.
        assert close_code(huge) in (1009, None)
    assert ball.is_serving()


@pytest.mark.parametrize("error", [RuntimeError("dictionary changed size"), KeyError("a field")])
def test_a_fault_of_the_server_is_logged_and_ends_the_connection(ball, monkeypatch, caplog, error):
    """Any exception is: torch, too, raises RuntimeErrors, which do not mean that the client has gone."""

    def fail(*_):
        raise error

    with open_websocket(ball) as unlucky:
        say_hello(unlucky)
        monkeypatch.setattr(ViewerSession, "look", fail)
        unlucky.send('{"type": "look", "id": 1}')
        close_code(unlucky)
    wait_until(lambda: type(error).__name__ in caplog.text)
    monkeypatch.undo()
    assert ball.is_serving()


def test_a_fault_in_the_first_messages_ends_both_tasks_of_the_connection(ball, monkeypatch):
    faulty = []

    def fail(self, _):
        faulty.append((self, asyncio.get_running_loop()))
        raise KeyError("a field")

    monkeypatch.setattr(connection.ViewerConnection, "send_due", fail)
    with open_websocket(ball) as unlucky:
        say_hello(unlucky)
        close_code(unlucky)
    monkeypatch.undo()
    ((_, loop),) = faulty  # the connection is kept, so that its tasks are not removed as garbage

    def unfinished():
        names = {task.get_coro().__qualname__ for task in asyncio.all_tasks(loop)}
        return names & {"ViewerConnection._read", "ViewerConnection._write"}

    wait_until(lambda: not unfinished(), seconds=20)
    assert ball.is_serving()


def test_a_flood_of_messages_is_slowed_down_and_ended():
    def flood(websocket):
        with contextlib.suppress(ConnectionClosed, OSError):
            for number in range(100_000):
                websocket.send(json.dumps({"type": "look", "id": number}))

    with running(limits=Limits(messages_per_s=20)) as server, open_websocket(server) as flooding:
        say_hello(flooding)
        threading.Thread(target=flood, args=(flooding,), daemon=True).start()
        assert server.is_serving()
        assert close_code(flooding) == 4429


def test_a_client_that_acknowledges_nothing_gets_one_frame_and_is_disconnected():
    clock = FakeClock()
    with running(now=clock) as server, open_websocket(server) as slow:
        say_hello(slow)
        slow.send(json.dumps({"type": "look", "width": 64, "height": 64}))
        (session,) = server.live.registry.sessions
        wait_until(lambda: session.in_flight is not None)
        first = session.in_flight
        assert server.is_serving()
        assert session.in_flight == first, "a second frame was sent"
        clock.advance(connection.ACK_S + 1)
        assert close_code(slow) == 4408
        wait_until(lambda: not server.live.registry.sessions)


def test_silent_connections_are_closed(monkeypatch):
    monkeypatch.setattr(connection, "HELLO_S", 0.5)
    monkeypatch.setattr(connection_limits, "IDLE_S", 1.0)
    posted = b"POST /path.mp4 HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n{"
    with running(token="a long secret indeed") as server, contextlib.ExitStack() as stack:
        silent = [stack.enter_context(open_socket(server)) for _ in range(3)]
        silent[1].sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\nGET /health HTTP/1.1\r\nHost: local")
        silent[2].sendall(posted)
        with open_websocket(server, "/ws?token=a+long+secret+indeed") as websocket:
            assert close_code(websocket) == 4408
        for raw in silent:
            while raw.recv(65536):
                pass
        monkeypatch.undo()  # who speaks may take its time on a busy machine
        asked = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        for _ in range(5):
            asked.request("GET", "/health?token=a+long+secret+indeed")
            assert asked.getresponse().read()
        asked.close()
        assert server.is_serving()


def test_viewers_that_disconnect_in_the_middle_of_a_frame_leave_nothing():
    with running() as server:
        for number in range(12):
            viewer = Client(server.ws).__enter__()
            rendered = server.service.counts["frames"]
            viewer.look(width=64, height=64, camera={"azimuth": float(number)})
            if number % 2:  # after the frame was rendered, or at any time before
                wait_until(lambda rendered=rendered: server.service.counts["frames"] > rendered)
            viewer._socket._socket.socket.close()
        wait_until(lambda: not server.live.registry.sessions and not server.service._sessions)
        assert server.is_serving()


def test_a_port_in_use_is_an_error():
    with (
        running(ready=False) as server,
        pytest.raises(OSError, match=f"port {server.port} of 127.0.0.1"),
        running(port=server.port),
    ):
        pass
