"""Many viewers on two replicas: python research/many_viewers.py [--kills 20] [--frames 10000].

Runs `viewmend serve --ray local` with two replicas. First four viewers move around while the replica that serves them
is killed repeatedly; measures how long each waits for its next image and whether it answers its own pose. Then four
viewers receive many small frames; measures the memory of replicas, ingest, proxy and object store. Needs the extra
`ray`.
"""

import argparse
import contextlib
import itertools
import json
import math
import os
import re
import signal
import statistics
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import benchmarks_path  # noqa: F401
from measure import write

from viewmend.live.client import Client

VIEWERS, SEEN_PX = 4, 160
STUDIO = ["--size", "160", "--cameras", "6", "--frames", "24"]
LONG = ["--frames", "60", "--memory-mb", "160"]
"""More frames than the object store holds, so that the ingest keeps replacing them."""
LOST_S = 60.0
"""A viewer without an image for this long counts as lost."""


@contextlib.contextmanager
def served(*options: str):
    """Process and address of a server with two replicas."""
    command = [sys.executable, "-m", "viewmend", "serve", "--ray", "local", "--port", "0", *STUDIO, *options]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
    ) as server:
        assert server.stderr is not None
        try:
            line = server.stderr.readline()
            found = re.search(r"http://([\d.]+:\d+)", line)
            assert found, line + server.stderr.read()
            yield server, found[1]
        finally:
            server.send_signal(signal.SIGTERM)
            server.wait(60)


