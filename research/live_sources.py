"""Eight simulated live cameras: python research/live_sources.py [--fps 15 7.5] [--write].

Each camera is a process (live_senders.py) that sends a studio video in real time: MPEG-TS over UDP and HTTP, JPEG over
HTTP, RTSP. Cameras are up to a fifth of a frame apart, and their clocks have arbitrary starts and are off by up to 100
ppm. A rig as in `viewmend serve rig.toml` reads them, makes masks from clean plates and synchronises them. Every few
seconds a camera is killed (SIGKILL) and restarted two seconds later. The number in each image tells when it was taken.
With --files the videos themselves are the cameras.

Exits with 1 unless frames are aligned to better than half a frame, each camera is back within two seconds after its
first image was sent, and memory is flat: the median of the last fifth at most 5 % above that of the second fifth.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import benchmarks_path  # noqa: F401
import cv2
from live_senders import FPS, FRAMES, SIZE_PX, make, number_of
from measure import summarise, write

from viewmend.contrib.live_rig.rig_source import RigFileSource
from viewmend.data.images import read_rgb
from viewmend.utils.heap import configure_allocator, resident_bytes

KINDS = ("udp", "udp", "udp", "udp", "http", "http", "mjpeg", "rtsp")
PORT = 47_100
FIRST_S, AWAY_S, EVERY_S, SETTLED_S = 120.0, 2.0, 3.0, 5.0
MEMORY_MB = 100.0
LOOP_S = FRAMES / FPS


class Senders:
    """The camera processes."""

    def __init__(self, videos: Path, kinds: tuple[str, ...]) -> None:
        self.videos, self.kinds = videos, kinds
        self.names = [f"cam{n:02d}" for n in range(len(kinds))]
        self.epoch_s = time.monotonic() - 1000.0
        self.phases_s = {name: (n / (len(kinds) - 1) - 0.5) * 0.4 / FPS for n, name in enumerate(self.names)}
        self._processes: dict[str, subprocess.Popen[str]] = {}

    def start(self, name: str) -> None:
        n = self.names.index(name)
        ppm = 200 * (n / (len(self.names) - 1) - 0.5)
        command = [sys.executable, str(Path(__file__).parent / "live_senders.py"), self.kinds[n]]
        command += [
            str(self.videos / f"{name}.mp4"),
            str(PORT + n),
            f"{self.epoch_s}",
            f"{self.phases_s[name]}",
            f"{ppm}",
        ]
        self._processes[name] = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )

    def first_sent_s(self, name: str) -> float:
        """Time at which the camera sent its first image."""
        output = self._processes[name].stdout
        assert output is not None
        return float(output.readline() or "nan")

    def kill(self, name: str) -> None:
        self._processes[name].kill()
        self._processes[name].wait()

    def stop(self) -> None:
        for process in self._processes.values():
            process.kill()
            process.wait()


def rig_file(folder: Path, videos: Path, kinds: tuple[str, ...] | None, fps: float, scale: float) -> Path:
    """Write the rig file."""
    lines = [f'calibration = "{videos}/calibration"', f"fps = {fps}", "[mask]", 'method = "plate"']
    lines += [f"scale = {scale}"]
    lines += [f'plates = "{videos}/plates/{{camera}}.png"']
    for n in range(len(KINDS)):
        port = PORT + n
        urls = {"udp": f"udp://127.0.0.1:{port}", "rtsp": f"rtsp://127.0.0.1:{port}/live"}
        url = f"{videos}/cam{n:02d}.mp4" if kinds is None else urls.get(kinds[n], f"http://127.0.0.1:{port}/")
        lines += ["[[cameras]]", f'name = "cam{n:02d}"', f'url = "{url}"']
        if (
            kinds is not None and kinds[n] == "rtsp"
        ):  # the sender connects to the receiver: there is no RTSP server here
            lines += ['options = {rtsp_flags = "listen", listen_timeout = "5"}']
    path = folder / "rig.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


class Watch:
    """Records the image numbers of every synchronised frame."""

    def __init__(self, frames: RigFileSource, senders: Senders, videos: Path) -> None:
        self._frames, self._senders = frames, senders
        self._plates = {name: read_rgb(videos / f"plates/{name}.png", name) for name in senders.names}
        self._next = 0
        self.seen: list[tuple[float, dict[str, int]]] = []
        """Arrival time of each frame, and the number of each camera's image."""
        self.ious: list[float] = []
        self._lock = threading.Lock()
        frames.changed = self.look

    def look(self) -> None:
        with self._lock:
            now_s = time.monotonic()
            while self._next < self._frames.span.end:
                frame = self._frames.read(self._next)
                self._next += 1
                if frame is not None:
                    rgb = frame.rgb.permute(0, 2, 3, 1).numpy()
                    names = frame.cameras.names
                    self.seen.append(
                        (now_s, {n: number_of(rgb[v], self._plates[n]) for v, n in enumerate(names)})
                    )

    def spreads_s(self) -> list[tuple[float, float, float]]:
        """For each frame: arrival time, seconds between its first and last image, and the age of the oldest."""
        out = []
        for now_s, numbers in list(self.seen):
            # Numbers repeat every two seconds: unwrap them around the first camera's.
            taken_s = [number / FPS + self._senders.phases_s[name] for name, number in numbers.items()]
            near_s = [(t - taken_s[0] + LOOP_S / 2) % LOOP_S - LOOP_S / 2 for t in taken_s]
            age_s = (now_s - self._senders.epoch_s - taken_s[0]) % LOOP_S
            out.append((now_s, max(near_s) - min(near_s), age_s - min(near_s)))
        return out

    def strays(self) -> dict[str, int]:
        """How often each camera was at least half a frame away from the median."""
        out: Counter[str] = Counter()
        for _, numbers in list(self.seen):
            taken_s = {name: number / FPS + self._senders.phases_s[name] for name, number in numbers.items()}
            first_s = next(iter(taken_s.values()))
            near_s = {name: (t - first_s + LOOP_S / 2) % LOOP_S for name, t in taken_s.items()}
            middle_s = statistics.median(near_s.values())
            out.update(name for name, t in near_s.items() if abs(t - middle_s) >= 0.5 / FPS)
        return dict(out)

    def back_s(self, name: str, since_s: float) -> float | None:
        """When a camera first appeared again."""
        return next(
            (now_s for now_s, numbers in list(self.seen) if now_s > since_s and name in numbers), None
        )


