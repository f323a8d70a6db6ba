"""Soak test of the live server: python research/soak.py --minutes 30 [--write].

`viewmend serve live` in another process; a rig that pushes studio frames and is killed now and then; viewers that come
and go and check that every frame answers their own request and pose; a client that sends malformed messages;
unauthenticated clients of each kind of attack.py; and a client that exports camera paths and abandons half of them. The
server's memory is read every ten seconds. Exits with 1 if the server died, a viewer received a frame that was not its
own, or memory grew by more than 5 % (median of the last two fifths against the second and third; the first fills the
stores). Time in which the whole run was paused (SIGSTOP) does not count.
"""

import argparse
import contextlib
import json
import os
import random
import re
import signal
import statistics
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from pathlib import Path

import benchmarks_path  # noqa: F401
from measure import write
from unauthenticated_load import KINDS, begin
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from viewmend.live.client import Client, Publisher
from viewmend.live.protocol import token_query
from viewmend.studio.stage import Studio, StudioConfig

TOKEN = "a token for the benchmark"
SIZE, CAMERAS, FRAMES = 160, 6, 24
ALLOWED_GROWTH = 0.05
SAMPLE_S = 10.0


class Soak:
    """All clients of the test."""

    def __init__(self, url: str, minutes: float) -> None:
        self.url = url
        self.studio = Studio(StudioConfig(seed=10008, cameras=CAMERAS, frames=FRAMES, size_px=SIZE))
        self.studio_frames = [self.studio.read(t) for t in range(FRAMES)]
        self.ends = time.monotonic() + 60 * minutes
        self.counts: Counter[str] = Counter()
        self.faults: list[str] = []

    @property
    def over(self) -> bool:
        return time.monotonic() > self.ends

    def push(self) -> None:
        """A rig that disconnects abruptly after 3 to 30 seconds."""
        studio, frames = self.studio, self.studio_frames
        chance = random.Random(1)
        while not self.over:
            with contextlib.suppress(ConnectionError, OSError, TimeoutError):
                rig = Publisher(studio.cameras, self.url, token=TOKEN, up=studio.up, bounds=studio.bounds)
                until = time.monotonic() + chance.uniform(3, 30)
                number = 0
                while time.monotonic() < until and not self.over:
                    rig.push(frames[number % FRAMES])
                    number += 1
                    self.counts["pushed"] += 1
                    time.sleep(1 / 10)
                rig._socket._socket.socket.close()
                self.counts["rigs"] += 1
            time.sleep(chance.uniform(0.5, 3))

    def watch(self, seat: int) -> None:
        """A viewer that comes and goes, sometimes abruptly."""
        chance = random.Random(100 + seat)
        while not self.over:
            with contextlib.suppress(ConnectionError, OSError, TimeoutError):
                viewer = Client(self.url, TOKEN, timeout_s=20.0).__enter__()
                until = time.monotonic() + chance.uniform(2, 40)
                while time.monotonic() < until and not self.over:
                    self._look(viewer, seat, chance)
                if chance.random() < 0.5:
                    viewer._socket._socket.socket.close()
                else:
                    viewer.__exit__()
                self.counts["visits"] += 1
            time.sleep(chance.uniform(0, 2))

    def _look(self, viewer: Client, seat: int, chance: random.Random) -> None:
        """Request a view; each viewer has its own height, by which frames of others are recognised."""
        if chance.random() < 0.1:
            wish = [{"playing": False}, {"live": True}, {"seek": chance.randrange(500)}, {"speed": 2.0}]
            viewer.send("clock", **chance.choice(wish))
        height_m = 0.1 * seat
        camera = {"azimuth": chance.uniform(0, 360), "target": [0.0, 0.9 + height_m, 0.0], "distance": 3.0}
        asked = time.monotonic()
        look = viewer.look(camera=camera, width=96 + 16 * seat, height=96, adaptive=False, depth=True)
        while time.monotonic() - asked < 15:
            frame = viewer.frame()
            self.counts["frames"] += 1
            R, T = frame.header["cameras"][0]["R"], frame.header["cameras"][0]["T"]
            eye_height = -sum(R[3 * n + 1] * T[n] for n in range(3))
            if abs(eye_height - 0.9 - height_m) > 1e-3 or frame.header["look"] > look:
                self.faults.append(f"viewer {seat} received a frame from {eye_height:.3f} m")
            if frame.header["look"] == look:
                return

    def send_malformed(self) -> None:
        """Send malformed messages until the server closes the connection."""
        chance = random.Random(7)
        whole = json.dumps({"type": "look", "id": 1, "camera": {"azimuth": 3}, "modes": ["completed"]})
        while not self.over:
            with (
                contextlib.suppress(ConnectionClosed, OSError, TimeoutError),
                connect(f"{self.url}/ws{token_query(TOKEN)}", compression=None) as socket,
            ):
                socket.send(json.dumps({"type": "hello", "version": 1, "codecs": []}))
                for _ in range(40):
                    cut = whole[: chance.randrange(len(whole))]
                    socket.send(chance.choice([chance.randbytes(40), cut, '{"type": "look", "width": -1}']))
                    self.counts["malformed"] += 1
            time.sleep(0.5)

    def export_paths(self) -> None:
        """Export paths, and abandon half of them."""
        chance = random.Random(8)
        url = self.url.replace("ws", "http", 1)
        while not self.over:
            poses = [{"azimuth": chance.uniform(0, 360)} for _ in range(12)]
            body = json.dumps({"poses": poses, "width": 128, "height": 128}).encode()
            asked = urllib.request.Request(f"{url}/path.mp4{token_query(TOKEN)}", body)
            leaves = chance.random() < 0.5
            try:
                with urllib.request.urlopen(
                    asked, timeout=chance.uniform(0.2, 1.5) if leaves else 60
                ) as answer:
                    self.counts["exports"] += answer.read()[4:8] == b"ftyp"
            except (TimeoutError, OSError):
                self.counts["exports_abandoned"] += 1
            time.sleep(chance.uniform(1, 4))

    def attack(self) -> None:
        """Forty unauthenticated clients of one kind after another, twenty seconds each."""
        port = int(self.url.rsplit(":", 1)[1])
        while not self.over:
            for kind in KINDS:
                seconds = min(20.0, max(0.1, self.ends - time.monotonic()))
                self.counts["unauthenticated"] += int(begin(port, 40, seconds, [kind]).communicate()[0])


