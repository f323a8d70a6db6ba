"""Everything only a GPU can answer: python research/gpu_first_hour.py [--out DIR].

In ten minutes and in this order, each step in a process of its own so that a failure or hang costs nothing else:

1. the tests marked gpu;
2. parity: views of a procedural scene by each shipped model, on the CPU and on the device;
3. timings: geometry and live;
4. a profile of a view: where the device's time goes, and how often a view waits for it;
5. training for the rest of the time: windows by all CPU cores, then an autoencoder and the recipe, first of
   `paper-small`, then of `paper`. A second run with the same DIR goes on where each of them stopped.

Writes DIR/gpu_first_hour.json after each step (exit codes, seconds, figures, last lines), DIR/windows, a folder of each
run, and DIR/pieces: the weights and checkpoints of all runs in files of at most 16 MiB, to be joined by `cat`.
`--device cpu --minutes 3` tries the script itself. Exits with 1 if a step failed.
"""

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import benchmarks_path  # noqa: F401
import torch
from measure import machine, synchronise

from viewmend import Stream
from viewmend.evaluation.paper_tables import training_of
from viewmend.models.checkpoint import load_inpainter
from viewmend.stream import StreamConfig
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.utils.atomic_writes import write_text

HERE = Path(__file__).parent
MODELS = ("views", "rays", "paper-small")
TIMINGS = ("geometry", "live")
SEED, SIZE_PX, CAMERAS = 10011, 320, 8
LARGEST_DB_BELOW = 50.0
"""Minimum PSNR between the device's image and the CPU's."""
GRACE_S = 60.0
"""Seconds that a step has to end after its time is over."""
PIECE_BYTES = 16 * 2**20
SHARES = {"windows": 0.2, "autoencoder-small": 0.08, "paper-small": 0.27, "autoencoder": 0.1, "paper": 0.35}
"""Fractions of the time for training."""
OUT_OF_TIME = "out of time"
"""The code of a step that had to be ended."""
SAID = 3000
"""Characters of a step's output that are kept."""


def views(model: str, device: str, frames: int) -> list[torch.Tensor]:
    """Images of a procedural scene from a fixed viewpoint, on the CPU."""
    studio = Studio(StudioConfig(seed=SEED, cameras=CAMERAS, frames=frames, size_px=SIZE_PX))
    stream = Stream(load_inpainter(model, device), StreamConfig(), bounds=studio.bounds)
    target, viewer, pictures = orbit([0.4], (SIZE_PX, SIZE_PX), elevation_rad=0.25).to(device), None, []
    for now in range(frames):
        stream.add_frame(studio.read(now).to(device))
        mended = stream.view(target, viewer)
        viewer = mended.viewer
        pictures.append(mended.completed.rgb.cpu())
    return pictures


def parity(device: str) -> dict[str, object]:
    """Lowest PSNR of the device's images against the CPU's, for each model."""
    figures = {}
    for model in MODELS:
        pairs = zip(views(model, "cpu", 3), views(model, device, 3), strict=True)
        squares = [float((one - other).square().mean()) for one, other in pairs]
        figures[model] = round(
            min(99.0, *(-10 * torch.tensor(max(s, 1e-12)).log10().item() for s in squares)), 1
        )
    if worst := [model for model, db in figures.items() if db < LARGEST_DB_BELOW]:
        raise SystemExit(
            f"{json.dumps(figures)}\nexpected {LARGEST_DB_BELOW} dB or more between devices, got {worst}"
        )
    return figures


def profile(device: str) -> dict[str, object]:
    """For each model: the operations that take longest, and how often the CPU waits for the device."""
    activities = [torch.profiler.ProfilerActivity.CPU]
    if device.startswith("cuda"):
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    figures = {}
    for model in MODELS:
        studio = Studio(StudioConfig(seed=SEED, cameras=CAMERAS, frames=1, size_px=SIZE_PX))
        stream = Stream(load_inpainter(model, device), StreamConfig(), bounds=studio.bounds)
        stream.add_frame(studio.read(0).to(device))
        target = orbit([0.4], (SIZE_PX, SIZE_PX), elevation_rad=0.25).to(device)
        viewer = None
        for _ in range(3):
            viewer = stream.view(target, viewer).viewer
        synchronise(device)
        with torch.profiler.profile(activities=activities) as took:
            stream.view(target, viewer)
            synchronise(device)
        rows = took.key_averages()
        own = sorted(rows, key=lambda row: -max(row.self_device_time_total, row.self_cpu_time_total))
        waits = {row.key: row.count for row in rows if row.key in WAITS}
        longest = {
            row.key: [round(row.self_cpu_time_total), round(row.self_device_time_total)] for row in own[:20]
        }
        figures[model] = {"waits_a_view": waits, "longest_us_cpu_and_device": longest}
    return figures


WAITS = ("aten::item", "aten::nonzero", "cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaMemcpyAsync")
STEPS = {"parity": parity, "profile": profile}


