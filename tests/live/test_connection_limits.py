"""Unauthenticated clients cannot take connections, memory or time from viewers."""

import asyncio
import contextlib
import gc
import socket
import struct
import threading
import weakref

import pytest
import uvicorn
from live.live_servers import FakeClock, close_code, exchange, in_own_loop, open_socket, running, wait_until
from uvicorn.server import ServerState

from viewmend.live import connection_limits as limits
from viewmend.live.auth import AccessControl
from viewmend.live.client import Client
from viewmend.live.connection_limits import ConnectionLimits, FairScheduler, LimitedConnection
from viewmend.live.push import PushSource

TOKEN = "a long secret indeed"
UPGRADE = "GET {path} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{more}\r\n"
KEYS = "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n"
WRONG = UPGRADE.format(path="/ws?token=wrong", more=KEYS).encode()
CHUNKED = b"POST /path.mp4 HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
GET = b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n"


def frame(opcode, data=b"", fin=True, length=None):
    """A client's WebSocket frame; `length` is what its header states."""
    length = len(data) if length is None else length
    head = bytes([opcode | (0x80 if fin else 0)])
    size = bytes([0x80 | length]) if length < 126 else b"\xff" + struct.pack(">Q", length)
    return head + size + b"\0\0\0\0" + data


def accepted(server, path="/ws"):
    raw = open_socket(server)
    raw.sendall(UPGRADE.format(path=path, more=KEYS).encode())
    answer = raw.recv(4096)
    assert answer.startswith(b"HTTP/1.1 101"), answer
    return raw


def read_to_end(raw):
    """Everything that the server sends before it closes the connection."""
    received = b""
    with contextlib.suppress(ConnectionResetError):
        while more := raw.recv(65536):
            received += more
    return received


def send_all(raw, data):
    """Send as much as the server takes."""
    with contextlib.suppress(OSError):
        raw.sendall(data)


class FakeTransport(asyncio.Transport):
    """A socket's transport that records what happens to it."""

    def __init__(self):
        super().__init__()
        self.unread, self.written, self.closed, self.reading = 0, b"", False, True

    def get_extra_info(self, name, default=None):
        return default

    def get_write_buffer_size(self):
        return self.unread

    def write(self, data):
        self.written += data

    def is_closing(self):
        return self.closed

    def close(self):
        self.closed = True

    abort = close

    def pause_reading(self):
        self.reading = False

    def resume_reading(self):
        self.reading = True


async def connect(all_limits, app=None):
    """A connection of a server with this application, without a socket."""
    config = uvicorn.Config(all_limits.wrap(app or answer), http=all_limits.connect, ws="websockets-sansio")
    config.load()
    connection = config.http_protocol_class(config=config, server_state=ServerState(), app_state={})
    assert isinstance(connection, LimitedConnection)
    transport = FakeTransport()
    connection.connection_made(transport)
    return connection, transport


async def answer(scope, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"."})


async def settle():
    """Let all callbacks run that are due."""
    for _ in range(20):
        await asyncio.sleep(0)


class Timers:
    """Timers of a fake clock."""

    def __init__(self, clock):
        self.clock, self.planned = clock, []
        self.limits = ConnectionLimits(clock)
        self.limits.scheduler = FairScheduler(clock, self.call_later)

    async def run(self):
        """Run all timers, and the callbacks that they cause."""
        while self.planned:
            self.run_next()
            await settle()

    def call_later(self, delay_s, callback):
        self.planned.append((self.clock() + delay_s, callback))

    def run_next(self):
        at_s, callback = self.planned.pop(0)
        self.clock.now_s = max(self.clock.now_s, at_s)
        callback()


def test_turns_are_taken_one_at_a_time_with_pauses_and_new_connections_first():
    clock, spent, taken = FakeClock(), FakeClock(), []
    timers = Timers(clock)
    scheduler = FairScheduler(clock, timers.call_later, spent)

    def turn(name, takes_s=0.0, elsewhere_s=0.0):
        def callback():
            taken.append((name, clock()))
            clock.advance(takes_s + elsewhere_s)
            spent.advance(takes_s)

        return callback

    withdrawn = turn("withdrawn")
    scheduler.submit(turn("slow", 0.03), True)
    timers.run_next()
    for name, first in (("later 1", False), ("later 2", False), ("new", True)):
        scheduler.submit(turn(name), first)
    scheduler.submit(withdrawn, False)
    for _ in range(2):
        scheduler.withdraw(withdrawn)
    while timers.planned:
        timers.run_next()
    assert [name for name, _ in taken] == ["slow", "new", "later 1", "later 2"]
    starts = [at_s for _, at_s in taken]
    pause_s = 0.03 * (1 + limits.PAUSE_FACTOR)
    assert starts[1] - starts[0] == pytest.approx(pause_s)
    assert starts[2] - starts[1] == starts[3] - starts[2] == pytest.approx(limits.MIN_PAUSE_S)
    clock.advance(1.0)
    for name in ("interrupted", "next"):
        scheduler.submit(turn(name, elsewhere_s=0.5), False)
    while timers.planned:
        timers.run_next()
    assert taken[-1][1] - taken[-2][1] == pytest.approx(0.5 + limits.MIN_PAUSE_S), (
        "other programs prolong no pause"
    )
    clock.advance(1.0)
    for callback in (lambda: 1 / 0, turn("alone")):
        scheduler.submit(callback, False)
    with pytest.raises(ZeroDivisionError):
        timers.run_next()
    timers.run_next()
    assert taken[-1][0] == "alone", "an error stops no other turn"