def memory_mb(process: int) -> float:
    """Resident memory."""
    status = Path(f"/proc/{process}/status").read_text()
    found = re.search(r"VmRSS:\s+(\d+)", status)
    return int(found[1]) / 1024 if found else 0.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--viewers", type=int, default=4)
    parser.add_argument("--memory-mb", type=float, default=400.0, help="memory of the server's stores")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    command = [sys.executable, "-m", "viewmend", "serve", "live", "--port", "0"]
    command += ["--memory-mb", str(options.memory_mb), "--viewers", str(options.viewers + 4)]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env=os.environ | {"VIEWMEND_TOKEN": TOKEN}
    ) as server:
        assert server.stderr is not None
        address = re.search(r"http://[\d.:]+", server.stderr.readline())
        assert address is not None, "the server does not start"
        said: list[str] = []
        threading.Thread(target=lambda: said.extend(server.stderr or []), daemon=True).start()
        soak = Soak(address[0].replace("http", "ws"), options.minutes)
        works = [
            soak.push,
            soak.send_malformed,
            soak.export_paths,
            soak.attack,
            *(lambda n=n: soak.watch(n) for n in range(options.viewers)),
        ]
        threads = [threading.Thread(target=work, daemon=True) for work in works]
        for thread in threads:
            thread.start()
        memory: list[float] = []
        paused_s = 0.0
        while not soak.over and server.poll() is None:
            slept = time.monotonic()
            time.sleep(SAMPLE_S)
            late_s = time.monotonic() - slept - SAMPLE_S
            if late_s > 1:
                paused_s, soak.ends = paused_s + late_s, soak.ends + late_s
            memory.append(round(memory_mb(server.pid), 1))
            print(
                round(soak.ends - time.monotonic()),
                "s left:",
                memory[-1],
                "MB",
                dict(soak.counts),
                flush=True,
            )
        alive = server.poll() is None
        for thread in threads:
            thread.join(20)
        with urllib.request.urlopen(f"{address[0]}/metrics{token_query(TOKEN)}", timeout=10) as answer:
            alive = alive and answer.status == 200
        server.send_signal(signal.SIGINT)
        server.wait(30)
    fifth = max(1, len(memory) // 5)
    early, late = (
        statistics.median(part or [0.0]) for part in (memory[fifth : 3 * fifth], memory[3 * fifth :])
    )
    growth = late / early - 1 if early else 0.0
    results = {
        "minutes": options.minutes,
        "viewers": options.viewers,
        **soak.counts,
        "wrong_frames": len(soak.faults),
        "paused_s": round(paused_s),
        "memory_mb": memory[:: max(1, len(memory) // 60)],
        "early_mb": early,
        "late_mb": late,
        "most_mb": max(memory, default=0.0),
        "growth": round(growth, 4),
        "alive": alive,
        "warnings": len(said),
    }
    print(json.dumps(results), *soak.faults[:5], *said[:5], sep="\n")
    if options.write:
        config = {"size": SIZE, "cameras": CAMERAS, "memory_mb": options.memory_mb, "model": "views"}
        print(write("soak", "cpu", config, results))
    return 0 if alive and not soak.faults and growth <= ALLOWED_GROWTH else 1


if __name__ == "__main__":
    sys.exit(main())