def commands(device: str) -> dict[str, list[str]]:
    """The steps before training."""
    own = [sys.executable, str(HERE / "gpu_first_hour.py"), "--device", device, "--step"]
    tests = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", str(HERE.parent / "tests")]
    timings = {
        name: [sys.executable, str(HERE.parent / "benchmarks" / f"{name}.py"), "--device", device]
        for name in TIMINGS
    }
    return {"tests": tests, "parity": [*own, "parity"], **timings, "profile": [*own, "profile"]}


def training(out: Path, minutes: float) -> dict[str, list[str]]:
    """The steps of training, which share `minutes`."""
    viewmend, windows = [sys.executable, "-m", "viewmend"], str(out / "windows")
    pretrain = [sys.executable, str(HERE / "pretrain_paper.py")]

    def learn(name: str, command: list[str], *options: str) -> list[str]:
        before = training_of(out / name)
        total = SHARES[name] * minutes + (before.minutes if before else 0)
        return [
            *command,
            "--shards",
            windows,
            "--out",
            str(out / name),
            "--minutes",
            f"{total:.2f}",
            *options,
        ]

    workers = ("--workers", str(os.cpu_count() or 1), "--count", "100000")
    return {
        "windows": [*viewmend, "make-dataset", "paper-small", *workers, "--out", windows],
        "autoencoder-small": learn("autoencoder-small", pretrain),
        "paper-small": learn(
            "paper-small", [*viewmend, "train", "paper-small"], "--from", str(out / "autoencoder-small")
        ),
        "autoencoder": learn("autoencoder", pretrain, "--size", "paper"),
        "paper": learn("paper", [*viewmend, "train", "paper"], "--from", str(out / "autoencoder")),
    }


def write_pieces(out: Path) -> None:
    """The weights and checkpoints of all runs, in pieces."""
    pieces = out / "pieces"
    pieces.mkdir(exist_ok=True)
    for path in sorted(out.glob("*/*.safetensors")):
        with path.open("rb") as file:
            for number, data in enumerate(iter(lambda: file.read(PIECE_BYTES), b"")):
                (pieces / f"{path.parent.name}--{path.name}.{number:03d}").write_bytes(data)


def run(command: list[str], limit_s: float) -> dict[str, object]:
    """Run a process; after `limit_s` it receives SIGTERM, so that training writes a checkpoint."""
    began, pipe = time.monotonic(), subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True) as process:
        try:
            said, wrong = process.communicate(timeout=max(limit_s, 1.0))
            code: int | str = process.returncode
        except subprocess.TimeoutExpired:
            process.terminate()
            killer = threading.Timer(GRACE_S, os.killpg, (process.pid, signal.SIGKILL))
            killer.start()
            said, wrong = process.communicate()
            killer.cancel()
            code = OUT_OF_TIME
    result: dict[str, object] = {"code": code, "seconds": round(time.monotonic() - began, 1)}
    with contextlib.suppress(ValueError, IndexError):
        result["figures"] = json.loads(said.strip().splitlines()[-1])
    if "figures" not in result or code != 0:
        result |= {"stdout": said[-SAID:], "stderr": wrong[-SAID:]}
    return result


def failed(steps: dict[str, dict[str, object]]) -> list[str]:
    """The names of the steps that failed. `windows` makes as many as it can, so it always runs out of time."""
    accepted = {"windows": (0, OUT_OF_TIME), "tests": (0, 5)}  # pytest's 5: there are none
    return [name for name, step in steps.items() if step["code"] not in accepted.get(name, (0,))]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--minutes", type=float, default=10.0, help="total; training gets the rest")
    parser.add_argument("--out", type=Path, default=Path("out/gpu"))
    parser.add_argument("--skip", nargs="*", default=[], help="steps to leave out")
    parser.add_argument("--step", choices=sorted(STEPS), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.device.startswith("cuda") and not torch.cuda.is_available():
        parser.exit(2, "expected a GPU, found none; try the script itself with --device cpu\n")
    if given.step:
        print(json.dumps(STEPS[given.step](given.device)))
        return
    given.out.mkdir(parents=True, exist_ok=True)
    end, report = (
        time.monotonic() + 60 * given.minutes,
        {**machine(given.device), "minutes": given.minutes, "steps": {}},
    )

    def step(name: str, command: list[str], limit_s: float) -> None:
        report["steps"][name] = run(command, limit_s)
        write_text(given.out / "gpu_first_hour.json", json.dumps(report, indent=2) + "\n")
        print(name, report["steps"][name]["code"], f"{report['steps'][name]['seconds']} s", flush=True)

    for name, command in commands(given.device).items():
        if name not in given.skip:
            step(name, command, (end - time.monotonic()) / 2)
    left = (end - time.monotonic()) / 60
    for name, command in training(given.out, left).items() if left > 0 else ():
        if name not in given.skip:
            step(name, command, 60 * SHARES[name] * left + (0 if name == "windows" else GRACE_S))
            write_pieces(given.out)
    sys.exit(bool(failed(report["steps"])))


if __name__ == "__main__":
    main()