@in_own_loop
async def test_unauthenticated_input_is_handed_on_in_pieces_and_bounded():
    timers = Timers(FakeClock())
    connection, transport = await connect(timers.limits)
    head = b"GET / HTTP/1.1\r\nHost: x\r\nA: " + b"a" * 10_000 + b"\r\n\r\n"
    connection.data_received(head)
    assert not transport.reading and not transport.written
    await timers.run()
    assert transport.written.startswith(b"HTTP/1.1 200") and transport.reading
    connection.data_received(b"x" * limits.MAX_UNAUTHENTICATED_BYTES)
    assert transport.closed


@in_own_loop
async def test_a_turn_that_comes_after_the_client_was_authenticated_is_empty():
    timers = Timers(FakeClock())
    timers.limits.scheduler.submit(lambda: None, True)
    connection, transport = await connect(timers.limits)
    connection.data_received(GET)
    connection.authenticate(0)
    await settle()
    await timers.run()
    assert transport.written.count(b"HTTP/1.1 200") == 1
    connection.data_received(GET)
    await settle()
    assert transport.written.count(b"HTTP/1.1 200") == 2


@in_own_loop
async def test_a_request_is_answered_in_its_turn_and_dropped_if_its_client_has_gone():
    timers, answered = Timers(FakeClock()), []

    async def app(scope, receive, send):
        answered.append(scope["path"])
        await answer(scope, receive, send)

    connections = [await connect(timers.limits, app) for _ in range(3)]
    for (connection, _), path in zip(connections, (b"a", b"b", b"c"), strict=True):
        connection.data_received(b"GET /" + path + b" HTTP/1.1\r\nHost: x\r\n\r\n")
    gone, transport = connections[1]
    transport.close()
    gone.connection_lost(None)
    await timers.run()
    assert sorted(answered) == ["/a", "/c"] and gone not in timers.limits.connections
    assert [connection.requests for connection, _ in connections] == [0, 0, 0]


@in_own_loop
async def test_the_oldest_unauthenticated_connections_are_closed_when_there_are_too_many():
    all_limits = ConnectionLimits(clock := FakeClock())
    connections = []
    for _ in range(limits.MAX_UNAUTHENTICATED + 3):
        connections.append(await connect(all_limits))
        clock.advance(0.1)
        if len(connections) == 1:
            connections[0][0].authenticate(0)
    closed = [n for n, (_, transport) in enumerate(connections) if transport.closed]
    assert closed == [1, 2], "the first one is authenticated"


@in_own_loop
async def test_connections_without_a_request_are_closed():
    all_limits = ConnectionLimits(clock := FakeClock())
    silent, half, busy = [await connect(all_limits) for _ in range(3)]
    half[0].data_received(b"GET / HTTP/1.1\r\nHo")
    busy[0].requests = 1
    clock.advance(limits.IDLE_S - 1)
    all_limits.close_stalled()
    assert not any(transport.closed for _, transport in (silent, half, busy))
    clock.advance(2)
    all_limits.close_stalled()
    assert [transport.closed for _, transport in (silent, half, busy)] == [True, True, False]
    busy[0].requests, busy[0].idle_since_s = 0, clock()
    clock.advance(limits.IDLE_S - 1)
    all_limits.close_stalled()
    assert not busy[1].closed, "it has been answered recently"


@pytest.mark.parametrize(
    ("unread", "is_closed"),
    [
        ([0] * 40, False),
        ([500_000] * 40, True),
        ([500_000 - 5_000 * second for second in range(40)], False),
        ([500_000 - 1_000 * second for second in range(40)], True),
        ([100_000 + 5_000 * second for second in range(40)], True),
        ([500_000] * 15 + [0] + [500_000] * 15, False),
    ],
)
@in_own_loop
async def test_clients_that_read_slowly_are_closed_only_if_they_read_too_little(unread, is_closed):
    all_limits = ConnectionLimits(clock := FakeClock())
    connection, transport = await connect(all_limits)
    connection.requests = 1
    for transport.unread in unread:
        clock.advance(1)
        all_limits.close_stalled()
    assert transport.closed == is_closed


