"""The cost of broadcast watchers: python research/broadcast.py [--watchers 1 50 200] [--write].

A server broadcasts a studio scene while a viewer on air moves around. Watchers in another process do what the page's
player does: they request the playlist twice a second and every segment once. Prints what they received, how late, and
what the server used.
"""

import argparse
import http.client
import json
import statistics
import subprocess
import sys
import threading
import time
from urllib.parse import urlsplit

import benchmarks_path  # noqa: F401
from live import served
from measure import write

from viewmend.live.client import Client
from viewmend.live.server import load_extension
from viewmend.utils.heap import resident_bytes

SIZE = (1280, 720)
ASK_S = 0.5


class Watcher(threading.Thread):
    """A watcher with one persistent connection."""

    def __init__(self, url: str, end: float) -> None:
        super().__init__(daemon=True)
        self._connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=30)
        self._end = end
        self.segments: dict[str, float] = {}
        """Arrival time of each segment, in seconds since the epoch."""
        self.bytes = self.faults = 0

    def run(self) -> None:
        """Request playlist and segments until the end."""
        while time.time() < self._end:
            names = self._get("live.m3u8").decode().split("\n")
            for name in (name for name in names if name.endswith(".m4s") and name not in self.segments):
                self.bytes += len(self._get(name))
                self.segments[name] = time.time()
            time.sleep(ASK_S)

    def _get(self, name: str) -> bytes:
        try:
            self._connection.request("GET", f"/broadcast/{name}")
            answer = self._connection.getresponse()
            content = answer.read()
            self.faults += answer.status != 200
            return content if answer.status == 200 else b""
        except (OSError, http.client.HTTPException):
            self.faults += 1
            self._connection.close()
            return b""


def watch(url: str, count: int, seconds: float) -> None:
    """Run watchers in this process and print what they received as JSON."""
    watchers = [Watcher(url, time.time() + seconds) for _ in range(count)]
    for watcher in watchers:
        watcher.start()
        time.sleep(min(ASK_S, 2.0 / count))
    for watcher in watchers:
        watcher.join()
    first = {}
    for watcher in watchers:
        for name, at in watcher.segments.items():
            first[name] = min(at, first.get(name, at))
    # The first segments were available before the watchers started.
    late = [at - first[name] for w in watchers for name, at in list(w.segments.items())[6:]]
    got = {
        "segments_each": statistics.mean(len(w.segments) for w in watchers),
        "least_segments": min(len(w.segments) for w in watchers),
        "gaps": sum(gaps(w.segments) for w in watchers),
        "faults": sum(w.faults for w in watchers),
        "megabytes": sum(w.bytes for w in watchers) / 1e6,
        "after_the_first_s": {"p50": statistics.median(late), "p99": statistics.quantiles(late, n=100)[98]},
    }
    print(json.dumps(got))


def gaps(segments: dict[str, float]) -> int:
    """Number of segments missing between the first and the last."""
    numbers = [int(name.removesuffix(".m4s")) for name in segments]
    return max(numbers) - min(numbers) + 1 - len(numbers) if numbers else 0


def walk(url: str, stop: threading.Event) -> None:
    """Move around on air."""
    with Client(url) as viewer:
        viewer.on_air()
        start = time.monotonic()
        while not stop.is_set():
            camera = {"azimuth": 20.0 * (time.monotonic() - start), "elevation": 10.0}
            viewer.frame(viewer.look(camera=camera, width=320, height=180, moving=True))


def watched(url: str, count: int, seconds: float) -> dict[str, object]:
    """Run watchers in another process; their result."""
    command = [sys.executable, __file__, "--seconds", str(seconds), "--watch", url, str(count)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def main() -> None:
    """Measure each number of watchers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--watchers", type=int, nargs="*", default=[1, 50, 200])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--model", default="views")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--watch", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.watch:
        watch(options.watch[0], int(options.watch[1]), options.seconds)
        return
    rows, stop = [], threading.Event()
    extension = load_extension("broadcast", f"{SIZE[0]}x{SIZE[1]}")
    with served((320, 320), 100.0, "cpu", options.model, extensions=(extension,)) as (ws, service):
        url = ws.replace("ws", "http", 1)
        director = threading.Thread(target=walk, args=(ws, stop))
        director.start()
        try:
            run = lambda count: watched(url, count, options.seconds)  # noqa: E731
            run(1)  # warm-up
            for count in options.watchers:
                frames, cpu, start = service.counts["frames"], time.process_time(), time.monotonic()
                row = {"watchers": count, **run(count)}
                took = time.monotonic() - start
                row["views_per_s"] = (service.counts["frames"] - frames) / took
                row["server_cores"] = (time.process_time() - cpu) / took
                row["resident_mb"] = (resident_bytes() or 0) / 1e6
                rows.append(row)
                print(json.dumps(row), flush=True)
        finally:
            stop.set()
            director.join()
    if options.write:
        write("broadcast", "cpu", {"size_px": SIZE, "model": options.model, "seconds": options.seconds}, rows)


if __name__ == "__main__":
    main()