def run(options: argparse.Namespace, fps: float, videos: Path, folder: Path) -> dict[str, object]:
    kinds = None if options.files else KINDS
    senders = Senders(videos, KINDS)
    if options.files:
        senders.phases_s = dict.fromkeys(senders.names, 0.0)
    frames = RigFileSource(rig_file(folder, videos, kinds, fps, options.scale), memory_mb=MEMORY_MB)
    watch = Watch(frames, senders, videos)
    if kinds is not None:
        for name in senders.names:
            senders.start(name)
    frames.start()
    memory_mb, returns, began_s = [], [], time.monotonic()
    try:
        while not watch.seen and time.monotonic() < began_s + FIRST_S:
            time.sleep(0.1)
        print(f"the first frame came after {time.monotonic() - began_s:.1f} s", flush=True)
        used_s, began_s = time.process_time(), time.monotonic()
        ends_s, next_s, victim = began_s + options.seconds, began_s + SETTLED_S, 0
        while time.monotonic() < ends_s:
            time.sleep(0.5)
            memory_mb.append(round((resident_bytes() or 0) / 1e6, 1))
            if (
                kinds is not None
                and not options.no_kill
                and next_s < time.monotonic() < ends_s - AWAY_S - EVERY_S
            ):
                name = senders.names[victim % len(KINDS)]
                senders.kill(name)
                killed_s = time.monotonic()
                time.sleep(AWAY_S)
                senders.start(name)
                sent_s = senders.first_sent_s(name)
                while watch.back_s(name, sent_s) is None and time.monotonic() < sent_s + EVERY_S:
                    time.sleep(0.02)
                back_s = watch.back_s(name, sent_s)
                between = [names for now_s, names in watch.seen if killed_s + 0.5 < now_s < sent_s]
                returns.append({"camera": name, "kind": KINDS[victim % len(KINDS)]})
                returns[-1]["back_s"] = None if back_s is None else round(back_s - sent_s, 2)
                returns[-1]["frames_meanwhile"] = len(between)
                print(returns[-1], f"{memory_mb[-1]} MB", flush=True)
                victim, next_s = victim + 1, time.monotonic() + EVERY_S
        lasted_s = time.monotonic() - began_s
        used_s = time.process_time() - used_s
        counts = frames.camera_counts()
        if options.picture:
            picture(frames, options.picture)
    finally:
        frames.stop()
        senders.stop()
    done = results(watch, memory_mb, returns, counts)
    return done | {"cores": round(used_s / lasted_s, 2), "load_average": round(os.getloadavg()[0], 1)}


