"""What strangers, broken networks and floods do to a server: nothing."""

import contextlib
import http.client
import json
import random
import socket
import threading
import time

import pytest
from live_servers import running, wait_until
from starlette.requests import HTTPConnection
from test_server import get
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from viewmend.live import connection, listener
from viewmend.live.client import Client
from viewmend.live.guard import FaultLimit, Guard, RateLimit
from viewmend.live.protocol import Limits

SOON = {"max_size": None, "compression": None}
CALM = Limits(messages_per_s=100_000)


def greet(socket_):
    socket_.send(json.dumps({"type": "hello", "version": 1, "codecs": []}))
    return json.loads(socket_.recv(timeout=10))


def closing(socket_):
    """The code that the server closes with, all else being read away."""
    with contextlib.suppress(TimeoutError):
        while True:
            try:
                socket_.recv(timeout=10)
            except ConnectionClosed as closed:
                return closed.rcvd.code if closed.rcvd else None
    return "open"


def still_serves(server):
    with Client(server.ws, token=server.live._config.token) as viewer:
        return bool(viewer.frame(viewer.look(width=32, height=32, modes=["rendered"])).images)


def malformed(chance: random.Random):
    """One malformed message: garbage, half a message, or one with a wrong value."""
    whole = json.dumps({"type": "look", "id": 1, "camera": {"azimuth": 3, "target": [1, 2, 3]}, "modes": ["mended"]})
    wrong = chance.choice([None, -1, 1e30, "x", [], {}, True, [[1]], {"a": {}}, 0.5])
    key = chance.choice(["type", "width", "camera", "modes", "eyes", "scale", "moving", "quality", "id", "codec"])
    return chance.choice(
        [
            chance.randbytes(chance.randrange(60)),
            "".join(chr(chance.randrange(32, 0x2FF)) for _ in range(chance.randrange(60))),
            whole[: chance.randrange(len(whole))],
            json.dumps({"type": "look", key: wrong}),
            json.dumps({"type": chance.choice(["ack", "clock", "ping", "hello"]), "frame": wrong, "seek": wrong}),
            "[" * chance.randrange(2000),
        ]
    )


def test_thousands_of_malformed_messages_change_nothing(monkeypatch):
    monkeypatch.setattr(connection.FaultLimit, "exceeded", lambda self: False)
    chance = random.Random(0)
    with running(limits=CALM) as server:
        with connect(f"{server.ws}/ws", **SOON) as bad:
            greet(bad)
            reader = threading.Thread(target=closing, args=(bad,), daemon=True)
            reader.start()
            for _ in range(4000):
                bad.send(malformed(chance))
            assert still_serves(server)
        wait_until(lambda: not server.live.registry.sessions)
        assert still_serves(server) and get(f"{server.url}/health")[0] == 200


def test_who_only_talks_nonsense_is_shown_out(ball):
    with connect(f"{ball.ws}/ws", **SOON) as bad:
        greet(bad)
        for _ in range(20):
            bad.send("nonsense")
        assert closing(bad) == 4400
    with connect(f"{ball.ws}/ws", **SOON) as bad:
        bad.send('{"type": "look"}')
        assert closing(bad) == 4400
    with connect(f"{ball.ws}/ws", **SOON) as old:
        old.send('{"type": "hello", "version": 99}')
        assert closing(old) == 4426
    with connect(f"{ball.ws}/ws", **SOON) as huge:
        greet(huge)
        with contextlib.suppress(ConnectionClosed):
            huge.send("x" * 1_000_000)
        # None: unread bytes can make the system drop the connection before its last words are read.
        assert closing(huge) in (1009, None)
    assert still_serves(ball)


def test_a_flood_is_dammed_and_others_are_served():
    with running(limits=Limits(messages_per_s=20)) as server, connect(f"{server.ws}/ws", **SOON) as flood:
        greet(flood)
        threading.Thread(target=_flood, args=(flood,), daemon=True).start()
        assert still_serves(server)
        assert closing(flood) == 4429


def _flood(socket_):
    with contextlib.suppress(ConnectionClosed, OSError):
        for number in range(100_000):
            socket_.send(json.dumps({"type": "look", "id": number}))


