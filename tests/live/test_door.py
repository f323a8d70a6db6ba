"""What strangers may cost: connections, messages, time."""

import contextlib
import logging
import socket
import struct
import time
from types import SimpleNamespace

import pytest
from live_servers import running, wait_until
from test_faults import exchange, still_serves

from viewmend.live import door
from viewmend.live.client import Client
from viewmend.live.pushed import PushedFrames

TOKEN = "a long secret indeed"
UPGRADE = "GET {path} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{more}\r\n"
KEYS = "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n"


def opened(server):
    return socket.create_connection(("127.0.0.1", int(server.url.rsplit(":", 1)[1])), timeout=10)


def frame(opcode, data=b"", fin=True, length=None):
    """A client's frame; `length` is what it announces."""
    length = len(data) if length is None else length
    head = bytes([opcode | (0x80 if fin else 0)])
    size = bytes([0x80 | length]) if length < 126 else b"\xff" + struct.pack(">Q", length)
    return head + size + b"\0\0\0\0" + data


def accepted(server, path="/ws"):
    raw = opened(server)
    raw.sendall(UPGRADE.format(path=path, more=KEYS).encode())
    answer = raw.recv(4096)
    assert answer.startswith(b"HTTP/1.1 101"), answer
    return raw


def ended(raw, seconds=10.0):
    """Whether the server ends the connection."""
    raw.settimeout(seconds)
    with contextlib.suppress(ConnectionResetError):
        while True:
            try:
                if not raw.recv(65536):
                    return True
            except TimeoutError:
                return False
    return True


@pytest.mark.parametrize(
    ("path", "more"),
    [
        ("/ws?" + "a" * 9000, KEYS),
        ("/ws", KEYS + "Cookie: " + "a" * 9000 + "\r\n"),
        ("/ws", KEYS + "".join(f"X-{n}: 1\r\n" for n in range(200))),
        ("/ws", KEYS.replace("13", "99")),
        ("/ws", ""),
        ("/ws", KEYS + "Content-Length: 10\r\n"),
        ("/nowhere", KEYS),
    ],
    ids=["long query", "long header", "many headers", "version", "no key", "body", "path"],
)
def test_an_upgrade_that_cannot_be_is_answered_and_closed(ball, path, more):
    began = time.monotonic()
    with opened(ball) as raw:
        raw.sendall(UPGRADE.format(path=path, more=more).encode())
        assert raw.recv(4096).startswith(b"HTTP/1.1 4")
        assert ended(raw) and time.monotonic() - began < 5
    wait_until(lambda: not any(isinstance(c, door.SocketDoor) for c in ball.server.server_state.connections))


def test_no_socket_is_accepted_without_the_token():
    with running(token=TOKEN) as server:
        for path in ("/ws", "/push", "/ws?token=wrong"):
            answer = exchange(server, UPGRADE.format(path=path, more=KEYS).encode())
            assert answer.startswith(b"HTTP/1.1 401"), answer
        assert still_serves(server)


def test_a_strangers_message_has_no_room():
    """While it waits for the answer to a wrong token, say."""
    with running(token=TOKEN) as server, opened(server) as raw:
        raw.sendall(UPGRADE.format(path="/ws?token=wrong", more=KEYS).encode() + frame(2, length=60_000_000))
        with contextlib.suppress(OSError):
            for _ in range(100):
                raw.sendall(b"x" * 100_000)
        assert ended(raw)


@pytest.mark.parametrize(("path", "most"), [("/ws", 4 * 16_384), ("/push", 1_000_000)])
def test_messages_are_bounded_by_their_route(path, most):
    with running(PushedFrames(), ready=False) as server:
        for length, ends in ((most, False), (most + 1, True)):
            with accepted(server, path) as raw:
                raw.sendall(frame(1, length=length))
                assert ended(raw, 1.0 if not ends else 10.0) == ends


def test_a_message_in_endless_pieces_ends_the_connection(ball):
    with accepted(ball) as raw:
        with contextlib.suppress(OSError):
            raw.sendall(frame(1, fin=False) + frame(0, fin=False) * (door.FRAGMENTS + 10))
        assert ended(raw)
    with accepted(ball) as raw:
        raw.sendall(frame(1, fin=False) + frame(0, fin=False) * (door.FRAGMENTS - 10))
        assert not ended(raw, 0.5)
    assert still_serves(ball)


