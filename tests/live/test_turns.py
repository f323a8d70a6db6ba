"""Strangers are heard one after the other, and what they send after that costs nothing."""

import asyncio
import contextlib
import gc
import json
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from live_servers import running, wait_until
from test_door import KEYS, TOKEN, UPGRADE, frame, opened
from test_faults import exchange, still_serves

from viewmend.live import server as live_server
from viewmend.live import turns
from viewmend.live.client import Client
from viewmend.live.door import HttpDoor, SocketDoor
from viewmend.live.protocol import Limits, ProtocolError, read_message
from viewmend.live.render_jobs import parse_path
from viewmend.live.turns import Turns

WRONG = UPGRADE.format(path="/ws?token=wrong", more=KEYS).encode()
CHUNKED = b"POST /path.mp4 HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"


def test_turns_are_given_one_after_the_other_and_newcomers_first(monkeypatch):
    monkeypatch.setattr(turns, "PAUSE_S", 0.02)
    given = []

    async def ask():
        gate = Turns()
        gate.ask(lambda: (given.append((0, time.monotonic())), time.sleep(0.03)), True)
        for number, first in ((1, False), (2, False), (3, True)):
            gate.ask(lambda number=number: given.append((number, time.monotonic())), first)
        gone = [lambda number=number: given.append((number, time.monotonic())) for number in (5, 6)]
        for turn in gone:
            gate.ask(turn, False)
        for turn in (*gone, gone[0]):
            gate.withdraw(turn)
        with pytest.raises(ZeroDivisionError):
            Turns().ask(lambda: 1 / 0, True)
        await asyncio.sleep(0.5)
        gate.ask(lambda: given.append((4, time.monotonic())), False)

    with ThreadPoolExecutor(1) as own:  # a browser's tests leave a loop running in this one
        own.submit(asyncio.run, ask()).result()
    assert [number for number, _ in given] == [0, 3, 1, 2, 4]
    at = [when for _, when in given]
    assert at[1] - at[0] > 0.03 + 4 * 0.03 - 0.001 and at[2] - at[1] > 0.019 and at[3] - at[2] > 0.019


def test_who_is_gone_waits_for_no_turn_and_leaves_nothing(monkeypatch):
    monkeypatch.setattr(turns, "PAUSE_S", 1.0)
    doors, came, made = weakref.WeakSet(), [], HttpDoor.connection_made

    def noted(door, transport):
        doors.add(door)
        came.append(time.monotonic())
        made(door, transport)

    monkeypatch.setattr(HttpDoor, "connection_made", noted)
    with running(token=TOKEN) as server:
        assert still_serves(server)
        for _ in range(30):
            with opened(server) as raw:
                raw.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 40_000)
        state = server.server.server_state
        wait_until(lambda: len(came) > 30 and not state.connections)
        assert not state.turns._waiting, "they would have had half a minute of turns"
        wait_until(lambda: gc.collect() is not None and not doors, seconds=60)  # a whole run has millions of objects


@pytest.mark.parametrize(
    ("first", "more"),
    [
        (WRONG, frame(1) * 30_000),
        (WRONG, frame(9) * 30_000),
        (CHUNKED, b"1\r\nx\r\n" * 30_000),
        (CHUNKED.replace(b"mp4", b"mp4?token=wrong"), b"1\r\nx\r\n" * 30_000),
        (b"", b"GET /page/nothing HTTP/1.1\r\nHost: localhost\r\n\r\n" * 300),
    ],
    ids=["messages", "pings", "body", "body and token", "requests"],
)
def test_a_crowd_of_strangers_keeps_nobody_waiting(first, more, caplog):
    with running(token=TOKEN) as server, Client(server.ws, token=TOKEN) as viewer, contextlib.ExitStack() as stack:
        assert still_serves(server)
        crowd = [stack.enter_context(opened(server)) for _ in range(40)]
        for raw in crowd:
            raw.settimeout(1)
            raw.sendall(first)
            raw.setblocking(False)
        slowest, left = 0.0, [memoryview(more)] * len(crowd)
        for number in range(12):
            for n, raw in enumerate(crowd):
                with contextlib.suppress(OSError):
                    left[n] = (left[n] or memoryview(more))[raw.send(left[n] or more) :]
                with contextlib.suppress(OSError):
                    raw.recv(65536)
            began = time.monotonic()
            viewer.frame(viewer.look(width=32, height=32, camera={"azimuth": float(number)}, modes=["rendered"]))
            slowest = max(slowest, time.monotonic() - began)
        assert slowest < 5.0
        sockets = [c for c in list(server.server.server_state.connections) if isinstance(c, SocketDoor)]
        kept = {message["type"] for c in sockets if not c.admitted for message in list(c.queue._queue)}
        assert kept <= {"websocket.connect", "websocket.disconnect"}, "what strangers send after their question"
    assert not caplog.records