def processes(server: subprocess.Popen, title: str) -> list[int]:
    """Process ids of the server's processes whose title starts with `title`, oldest first."""
    parents, titles, born = {}, {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            stat = (folder / "stat").read_text().rpartition(")")[2].split()
            parents[int(folder.name)], born[int(folder.name)] = int(stat[1]), int(stat[19])
            titles[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")

    def is_ours(pid: int) -> bool:
        return pid == server.pid or (pid in parents and is_ours(parents[pid]))

    return sorted(
        (pid for pid in titles if titles[pid].startswith(title) and is_ours(pid)), key=lambda pid: born[pid]
    )


def answering(address: str, dead: int) -> int:
    """Process id of the replica that answers; `dead` if none does."""
    with (
        contextlib.suppress(OSError),
        urllib.request.urlopen(f"http://{address}/health", timeout=30) as answer,
    ):
        return json.load(answer)["process"]
    return dead


class StopWatch(threading.Thread):
    """Detects that the server was paused (SIGSTOP) by other measurements, which voids the result."""

    def __init__(self, server: subprocess.Popen) -> None:
        super().__init__(daemon=True)
        self.server, self.stopped_at, self.over = server, 0.0, False

    def run(self) -> None:
        while not self.over:
            for pid in processes(self.server, ""):
                with contextlib.suppress(OSError):
                    if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T":
                        self.stopped_at = time.monotonic()
            time.sleep(0.2)


class Walker(threading.Thread):
    """A moving viewer; each has its own height, by which its images are recognised."""

    def __init__(self, address: str, seat: int, side: int) -> None:
        super().__init__(daemon=True)
        self.address, self.height_m, self.side = address, 0.9 + 0.1 * seat, side
        self.arrived: list[tuple[float, int]] = []
        """Arrival time of each image, and the connection that delivered it."""
        self.wrong: list[str] = []
        self.over = False

    def run(self) -> None:
        with Client(f"ws://{self.address}", reconnect_s=LOST_S, timeout_s=10 * LOST_S) as viewer:
            while not self.over:
                camera = {
                    "azimuth": 20.0 * time.monotonic() % 360,
                    "target": [0.0, self.height_m, 0.0],
                    "distance": 3.0,
                }
                look = viewer.look(camera=camera, width=self.side, height=self.side, moving=True)
                frame = viewer.frame(look)
                self.arrived.append((time.monotonic(), viewer.connections))
                R, T = frame.header["cameras"][0]["R"], frame.header["cameras"][0]["T"]
                eye_m = -sum(R[3 * n + 1] * T[n] for n in range(3))
                if abs(eye_m - self.height_m) > 1e-3:
                    self.wrong.append(f"{eye_m:.3f} m instead of {self.height_m:.3f} m")


@contextlib.contextmanager
def walking(address: str, side: int):
    """Viewers that have all received an image."""
    walkers = [Walker(address, seat, side) for seat in range(VIEWERS)]
    for walker in walkers:
        walker.start()
    until(lambda: all(walker.arrived for walker in walkers), 60)
    yield walkers
    for walker in walkers:
        walker.over = True
    for walker in walkers:
        walker.join(LOST_S)


def until(true, seconds: float) -> bool:
    """Wait for a condition; whether it became true in time."""
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.02)
    return bool(true())


def kill_repeatedly(kills: int) -> dict[str, object]:
    """Kill the replica that serves the viewers; waiting times, and time until two replicas answer."""
    waits, whole_s, lost, gaps, void = [], [], 0, [], 0
    with served("--model", "views") as (server, address), walking(address, SEEN_PX) as walkers:
        watch = StopWatch(server)
        watch.start()
        while len(whole_s) < kills:
            until(lambda: time.monotonic() > watch.stopped_at + 3, 600)
            time.sleep(3)
            oldest, newest = processes(server, "ray::ServeReplica")
            had = {walker: walker.arrived[-1][1] for walker in walkers}
            gaps += [b[0] - a[0] for w in walkers for a, b in itertools.pairwise(w.arrived[-20:])]
            start = time.monotonic()
            os.kill(oldest, signal.SIGKILL)
            # Viewers of the other replica do not notice.
            until(lambda: all(any(t > start + 2 for t, _ in w.arrived[-1:]) for w in walkers), LOST_S)  # noqa: B023
            news = [[at - start for at, by in list(w.arrived) if by > had[w]] for w in walkers]
            gone = sum(not new and w.arrived[-1][0] < start + 1 for w, new in zip(walkers, news, strict=True))
            until(lambda: answering(address, oldest) not in (oldest, newest), 300)  # noqa: B023
            print(
                [round(new[0], 2) for new in news if new],
                round(time.monotonic() - start, 1),
                gone,
                flush=True,
            )
            if watch.stopped_at > start - 3:
                void += 1
                continue
            waits += [new[0] for new in news if new]
            lost += gone
            whole_s.append(time.monotonic() - start)
        watch.over, wrong = True, [text for walker in walkers for text in walker.wrong]
    return {
        "kills": len(whole_s),
        "void_kills": void,
        "viewers_that_lost_their_connection": len(waits),
        "viewers_lost": lost,
        "wrong_images": len(wrong),
        "seconds_to_the_next_image": {"median": median(waits), "largest": round(max(waits), 2)},
        "seconds_between_images_before": {"median": median(gaps), "largest": round(max(gaps), 2)},
        "seconds_until_two_replicas_answer": {"median": median(whole_s), "largest": round(max(whole_s), 1)},
    }


def median(values: list[float]) -> float:
    return round(statistics.median(values), 3)


def memory_mb(server: subprocess.Popen) -> dict[str, float]:
    """Private memory of each process, and the part of the object store it has touched."""
    found = {}
    for name, title in {
        "ingest": "ray::IngestActor",
        "proxy": "ray::ProxyActor",
        "replica": "ray::ServeReplica",
    }.items():
        for number, pid in enumerate(processes(server, title)):
            found[f"{name} {number}"] = status_mb(pid, "RssAnon")
            found[f"{name} {number}, object store"] = status_mb(pid, "RssShmem")
    return found


def status_mb(pid: int, key: str) -> float:
    line = re.search(rf"{key}:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    return round(int(line[1]) / 1000, 1) if line else math.nan


def many_frames(frames: int) -> dict[str, object]:
    """Memory while many small frames are received; the first tenth fills the stores."""
    with (
        served(*LONG, "--model", "nearest", "--budget-ms", "0") as (server, address),
        walking(address, 64) as walkers,
    ):
        taken = lambda: sum(len(walker.arrived) for walker in walkers)  # noqa: E731
        samples, begun = [], time.monotonic()
        for part in range(1, 11):
            until(lambda: taken() >= frames * part / 10, 600)  # noqa: B023
            samples.append(memory_mb(server))
            print(taken(), samples[-1], flush=True)
        seconds, wrong = time.monotonic() - begun, sum(len(walker.wrong) for walker in walkers)
        connections = sum(walker.arrived[-1][1] for walker in walkers)
    return {
        "frames": taken(),
        "frames_per_s": round(taken() / seconds, 1),
        "wrong_images": wrong,
        "connections": connections,
        "mb_after_a_tenth": samples[0],
        "mb_in_the_middle": samples[4],
        "mb_at_the_end": samples[-1],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    figures = {"kills": kill_repeatedly(options.kills)} if options.kills else {}
    print(json.dumps(figures, indent=1), flush=True)
    figures |= {"many frames": many_frames(options.frames)} if options.frames else {}
    print(json.dumps(figures, indent=1))
    if options.write:
        print(
            write(
                "many_viewers",
                "cpu",
                {"viewers": VIEWERS, "studio": STUDIO, "long": LONG, "side_px": SEEN_PX},
                figures,
            )
        )


if __name__ == "__main__":
    main()
