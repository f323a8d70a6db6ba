"""Server cost of viewers whose pages draw: python research/drawing_viewers.py --source CAPTURE [--playing].

Scripted clients do what the page does while a view orbits or a recording plays: each holds a WebSocket, fetches the
shape and the closest cameras' images of the frames it needs over up to six connections, keeps what may be cached for
good, and tries again where a connection breaks, as browsers do. Viewers arrive over five seconds. Prints processor
time and bytes of the server, for the first seconds and after that.
`--idle N` adds viewers that ask for views and assets and read nothing.
"""

import argparse
import asyncio
import json
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import websockets

CONNECTIONS, FILLERS = 6, 3
ARRIVAL_S = 5.0


class Viewer:
    """One page."""

    def __init__(self, address: str, start_deg: float, playing: bool, forget_s: float) -> None:
        self.forget_s = forget_s
        self.host, port = address.removeprefix("http://").rsplit(":", 1)
        self.port, self.start_deg, self.playing = int(port), start_deg, playing
        self.cached: dict[str, bytes] = {}
        self.ranks: dict[int, tuple[np.ndarray, int]] = {}
        self.state: dict = {}
        self.heard_at = 0.0
        self.http_bytes = self.ws_bytes = self.requests = self.refused = self.broken = self.frames = 0
        self.waits_ms: list[float] = []

    async def run(self, begin: float, end: float) -> None:
        await asyncio.sleep(begin)
        while time.monotonic() < end:
            try:
                await self.visit(end)
            except (OSError, EOFError, TimeoutError, websockets.WebSocketException):
                self.broken += 1
                await asyncio.sleep(0.5)

    async def visit(self, end: float) -> None:
        options = {"compression": None, "ping_interval": None, "open_timeout": 60}  # browsers send no pings
        async with websockets.connect(f"ws://{self.host}:{self.port}/ws", **options) as socket:
            await socket.send(json.dumps({"type": "hello", "version": 1, "codecs": ["jpeg"]}))
            self.rig: dict = {}
            listener = asyncio.create_task(self.listen(socket))
            while not (self.rig and self.state):
                if listener.done():
                    listener.result()
                    raise ConnectionError("closed before the rig was known")
                await asyncio.sleep(0.01)
            if not self.playing:
                await socket.send(json.dumps({"type": "clock", "playing": False, "seek": 0}))
            self.free = asyncio.Queue()
            for _ in range(CONNECTIONS):
                self.free.put_nowait(None)
            try:
                await self.draw(end, listener)
            finally:
                listener.cancel()
                while not self.free.empty():
                    if pair := self.free.get_nowait():
                        pair[1].close()

    async def listen(self, socket) -> None:
        async for message in socket:
            self.ws_bytes += len(message)
            content = json.loads(message)
            if content["type"] == "rig":
                self.rig = content
            elif content["type"] == "state":
                self.state, self.heard_at = content, time.monotonic()

    async def draw(self, end: float, listener: asyncio.Task[None]) -> None:
        begun = time.monotonic()
        fps = (self.rig["fps"] or 0.0) * self.playing
        forgotten = begun
        while (now := time.monotonic()) < end:
            if listener.done():
                raise ConnectionError("the socket was closed")
            if now - forgotten > self.forget_s:
                forgotten = now
                self.cached.clear()
            span = max(1, self.state["end"] - self.state["first"])
            shown = self.state["time"] * self.playing + int((now - self.heard_at) * fps)
            azimuth = math.radians(self.start_deg + 40 * (now - begun))
            ahead = [0, 3] if self.playing else [0]
            for step in ahead:
                await self.frame(self.state["first"] + (shown + step) % span, azimuth)
            self.frames += 1
            self.waits_ms.append(1000 * (time.monotonic() - now))
            await asyncio.sleep(max(0.0, 1 / (fps or 15) - (time.monotonic() - now)))

    async def frame(self, index: int, azimuth: float) -> None:
        shape = await self.get(f"/assets/{index}?v={self.rig['assets']}")
        if index not in self.ranks:
            length = int.from_bytes(shape[4:8], "little")
            header = json.loads(shape[8 : 8 + length])
            centers = np.array([camera["center"] for camera in header["cameras"]]) - header["center"]
            self.ranks[index] = centers / np.linalg.norm(centers, axis=1)[:, None], header["blend"]["cameras"]
        centers, blended = self.ranks[index]
        eye = math.cos(azimuth) * np.array(self.rig["front"]) + math.sin(azimuth) * np.array(self.rig["side"])
        order = np.argsort(-(centers @ eye))
        wanted = order[: blended + FILLERS] if self.playing else order
        paths = [f"/assets/{index}/{n}?v={self.rig['assets']}" for n in wanted]
        if missing := [path for path in paths if path not in self.cached]:
            await asyncio.gather(*map(self.get, missing))

    async def ask(self, pair, path: str):
        """Send a request, over a new connection if there is none; the connection, and the response's head."""
        pair = pair or await asyncio.open_connection(self.host, self.port)
        pair[1].write(f"GET {path} HTTP/1.1\r\nHost: {self.host}:{self.port}\r\n\r\n".encode())
        return pair, await pair[0].readuntil(b"\r\n\r\n")

    async def get(self, path: str) -> bytes:
        if path in self.cached:
            return self.cached[path]
        pair = await self.free.get()
        try:
            for attempt in range(4):
                try:
                    pair, head = await self.ask(pair, path)
                    size = int(head.lower().split(b"content-length: ")[1].split(b"\r")[0])
                    body = await pair[0].readexactly(size)
                    break
                except (
                    asyncio.IncompleteReadError,
                    OSError,
                ):  # idle connections are closed, and so are too many new ones
                    broken, pair = pair, None
                    if broken is None:
                        self.broken += 1
                        await asyncio.sleep(0.1 * 2**attempt)
            else:
                raise ConnectionError(f"no answer to {path}")
        finally:
            self.free.put_nowait(pair)
        self.requests += 1
        self.http_bytes += len(head) + size
        if not head.startswith(b"HTTP/1.1 200"):  # not ready, or busy
            self.refused += 1
            await asyncio.sleep(1)
            return await self.get(path)
        if b"immutable" in head.lower():
            self.cached[path] = body if path.count("/") == 2 else b"1"
        return body