def test_a_request_that_goes_on_after_its_answer_is_not_looked_at():
    with running(token=TOKEN) as server, opened(server) as raw:
        raw.sendall(CHUNKED + b"1\r\nx\r\n")
        assert raw.recv(4096).startswith(b"HTTP/1.1 401")
        while raw.recv(4096):  # the end: no other request can follow
            pass
        raw.sendall(b"ZZ, which is no chunk")
        raw.settimeout(0.5)
        assert raw.recv(4096) == b"" and still_serves(server)


def test_who_goes_before_its_early_answer_ends_is_let_go_of(monkeypatch, caplog):
    def gone(transport):
        raise OSError(107, "Transport endpoint is not connected")

    with running(token=TOKEN) as server, opened(server) as raw:
        monkeypatch.setattr("asyncio.selector_events._SelectorSocketTransport.write_eof", gone)
        raw.sendall(CHUNKED + b"1\r\nx\r\n")
        wait_until(lambda: not server.server.server_state.connections)
        assert still_serves(server)
    assert not caplog.records


@pytest.mark.parametrize("sent", [b"ZZ\r\n", b"5\r\nhelloZZ\r\n"])
def test_a_body_that_is_none_is_answered_once(sent, caplog):
    with running() as server:
        answer = exchange(server, CHUNKED + sent)
        assert answer.startswith(b"HTTP/1.1 400") and answer.count(b"HTTP/1.1") == 1
        wait_until(lambda: not server.server.server_state.connections)
    assert not caplog.records


def test_pieces_of_a_strangers_request_are_put_together():
    whole = b"GET /health?token=a+long+secret+indeed HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 12_000 + b"\r\n\r\n"
    with running(token=TOKEN) as server, opened(server) as raw:
        for part in (whole[:1], whole[1:9000], whole[9000:] + whole + whole):
            raw.sendall(part)
            time.sleep(0.05)
        got = b""
        while got.count(b"HTTP/1.1 200") < 3:
            more = raw.recv(65536)
            assert more, got
            got += more


def test_an_aborted_export_leaves_no_threads():
    pytest.importorskip("av")
    tasks = Path("/proc/self/task")
    if not tasks.exists():
        pytest.skip("threads are counted by /proc")
    body = json.dumps({"poses": [{"azimuth": n} for n in range(900)], "width": 320, "height": 320}).encode()
    head = f"POST /path.mp4 HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n".encode()
    with running() as server:
        assert still_serves(server)
        threads = []
        for _ in range(6):
            with opened(server) as raw:
                raw.sendall(head + body)
                begun = server.service.counts["frames"]
                wait_until(lambda begun=begun: server.service.counts["frames"] > begun + 3)
            wait_until(lambda: not server.live._exporting and not server.service._sessions)
            assert still_serves(server)
            threads.append(len(list(tasks.iterdir())))
        assert threads[-1] - threads[0] < 5, "a pool may grow by a worker or two, but not by one an export"


@pytest.mark.parametrize("body", [b'{"poses": [' + b"[[]]," * 190_000 + b"0]}", b"[" * 900_000])
def test_a_megabyte_of_lists_is_refused_before_it_is_read(body):
    with pytest.raises(ProtocolError, match="at most 10000 lists and objects"):
        parse_path(body, Limits())
    with pytest.raises(ProtocolError, match="at most 10000 lists and objects"):
        read_message(body.decode(), dict)


def test_a_body_is_parsed_off_the_event_loop(monkeypatch):
    pytest.importorskip("av")
    threads = []

    def parse(*_):
        threads.append(threading.current_thread().name)
        raise ProtocolError("seen")

    monkeypatch.setattr(live_server, "parse_path", parse)
    with running() as server:
        assert exchange(server, CHUNKED + b"1\r\nx\r\n0\r\n\r\n").startswith(b"HTTP/1.1 400")
    assert threads[0].startswith("asyncio_")
