"""A server under a thousand unauthenticated connections: python benchmarks/attack.py [--each] [--rounds 4] [--write].

Starts a server, one viewer with the token, and waves of five kinds of hostile clients, 200 of each, which reconnect as
soon as the server closes them. `--each` sends one kind at a time, 1000 of it; `--rounds` repeats each wave and first
measures as often without any. Prints JSON: the viewer's frame rate during the wave, its share of that before and after,
the viewer's longest wait, and the server's memory growth at its peak and 30 seconds later. The hostile clients use the
same processor, which lowers the share on few cores. Finally eight viewers request the largest views in a loop, and the
longest wait is printed.
"""

import argparse
import contextlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from measure import write
from unauthenticated_load import KINDS, begin

from viewmend.live.client import Client

TOKEN = "a token for the benchmark"
EACH = 200
SIDE_PX = 1448
"""Side of the largest square view that a viewer may request."""


def megabytes(process: int) -> float:
    """Resident memory."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@dataclass
class Outcome:
    """A viewer's frame rate during a wave, and the server's memory."""

    kinds: list[str]
    connections: int = 0
    frames_per_s: float = 0.0
    slowest_s: float = 0.0
    share: float = 0.0
    """Frame rate relative to the mean of before and after."""
    highest_mb: float = 0.0
    after_30_s_mb: float = 0.0
    resident_mb: float = 0.0
    """Total after 30 s; if it grows from the second round of a wave on, there is a leak."""


def look_on(viewer: Client, seconds: float) -> tuple[float, float]:
    """Frame rate and longest wait of a viewer that requests the next view when the last has arrived."""
    count, end, slowest = 0, time.monotonic() + seconds, 0.0
    while time.monotonic() < end:
        asked = time.monotonic()
        viewer.frame(viewer.look(camera={"azimuth": 3.0 * count}, width=160, height=160, modes=["rendered"]))
        count, slowest = count + 1, max(slowest, time.monotonic() - asked)
    return count / seconds, slowest


def attack(viewer: Client, port: int, server: int, kinds: list[str], seconds: float) -> Outcome:
    """Run a wave of these kinds, 1000 connections in all; without kinds, measure the server alone."""
    outcome = Outcome(kinds)
    ended = threading.Event()
    each = 5 * EACH // max(1, len(kinds))
    before, memory = look_on(viewer, seconds)[0], megabytes(server)

    def watch() -> None:
        while not ended.wait(0.2):
            outcome.highest_mb = max(outcome.highest_mb, megabytes(server) - memory)

    watcher = threading.Thread(target=watch)
    watcher.start()
    crowd = begin(port, each, seconds + 8, kinds) if kinds else None
    time.sleep(4)
    outcome.frames_per_s, outcome.slowest_s = look_on(viewer, seconds)
    outcome.connections = int(crowd.communicate()[0]) if crowd is not None else 0
    ended.set()
    watcher.join()
    outcome.share = outcome.frames_per_s / ((before + look_on(viewer, seconds)[0]) / 2)
    look_on(viewer, 30)  # connections that are not read for this long are closed
    outcome.resident_mb = megabytes(server)
    outcome.after_30_s_mb = outcome.resident_mb - memory
    return outcome


def full_house(url: str, seconds: float, viewers: int = 8) -> dict[str, float]:
    """Longest wait and number of images when all viewers request the largest views."""
    waits: list[float] = []

    def look(seat: int) -> None:
        with Client(url, TOKEN, timeout_s=120) as viewer:
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                camera, asked = {"azimuth": 45.0 * seat + len(waits)}, time.monotonic()
                viewer.frame(
                    viewer.look(
                        camera=camera, width=SIDE_PX, height=SIDE_PX, moving=True, adaptive=seat % 2 == 0
                    )
                )
                waits.append(time.monotonic() - asked)

    threads = [threading.Thread(target=look, args=(seat,)) for seat in range(viewers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return {"viewers": viewers, "pictures": len(waits), "slowest_s": round(max(waits, default=seconds), 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each measurement")
    parser.add_argument("--rounds", type=int, default=1, help="repetitions of each wave")
    parser.add_argument("--each", action="store_true", help="one kind at a time instead of five")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    parser.add_argument("--model", default="views", help="model of the final test; waves use rendered views")
    given = parser.parse_args()
    names = list(KINDS)
    waves = [[name] for name in names] if given.each else [names[n : n + 5] for n in range(0, len(names), 5)]
    options = ["--port", "0", "--size", "160", "--cameras", "6", "--frames", "4", "--model", given.model]
    command = [sys.executable, "-m", "viewmend", "serve", *options]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env=os.environ | {"VIEWMEND_TOKEN": TOKEN}
    ) as server:
        assert server.stderr is not None
        address = re.search(r"http(://127\.0\.0\.1:(\d+))", server.stderr.readline())
        assert address is not None
        said: list[str] = []
        threading.Thread(target=lambda: said.extend(server.stderr or []), daemon=True).start()
        outcomes: list[Outcome] = []
        with contextlib.ExitStack() as ends, Client(f"ws{address[1]}", TOKEN, timeout_s=120) as viewer:
            ends.callback(server.terminate)  # otherwise a failure here would wait forever
            look_on(viewer, 10)
            idle: list[list[str]] = [[]] * (given.rounds if given.rounds > 1 else 0)
            for kinds in idle + [kinds for kinds in waves for _ in range(given.rounds)]:
                outcomes.append(attack(viewer, int(address[2]), server.pid, kinds, given.seconds))
                print(json.dumps(asdict(outcomes[-1])), flush=True)
            viewer.__exit__()
            house = full_house(f"ws{address[1]}", given.seconds)
        began = time.monotonic()
        code = server.wait(60)
    report = {"waves": [asdict(one) for one in outcomes], "full_house": house}
    report |= {"exit_code": code, "lines_said": len(said)}
    report["seconds_to_end"] = round(time.monotonic() - began, 1)
    if given.write:
        print(
            write(
                "attack",
                "cpu",
                {"connections": 5 * EACH, "seconds": given.seconds, "model": given.model},
                report,
            )
        )
    print(json.dumps({key: report[key] for key in report if key != "waves"}))


if __name__ == "__main__":
    main()