@in_own_loop
async def test_data_that_is_nearly_read_counts_as_read():
    all_limits = ConnectionLimits(clock := FakeClock())
    connection, transport = await connect(all_limits)
    transport.unread = 50_000
    assert not connection.track_reading(clock() + limits.UNREAD_S - 1)
    clock.advance(limits.UNREAD_S + 1)
    assert connection.track_reading(clock())
    connection.resume_writing()
    assert not connection.track_reading(clock() + 1)


@in_own_loop
async def test_input_waits_while_output_is_not_read():
    connection, transport = await connect(ConnectionLimits())
    connection.authenticate(0)
    connection.pause_writing()
    connection.data_received(GET)
    await settle()
    assert not transport.reading and not transport.written
    connection.resume_writing()
    await settle()
    assert transport.reading and transport.written.startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    ("path", "more"),
    [
        ("/ws?" + "a" * 9000, KEYS),
        ("/ws", KEYS + "".join(f"X-{n}: 1\r\n" for n in range(200))),
        ("/ws", KEYS.replace("13", "99")),
        ("/ws", ""),
        ("/ws", KEYS + "Content-Length: 10\r\n"),
        ("/nowhere", KEYS),
    ],
    ids=["long query", "many headers", "version", "no key", "body", "path"],
)
def test_an_impossible_upgrade_is_refused_and_closed(ball, path, more):
    with open_socket(ball) as raw:
        raw.sendall(UPGRADE.format(path=path, more=more).encode())
        received = read_to_end(raw)
        assert not received or received.startswith(b"HTTP/1.1 4")


def test_no_websocket_is_accepted_without_the_token(monkeypatch):
    monkeypatch.setattr(limits, "IDLE_S", 1.0)
    with running(token=TOKEN) as server:
        for path in ("/ws", "/push", "/ws?token=wrong"):
            answer = exchange(server, UPGRADE.format(path=path, more=KEYS).encode())
            assert answer.startswith(b"HTTP/1.1 401"), answer
        with open_socket(server) as raw:  # a large message before the answer
            raw.sendall(WRONG + frame(2, length=60_000_000))
            send_all(raw, b"x" * 10_000_000)
            read_to_end(raw)
        assert server.is_serving()


@pytest.mark.parametrize(("path", "size"), [("/ws", 4 * 16_384), ("/push", 1_000_000)])
def test_messages_are_bounded_by_their_route(path, size):
    with running(PushSource(), ready=False) as server:
        with accepted(server, path) as raw:
            raw.sendall(frame(1, b"x" * size))
            assert b"error" in raw.recv(4096), "it is read, and malformed"
        with accepted(server, path) as raw:
            send_all(raw, frame(1, b"x" * (size + 2 * limits.MESSAGE_SLACK_BYTES)))
            received = read_to_end(raw)
            assert b"error" not in received and received in (b"", limits.TOO_LARGE)


@pytest.mark.parametrize("opcode", [0, 9], ids=["fragments", "pings"])
def test_endless_frames_without_a_message_end_the_connection(ball, opcode):
    with accepted(ball) as raw:
        begin = frame(1, fin=False) if opcode == 0 else b""
        send_all(raw, begin + frame(opcode, b"x" * 100, fin=opcode == 9) * 10_000)
        read_to_end(raw)
    assert ball.is_serving()


def test_pongs_that_are_not_read_are_not_stored(ball):
    with accepted(ball) as raw:
        raw.setblocking(False)
        pings, sent = frame(9, b"x" * 125) * 500, 0
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while sent < 100_000_000:
                sent += raw.send(pings[sent % len(pings) :])
        assert max((c.get_write_buffer_size() for c in ball.connections), default=0) < 1_000_000
    assert ball.is_serving()


def test_a_crowd_of_unauthenticated_clients_leaves_room_for_a_viewer(monkeypatch):
    monkeypatch.setattr(limits, "MAX_UNAUTHENTICATED", 20)
    with (
        running(token=TOKEN) as server,
        contextlib.ExitStack() as stack,
        Client(server.ws, token=TOKEN) as viewer,
    ):
        crowd = [stack.enter_context(open_socket(server)) for _ in range(60)]
        wait_until(lambda: len(server.connections) <= 21)
        assert server.is_serving()
        assert viewer.frame(viewer.look(width=32, height=32, modes=["rendered"])).images
        read_to_end(crowd[0])