def results(watch: Watch, memory_mb: list[float], returns: list[dict], counts: dict) -> dict[str, object]:
    spreads = watch.spreads_s()
    first_s = spreads[0][0]
    settled = [row for row in spreads if row[0] > first_s + 2]
    span_s = settled[-1][0] - settled[0][0]
    fifth = max(1, len(memory_mb) // 5)
    early, late = (statistics.median(part) for part in (memory_mb[fifth : 2 * fifth], memory_mb[-fifth:]))
    half = 1000 * 0.5 / FPS
    spread_ms = [1000 * spread_s for _, spread_s, _ in settled]
    third = len(spread_ms) // 3
    totals: Counter[str] = Counter()
    for each in counts.values():
        totals.update({key: n for key, n in each.items() if key != "up"})
    return {
        "frames_a_second": round(len(settled) / span_s, 2),
        "cameras_a_frame": round(statistics.mean(len(n) for _, n in watch.seen), 2),
        "spread_ms": summarise(spread_ms) | {"max_ms": round(max(spread_ms), 2)},
        "spread_first_third_ms": summarise(spread_ms[:third]),
        "spread_last_third_ms": summarise(spread_ms[-third:]),
        "beyond_half_a_frame": round(sum(ms > half for ms in spread_ms) / len(spread_ms), 4),
        "age_ms": summarise([1000 * age_s for _, _, age_s in settled]),
        "memory_mb": {
            "early": early,
            "late": late,
            "most": max(memory_mb),
            "growth": round(late / early - 1, 4),
        },
        "returns": returns,
        "slowest_return_s": max((r["back_s"] or 99.0 for r in returns), default=None),
        "strays": watch.strays(),
        "pictures": dict(totals),
    }


def picture(frames: RigFileSource, path: Path) -> None:
    """Draw the newest frame with mask outlines."""
    frame = frames.read(frames.span.newest)
    assert frame is not None and frame.mask is not None
    tiles = []
    for rgb, mask in zip(frame.rgb.permute(0, 2, 3, 1).numpy(), frame.mask.numpy(), strict=True):
        tile = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        outlines = cv2.findContours((mask > 127).astype("uint8"), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        tiles.append(cv2.drawContours(tile, outlines, -1, (0, 0, 255), 2))
    half = (len(tiles) + 1) // 2
    tiles += [0 * tiles[0]] * (2 * half - len(tiles))
    cv2.imwrite(str(path), cv2.vconcat([cv2.hconcat(tiles[:half]), cv2.hconcat(tiles[half:])]))


def is_good(done: dict) -> bool:
    slowest_s = done["slowest_return_s"]
    good = done["beyond_half_a_frame"] == 0 and done["memory_mb"]["growth"] <= 0.05
    return good and (slowest_s is None or slowest_s <= 2)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--fps", type=float, nargs="+", default=[15.0], help="rates of the rig; cameras always send 15"
    )
    parser.add_argument("--scale", type=float, default=0.5, help="scale at which masks are computed")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--videos", type=Path, help="folder to keep the videos in")
    parser.add_argument(
        "--files", action="store_true", help="read the videos as if they were live, without a network"
    )
    parser.add_argument("--no-kill", action="store_true")
    parser.add_argument("--picture", type=Path, help="write the last frame and its masks")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    configure_allocator()
    with tempfile.TemporaryDirectory() as temporary:
        videos = (options.videos or Path(temporary) / "videos").resolve()
        make(videos, len(KINDS))
        done = {f"{fps:g} fps": run(options, fps, videos, Path(temporary)) for fps in options.fps}
    print(json.dumps(done, indent=1))
    if options.write:
        config = {"cameras": len(KINDS), "size": SIZE_PX, "kinds": "files" if options.files else KINDS}
        config |= {
            "cameras_fps": FPS,
            "mask_scale": options.scale,
            "seconds": options.seconds,
            "nice": os.nice(0),
        }
        print(write(f"live_sources{'_files' if options.files else ''}", "cpu", config, done))
    return 0 if all(map(is_good, done.values())) else 1


if __name__ == "__main__":
    sys.exit(main())