def test_who_reads_nothing_gets_nothing_more_and_is_shown_out(monkeypatch):
    monkeypatch.setattr(connection, "ACK_S", 1.0)
    with running() as server, connect(f"{server.ws}/ws", **SOON) as slow:
        greet(slow)
        slow.send(json.dumps({"type": "look", "width": 64, "height": 64}))
        wait_until(lambda: server.live.registry.sessions[0].in_flight is not None)
        first = server.live.registry.sessions[0].in_flight
        assert still_serves(server)
        assert server.live.registry.sessions[0].in_flight == first, "a second frame was sent"
        wait_until(lambda: not server.live.registry.sessions)
        assert closing(slow) == 4408


def test_silence_before_hello_and_half_open_sockets_end(monkeypatch):
    monkeypatch.setattr(connection, "HELLO_S", 0.5)
    monkeypatch.setattr(listener, "SILENT_S", 0.5)
    with running() as server:
        port = int(server.url.rsplit(":", 1)[1])
        mute = [socket.create_connection(("127.0.0.1", port)) for _ in range(3)]
        mute[1].sendall(b"GET /health HTTP/1.1\r\nHost: local")
        with connect(f"{server.ws}/ws", **SOON) as silent:
            assert closing(silent) == 4408
        assert still_serves(server)
        for half in mute:
            half.settimeout(10)
            assert b"200" not in half.recv(100)
            half.close()


def test_disconnects_in_the_middle_of_a_frame():
    with running() as server:
        for number in range(12):
            viewer = Client(server.ws).__enter__()
            viewer.look(width=64, height=64, camera={"azimuth": float(number)})
            time.sleep(0.003 * number)
            viewer._socket._socket.socket.close()
        wait_until(lambda: not server.live.registry.sessions, 20)
        assert still_serves(server)
        wait_until(lambda: not server.service._sessions)


def test_requests_that_never_end_are_cut_off(monkeypatch):
    monkeypatch.setattr(listener, "SILENT_S", 1.5)
    with running(token="a long secret indeed") as server:
        port = int(server.url.rsplit(":", 1)[1])
        whole = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
        posted = b"POST /path.mp4 HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\n{"
        for sent in (whole + b"GET / HTTP/1.1\r\nHost: loc", posted):
            with socket.create_connection(("127.0.0.1", port), timeout=10) as half:
                half.sendall(sent)
                while half.recv(65536):
                    pass
        asked = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        asked.connect()
        kept_open = asked.sock
        for _ in range(8):  # for longer than SILENT_S, on one connection
            time.sleep(0.3)
            asked.request("GET", "/health?token=a+long+secret+indeed")
            assert asked.getresponse().read() and asked.sock is kept_open
        asked.close()


def test_a_token_may_have_any_sign():
    with running(token="a+b&c#d/e f%, and more") as server, Client(server.ws, token="a+b&c#d/e f%, and more") as viewer:
        assert viewer.messages["welcome"]


def test_strangers_and_the_token():
    with running(token="open sesame, open") as server:
        assert get(f"{server.url}/health")[0] == 401
        assert get(f"{server.url}/health?token=wrong")[0] == 401
        assert get(f"{server.url}/health?token=open+sesame,+open")[0] == 200
        assert get(f"{server.url}/health", {"Authorization": "Bearer open sesame, open"})[0] == 200
        assert get(f"{server.url}/page/nothing.js")[0] == 404
        for query in ("", "?token=wrong"):
            with pytest.raises(InvalidStatus, match="401"):
                connect(f"{server.ws}/ws{query}", **SOON).__enter__()
        with pytest.raises(ConnectionError, match=r"refuses \(401\): .*expected the token"):
            Client(server.ws, token="another long secret").__enter__()
        assert still_serves(server)


def test_pages_of_others_are_refused(ball):
    own = {"Origin": ball.url}
    for headers in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "evil.example"}):
        assert get(f"{ball.url}/health", headers)[0] == 403 and get(f"{ball.url}/", headers)[0] == 403
    assert get(f"{ball.url}/health", own)[0] == 200
    port = ball.url.rsplit(":", 1)[1]
    rebound = {"Host": f"127.0.0.1.evil.example:{port}", "Origin": f"http://127.0.0.1.evil.example:{port}"}
    for headers in (rebound, {"Origin": "http://["}, {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}):
        assert get(f"{ball.url}/frame.jpg?width=16&height=16", headers)[0] == 403
    followed = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "document"}
    assert get(ball.url, followed)[0] == get(ball.url, {"Sec-Fetch-Site": "same-origin"})[0] == 200
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"{ball.ws}/ws", origin="http://evil.example", **SOON).__enter__()
    with connect(f"{ball.ws}/ws", origin=ball.url, **SOON) as ours:
        assert greet(ours)["type"] == "welcome"


