"""A server under a thousand connections of strangers: what a viewer with the token still gets, and what memory does.

Run: `python benchmarks/attack.py [seconds]`. A server in a process of its own; a viewer; five kinds of strangers, 200
of each, opened anew as soon as the server ends them. Prints JSON: the viewer's frames a second before and during, and
the server's memory before, at its highest, and 30 seconds after.
"""

import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

from viewmend.live.client import Client

TOKEN = "a token of the benchmark"
EACH = 200
UPGRADE = "GET {} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{}\r\n"
KEYS = "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n"
KINDS = {
    "silent": b"",
    "half a request": b"GET / HTTP/1.1\r\nHost: loc",
    "no token, 60 MB": UPGRADE.format("/ws", KEYS).encode() + b"\x82\xff" + (60_000_000).to_bytes(8, "big"),
    "an upgrade that cannot be": UPGRADE.format("/ws?" + "a" * 9000, KEYS).encode(),
    "answers unread": b"GET /page/main.js HTTP/1.1\r\nHost: localhost\r\n\r\n" * 200,
}


def megabytes(process: int) -> float:
    """Resident memory."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def strangers(port: int, sent: bytes, ended: threading.Event, opened: list[int]) -> None:
    """Keep so many connections of one kind; what the server ends is opened again."""
    held: list[socket.socket] = []
    while not ended.is_set():
        for raw in list(held):
            with contextlib.suppress(BlockingIOError):
                try:
                    gone = sent != KINDS["answers unread"] and not raw.recv(65536)
                except ConnectionError:
                    gone = True
                if gone:
                    raw.close()
                    held.remove(raw)
        for _ in range(min(20, EACH - len(held))):
            with contextlib.suppress(OSError):
                raw = socket.create_connection(("127.0.0.1", port), timeout=2)
                raw.setblocking(False)
                with contextlib.suppress(OSError):
                    raw.send(sent)
                held.append(raw)
                opened[0] += 1
        ended.wait(0.1)
    for raw in held:
        raw.close()


def frames_a_second(viewer: Client, seconds: float) -> float:
    """Of a viewer who asks for the next view as soon as the last has come."""
    count, end = 0, time.monotonic() + seconds
    while time.monotonic() < end:
        viewer.frame(viewer.look(camera={"azimuth": 3.0 * count}, width=160, height=160, modes=["rendered"]))
        count += 1
    return count / seconds


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    options = ["--port", "0", "--size", "160", "--cameras", "6", "--frames", "4", "--model", "nearest"]
    command = [sys.executable, "-m", "viewmend", "serve", *options]
    environment = os.environ | {"VIEWMEND_TOKEN": TOKEN}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as server:
        assert server.stderr is not None
        address = re.search(r"http(://127\.0\.0\.1:(\d+))", server.stderr.readline())
        assert address is not None
        threading.Thread(target=server.stderr.read, daemon=True).start()
        ended, opened, highest = threading.Event(), [0], [0.0]
        with Client(f"ws{address[1]}", TOKEN, timeout_s=120) as viewer:
            frames_a_second(viewer, 5)
            before = frames_a_second(viewer, seconds)
            memory = megabytes(server.pid)
            port = int(address[2])
            crowd = [threading.Thread(target=strangers, args=(port, sent, ended, opened)) for sent in KINDS.values()]

            def watch() -> None:
                while not ended.wait(0.5):
                    highest[0] = max(highest[0], megabytes(server.pid))

            for thread in [*crowd, watcher := threading.Thread(target=watch)]:
                thread.start()
            time.sleep(5)
            during = frames_a_second(viewer, seconds)
            ended.set()
            for thread in [*crowd, watcher]:
                thread.join()
            time.sleep(30)
            after = megabytes(server.pid)
        server.terminate()
        code = server.wait(30)
    report = {
        "connections": opened[0],
        "frames_per_s": {"before": round(before, 2), "during": round(during, 2)},
        "share": round(during / before, 3),
        "memory_mb": {"before": round(memory), "highest": round(highest[0]), "after_30_s": round(after)},
        "exit_code": code,
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