async def stall(address: str, end: float) -> None:
    """A viewer that asks for views and for assets and reads nothing."""
    host, port = address.removeprefix("http://").rsplit(":", 1)
    while time.monotonic() < end:
        try:
            socket = await websockets.connect(f"ws://{host}:{port}/ws", compression=None, max_queue=1)
            await socket.send(json.dumps({"type": "hello", "version": 1, "codecs": ["jpeg"]}))
            look = {
                "type": "look",
                "id": 1,
                "camera": {"azimuth": 10},
                "width": 640,
                "height": 640,
                "quality": 95,
            }
            await socket.send(json.dumps(look))
            socket.transport.pause_reading()
            _, writer = await asyncio.open_connection(host, int(port), limit=1024)  # reads no more than that
            for _ in range(200):
                writer.write(f"GET /assets/0 HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
            await asyncio.sleep(min(15.0, max(0.0, end - time.monotonic())))
            writer.close()
            await asyncio.wait_for(socket.close(), 2)
        except (OSError, TimeoutError, websockets.ConnectionClosed):
            await asyncio.sleep(0.2)


def processor_s(pid: int) -> float:
    threads = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(thread.read_text().split()[0]) for thread in threads) / 1e9


def resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


async def measure(address: str, pid: int, viewers: int, options: argparse.Namespace) -> None:
    begun = time.monotonic()
    end = begun + options.first + options.seconds
    crowd = [
        Viewer(address, 360 * n / max(1, viewers), options.playing, options.forget) for n in range(viewers)
    ]
    tasks = [asyncio.create_task(viewer.run(n * ARRIVAL_S / viewers, end)) for n, viewer in enumerate(crowd)]
    tasks += [asyncio.create_task(stall(address, end)) for _ in range(options.idle)]
    total = lambda name: sum(getattr(viewer, name) for viewer in crowd)  # noqa: E731
    names = ("http_bytes", "ws_bytes", "requests", "refused", "broken", "frames")
    last = (processor_s(pid), dict.fromkeys(names, 0), begun)
    windows = [options.first] + [options.window or options.seconds] * round(
        options.seconds / (options.window or options.seconds)
    )
    for n, window in enumerate(windows):
        await asyncio.sleep(window)
        now = (processor_s(pid), {name: total(name) for name in names}, time.monotonic())
        taken = now[2] - last[2]
        rate = {f"{name}_per_s": round((now[1][name] - last[1][name]) / taken, 1) for name in names}
        waits = sorted(wait for viewer in crowd for wait in viewer.waits_ms) or [0.0]
        for viewer in crowd:
            viewer.waits_ms = []
        row = {
            "viewers": viewers,
            "part": "first" if n == 0 else "after",
            "cores": round((now[0] - last[0]) / taken, 4),
        }
        row |= rate | {
            "wait_ms_p50_p99_max": [round(waits[int(q * (len(waits) - 1))], 1) for q in (0.5, 0.99, 1)]
        }
        print(
            json.dumps(row | {"resident_mb": round(resident_mb(pid), 1), "load": os.getloadavg()[0]}),
            flush=True,
        )
        last = now
    for result in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(result, Exception):
            print("a viewer failed:", repr(result)[:300], flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--source", default="studio", help="a capture, or the synthetic studio")
    parser.add_argument(
        "--playing", action="store_true", help="viewers follow the recording; without, they orbit"
    )
    parser.add_argument("--viewers", type=int, nargs="+", default=[0, 1, 8, 64])
    parser.add_argument(
        "--forget", type=float, default=math.inf, help="seconds after which caches are emptied"
    )
    parser.add_argument("--idle", type=int, default=0, help="viewers who read nothing")
    parser.add_argument("--first", type=float, default=5.0, help="seconds in which viewers arrive")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--window", type=float, default=0.0, help="seconds of each line of a long run")
    parser.add_argument("--address", help="of a running server, with --pid")
    parser.add_argument("--pid", type=int)
    options = parser.parse_args()
    if options.address:
        for viewers in options.viewers:
            asyncio.run(measure(options.address, options.pid, viewers, options))
        return
    command = [sys.executable, "-m", "viewmend", "serve", options.source, "--port", "0", "--viewers", "100"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = next(
                found.group() for line in server.stdout if (found := re.search(r"http://\S+", line))
            )
            time.sleep(20)
            for viewers in options.viewers:
                asyncio.run(measure(address.rstrip("/"), server.pid, viewers, options))
        finally:
            server.terminate()


if __name__ == "__main__":
    main()
