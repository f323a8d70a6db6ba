"""Hostile clients without a token: python benchmarks/unauthenticated_load.py PORT EACH SECONDS KIND [KIND ...].

Keeps EACH connections of each kind open, and reconnects as soon as the server closes them. Prints the number of
connections. It runs in a process of its own so that it does not delay the measuring client.
"""

import argparse
import contextlib
import socket
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

UPGRADE = "GET {} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{}\r\n"
KEYS = "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n"
WRONG = UPGRADE.format("/ws?token=wrong", KEYS).encode()
POST = "POST /path.mp4{} HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
ASSET = "GET /assets/0?without=cam{:02}{} HTTP/1.1\r\nHost: localhost\r\n\r\n"
PAGE = b"GET /page/main.js HTTP/1.1\r\nHost: localhost\r\n\r\n"


@dataclass(frozen=True)
class Kind:
    """Bytes that a client sends first and then repeatedly, and whether it reads the answers."""

    first: bytes = b""
    more: bytes = b""
    reads: bool = True


KINDS = {
    "silent": Kind(),
    "half a request": Kind(b"GET / HTTP/1.1\r\nHost: loc"),
    "no token, 60 MB": Kind(
        UPGRADE.format("/ws", KEYS).encode() + b"\x82\xff" + (60_000_000).to_bytes(8, "big")
    ),
    "an upgrade that cannot be": Kind(UPGRADE.format("/ws?" + "a" * 9000, KEYS).encode()),
    "answers unread": Kind(PAGE * 200, reads=False),
    "a wrong token, messages": Kind(WRONG, b"\x81\x80\0\0\0\0" * 40_000),
    "a wrong token, pings": Kind(WRONG, b"\x89\x80\0\0\0\0" * 40_000),
    "a wrong token, pieces": Kind(WRONG, b"\x01\x80\0\0\0\0" + b"\0\x80\0\0\0\0" * 40_000),
    "a body without end": Kind(POST.format("").encode(), b"1\r\nx\r\n" * 40_000),
    "a wrong token, a body without end": Kind(POST.format("?token=wrong").encode(), b"1\r\nx\r\n" * 40_000),
    "trailers": Kind(POST.format("").encode() + b"0\r\n", b"a: b\r\n" * 10_000),
    "a head without end": Kind(b"GET / HTTP/1.1\r\n", b"a: b\r\n" * 10_000),
    "blank lines": Kind(b"\r\n", b"\r\n" * 40_000),
    "assets without a token": Kind(*["".join(ASSET.format(n, "") for n in range(8)).encode()] * 2),
    "assets, a wrong token": Kind(*["".join(ASSET.format(n, "&token=wrong") for n in range(8)).encode()] * 2),
    "requests one after the other": Kind(PAGE, PAGE * 100),
    "a slow body": Kind(
        POST.format("").replace("Transfer-Encoding: chunked", "Content-Length: 900000").encode() + b"{"
    ),
}


def begin(port: int, each: int, seconds: float, kinds: list[str]) -> subprocess.Popen[str]:
    """Start this program as a process."""
    command = [sys.executable, str(Path(__file__)), str(port), str(each), str(seconds), *kinds]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def crowd(port: int, kind: Kind, ended: threading.Event, opened: list[int], each: int) -> None:
    """Keep `each` connections of one kind open; reopen those that the server closes."""
    held: dict[socket.socket, memoryview] = {}
    while not ended.is_set():
        for raw in list(held):
            try:
                with contextlib.suppress(BlockingIOError):
                    while kind.reads:
                        if not raw.recv(65536):
                            raise ConnectionError
                with contextlib.suppress(BlockingIOError):
                    if left := held[raw] or memoryview(kind.more):
                        held[raw] = left[raw.send(left) :]
            except OSError:
                raw.close()
                del held[raw]
        for _ in range(min(20, each - len(held))):
            with contextlib.suppress(OSError):
                raw = socket.create_connection(("127.0.0.1", port), timeout=2)
                raw.setblocking(False)
                held[raw] = memoryview(kind.first)
                opened[0] += 1
        ended.wait(0.1)
    for raw in held:
        raw.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int, help="the server's port on this machine")
    parser.add_argument("each", type=int, help="connections of each kind")
    parser.add_argument("seconds", type=float, help="duration")
    parser.add_argument("kinds", nargs="+", choices=list(KINDS), metavar="KIND", help="; ".join(KINDS))
    options = parser.parse_args()
    ended = threading.Event()
    opened = [0]
    threads = [
        threading.Thread(target=crowd, args=(options.port, KINDS[kind], ended, opened, options.each))
        for kind in options.kinds
    ]
    for thread in threads:
        thread.start()
    ended.wait(options.seconds)
    ended.set()
    for thread in threads:
        thread.join()
    print(opened[0])


if __name__ == "__main__":
    main()