@pytest.mark.parametrize(
    ("first", "more"),
    [
        (WRONG, frame(1) * 30_000),
        (CHUNKED, b"1\r\nx\r\n" * 30_000),
        (CHUNKED.replace(b"mp4", b"mp4?token=wrong"), b"1\r\nx\r\n" * 30_000),
        (CHUNKED + b"0\r\n", b"a: b\r\n" * 30_000),
        (b"", GET.replace(b"health", b"page/nothing") * 3000),
    ],
    ids=["messages", "body", "body and token", "trailers", "requests"],
)
def test_a_flood_of_unauthenticated_input_does_not_stop_a_viewer(first, more, caplog):
    with (
        running(token=TOKEN) as server,
        Client(server.ws, token=TOKEN) as viewer,
        contextlib.ExitStack() as stack,
    ):
        crowd = [stack.enter_context(open_socket(server)) for _ in range(40)]
        for raw in crowd:
            raw.setblocking(False)
            send_all(raw, first)
        left = [memoryview(more)] * len(crowd)
        for number in range(6):
            for n, raw in enumerate(crowd):
                with contextlib.suppress(OSError):
                    left[n] = (left[n] or memoryview(more))[raw.send(left[n] or more) :]
                with contextlib.suppress(OSError):
                    raw.recv(65536)
            viewer.frame(
                viewer.look(width=32, height=32, camera={"azimuth": float(number)}, modes=["rendered"])
            )
    assert not caplog.records, "unauthenticated clients cause no log lines"


def test_a_body_that_goes_on_after_its_answer_does_not_disturb_others(monkeypatch):
    monkeypatch.setattr(limits, "IDLE_S", 1.0)
    with running(token=TOKEN) as server, open_socket(server) as raw:
        raw.sendall(CHUNKED + b"1\r\nx\r\n")
        assert raw.recv(4096).startswith(b"HTTP/1.1 401")
        send_all(raw, b"ZZ, which is no chunk")
        read_to_end(raw)
        assert server.is_serving()


@pytest.mark.parametrize("sent", [b"ZZ\r\n", b"5\r\nhelloZZ\r\n"])
def test_a_malformed_body_is_answered_once(ball, sent, caplog):
    with open_socket(ball) as raw:
        raw.sendall(CHUNKED + sent)
        received = read_to_end(raw)
    assert received.startswith(b"HTTP/1.1 400") and received.count(b"HTTP/1.1") == 1
    assert not caplog.records


def test_pieces_of_a_request_are_put_together():
    whole = (
        b"GET /health?token=a+long+secret+indeed HTTP/1.1\r\nHost: localhost\r\nX: "
        + b"x" * 12_000
        + b"\r\n\r\n"
    )
    with running(token=TOKEN) as server, open_socket(server) as raw:
        for part in (whole[:1], whole[1:9000], whole[9000:] + whole + whole):
            raw.sendall(part)
        received = b""
        while received.count(b"HTTP/1.1 200") < 3:
            more = raw.recv(65536)
            assert more, received
            received += more


def test_closed_connections_leave_nothing_behind():
    with running(token=TOKEN) as server:
        seen = weakref.WeakSet()
        for _ in range(30):
            with open_socket(server) as raw:
                wait_until(lambda: server.connections)
                seen.update(server.connections)
                raw.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 40_000)
        wait_until(lambda: not server.connections)
        assert not server.server.limits.scheduler._waiting
        wait_until(lambda: gc.collect() is not None and not seen)


def test_small_answers_leave_at_once(ball):
    with open_socket(ball) as raw:
        raw.sendall(GET)
        assert raw.recv(4096)
        sockets = [c.get_extra_info("socket") for c in ball.connections]
        assert sockets and all(s.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) for s in sockets)


def test_the_server_stops_while_clients_are_connected(caplog):
    """It frees the port, ends all threads, and closes viewers' connections with their code."""
    before = set(threading.enumerate())
    with running(token=TOKEN) as server, contextlib.ExitStack() as stack:
        for sent in (b"", b"GET / HT", WRONG):
            stack.enter_context(open_socket(server)).sendall(sent)
        viewer = stack.enter_context(Client(server.ws, token=TOKEN))
        viewer.frame(viewer.look(width=32, height=32, modes=["rendered"]))
        server.server.stop()
        wait_until(lambda: not server.connections)
        assert close_code(viewer._socket._socket) in (1012, None)
    with socket.socket() as again:
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", server.port))
    wait_until(lambda: set(threading.enumerate()) <= before)
    assert "Traceback" not in caplog.text


def test_a_handshake_that_the_stopping_server_has_ended_is_not_answered_again(monkeypatch, caplog):
    async def has_token_too_late(access, request):
        next(iter(server.connections))._uvicorn.shutdown()
        return False

    monkeypatch.setattr(AccessControl, "has_token", has_token_too_late)
    with running(token=TOKEN) as server, open_socket(server) as raw:
        raw.sendall(WRONG)
        assert read_to_end(raw).count(b"HTTP/1.1") == 1
    assert not caplog.records