def test_pings_whose_answers_nobody_reads_cost_nothing(ball):
    with accepted(ball) as raw:
        raw.setblocking(False)
        pings, sent = frame(9, b"x" * 125) * 500, 0
        end = time.monotonic() + 3
        while time.monotonic() < end:
            with contextlib.suppress(BlockingIOError):
                sent += raw.send(pings[sent % len(pings) :])
        sockets = [c for c in ball.server.server_state.connections if isinstance(c, door.SocketDoor)]
        assert sent > 8_000_000 and max(c.transport.get_write_buffer_size() for c in sockets) < 500_000
    assert still_serves(ball)


def test_answers_that_nobody_reads_are_given_up(monkeypatch):
    monkeypatch.setattr(door, "UNREAD_S", 1.0)
    with running(token=TOKEN) as server:
        with opened(server) as raw:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            raw.settimeout(0.2)
            with contextlib.suppress(OSError):
                while True:
                    raw.sendall(b"GET /page/main.js HTTP/1.1\r\nHost: localhost\r\n\r\n" * 100)
            assert len(server.server.server_state.connections) == 1
            wait_until(lambda: not server.server.server_state.connections, 10)
        assert still_serves(server)


@pytest.mark.parametrize(
    ("left", "reads"),
    [
        ([0] * 40, True),
        ([500_000] * 40, False),
        ([500_000 - 5_000 * second for second in range(40)], True),
        ([500_000 - 1_000 * second for second in range(40)], False),
        ([100_000 + 5_000 * second for second in range(40)], False),
        ([500_000] * 15 + [0] + [500_000] * 15, True),
    ],
)
def test_who_reads_slowly_is_waited_for(left, reads):
    visitor = door.Visitor()
    sizes = iter(left)
    visitor.transport = SimpleNamespace(get_write_buffer_size=lambda: next(sizes))
    assert all(visitor.reads(visitor.since + second) for second in range(len(left))) == reads


def test_who_is_gone_gets_no_refusal(caplog):
    """Its connection may have ended while the question waited for its turn: that is no fault of the application's."""

    async def refuse(_scope, _receive, send):
        for kind in ("start", "body"):
            await send({"type": f"websocket.http.response.{kind}", "status": 401, "headers": [], "body": b"no"})

    gone = door.SocketDoor.__new__(door.SocketDoor)  # of all else one would hear by an AttributeError
    gone.conn, gone.handshake_complete = SimpleNamespace(eof_sent=True), False
    gone.app, gone.scope, gone.close_timer, gone.logger = refuse, {}, object(), logging.getLogger("uvicorn.error")
    with pytest.raises(StopIteration):  # it is done at once
        gone.run_asgi().send(None)
    assert not caplog.records


def test_what_is_nearly_read_counts_as_read():
    visitor = door.Visitor()
    visitor.transport = SimpleNamespace(get_write_buffer_size=lambda: 50_000)
    assert visitor.reads(visitor.since + 19) and not visitor.reads(visitor.since + 21)
    visitor.drained()
    assert visitor.reads(time.monotonic() + 1)


def test_strangers_make_room_for_others(monkeypatch):
    monkeypatch.setattr(door, "STRANGERS", 20)
    with running(token=TOKEN) as server, contextlib.ExitStack() as stack, Client(server.ws, token=TOKEN) as viewer:
        crowd = [stack.enter_context(opened(server)) for _ in range(60)]
        wait_until(lambda: len(server.server.server_state.connections) <= 21)
        assert still_serves(server)
        assert viewer.frame(viewer.look(width=32, height=32, modes=["rendered"])).images, "who was let in stays"
        assert ended(crowd[0], 2.0)


def test_small_answers_leave_at_once(ball):
    with opened(ball) as raw:
        raw.sendall(b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert raw.recv(4096)
        connections = [c for c in ball.server.server_state.connections if isinstance(c, door.HttpDoor)]
        sockets = [c.transport.get_extra_info("socket") for c in connections]
        assert sockets and all(s.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) for s in sockets)


def test_the_server_stops_quickly_whoever_hangs_on(caplog):
    with running(token=TOKEN) as server, contextlib.ExitStack() as stack:
        for sent in (b"", b"GET / HT", UPGRADE.format(path="/ws?token=wrong", more=KEYS).encode()):
            stack.enter_context(opened(server)).sendall(sent)
        viewer = stack.enter_context(Client(server.ws, token=TOKEN))
        viewer.frame(viewer.look(width=32, height=32, modes=["rendered"]))
        began = time.monotonic()
        server.server.should_exit = True
        wait_until(lambda: not server.server.server_state.connections, 5)
        assert time.monotonic() - began < 5
    assert "Traceback" not in caplog.text