@pytest.mark.parametrize(
    "host", ["[::1].evil.com", "localhost:80@evil.com", "localhost/", "127.0.0.1.evil.com", "", "[::1", "localhost:x"]
)
def test_hosts_are_parsed_and_not_matched(ball, host):
    port = ball.url.rsplit(":", 1)[1]
    answer = exchange(ball, f"GET /health HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    assert answer.startswith(b"HTTP/1.1 403")
    assert get(f"{ball.url}/health", {"Origin": f"http://{host}:{port}"})[0] == 403


@pytest.mark.parametrize("host", ["LOCALHOST", "[::1]:80", "127.0.0.2", "Localhost:8008"])
def test_this_machine_has_many_names(ball, host):
    assert get(f"{ball.url}/health", {"Host": host, "Origin": f"http://{host.lower()}"})[0] == 200
    assert get(f"{ball.url}/health", {"Host": host, "Origin": f"http://{host}.evil.com"})[0] == 403


def test_an_origin_has_the_port_of_its_scheme():
    guard = Guard("0.0.0.0", "x" * 16)

    def refused(host, origin):
        headers = [(b"host", host.encode()), (b"origin", origin.encode())]
        return guard.foreign_origin(HTTPConnection({"type": "http", "headers": headers})) is not None

    assert not refused("rig.example", "https://rig.example:443") and not refused("rig.example:80", "http://RIG.example")
    assert refused("rig.example", "https://rig.example:8008") and refused("rig.example", "file://rig.example")
    assert refused("rig.example:80", "https://rig.example")


def exchange(server, sent, wait_s=10.0):
    """What a connection is answered until its end."""
    with socket.create_connection(("127.0.0.1", int(server.url.rsplit(":", 1)[1])), timeout=wait_s) as raw:
        raw.sendall(sent)
        answer = b""
        with contextlib.suppress(ConnectionResetError):
            while b"\r\n\r\n" not in answer and (more := raw.recv(65536)):
                answer += more
    return answer


def test_beyond_this_machine_a_token_is_demanded():
    for host in ("0.0.0.0", "192.168.1.4", "::"):
        with pytest.raises(ValueError, match=f"expected --token with --host {host}"):
            Guard(host, None)
        Guard(host, "x" * 16)
    with pytest.raises(ValueError, match="at least 16 signs, got 15"):
        Guard("127.0.0.1", "x" * 15)
    Guard("127.0.0.1", None)
    Guard("::1", None)


def test_stopping_frees_the_port_while_viewers_watch():
    before = set(threading.enumerate())
    with running() as server:
        port = int(server.url.rsplit(":", 1)[1])
        viewer = Client(server.ws).__enter__()
        viewer.frame(viewer.look(width=32, height=32))
    again = socket.socket()
    again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    again.bind(("127.0.0.1", port))
    again.close()
    assert closing(viewer._socket._socket) in (1012, None)
    viewer._socket.close()
    assert set(threading.enumerate()) <= before


def test_a_taken_port_is_said():
    with running() as server:
        port = int(server.url.rsplit(":", 1)[1])
        with pytest.raises(OSError, match=f"port {port} of 127.0.0.1"), running(port=port):
            pass


def test_rates_and_patience(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    rate = RateLimit(10)
    assert sum(rate.allows() for _ in range(100)) in (19, 20)
    now[0] += 0.5
    assert sum(rate.allows() for _ in range(100)) in (4, 5, 6)
    now[0] += 1000
    assert sum(rate.allows() for _ in range(100)) in (19, 20), "a long silence saves up no more than a short one"
    patience = FaultLimit(3, 10.0)
    assert [patience.exceeded() for _ in range(3)] == [False, False, True]
    now[0] += 20
    assert not patience.exceeded()
