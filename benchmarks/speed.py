"""Time views on a free machine and next to busy processes: python benchmarks/speed.py [--busy 0 2 4] [--write].

A stream of eight cameras completes one view again and again, as a viewer that stands still receives it: rendering,
crop and model, with what belongs to a frame computed before. Each model and size is a process of its own, which
inherits the settings of a fresh start. Times are medians in milliseconds. With --starts N, N fresh processes complete
the same view, every second one of them next to busy processes, and the number of different pictures is printed: 1 is
right.

--models also takes `hull` and `fused`, the geometry of a frame of eight cameras, and `training`, a step of the recipe
`views`, without the time for making samples, whatever the size.
"""

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from measure import summarise, timed, write

if TYPE_CHECKING:
    from viewmend.training.run_files import Progress

SEED = 10008
"""Seed of the performer, one of the test scenes."""
CAMERAS = 8
SHOWN = 13
"""Frame that is shown."""
WINDOW = (0, 10, 20, 27, 28, 29, 30)
"""Frames that the stream holds for `paper-small`, whose whole window they are; the last is shown."""
SIZES = ("320x320", "512x612", "1080x1920")
MODELS = ("views", "rays", "paper-small")
WARM_UP_STEPS = 4
"""Training steps before those that are timed; the first three have fewer samples."""
BUSY_LOOP = "while True: pass"
"""What a busy process does, in Python."""


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--sizes", nargs="+", default=list(SIZES), help="WIDTHxHEIGHT of cameras and views")
    parser.add_argument("--busy", nargs="+", type=int, default=[0, 2], help="numbers of busy processes")
    parser.add_argument("--runs", type=int, default=20, help="views that are timed")
    parser.add_argument(
        "--starts", type=int, default=0, help="compare the pictures of this many fresh processes"
    )
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print(json.dumps(measure_any(options.models[0], options.sizes[0], options.runs)))
        return
    if options.starts:
        print(f"{count_pictures(options)} picture(s) from {options.starts} starts")
        return
    results: dict[str, object] = {}
    for model in options.models:
        for size in options.sizes:
            for count in options.busy:
                with busy(count):
                    found = start_worker(model, size, options.runs)
                results[f"{model}, {size}, {count} busy"] = found
                print(f"{model:12s} {size:10s} {count} busy: {found}", flush=True)
    if options.write:
        print(write("speed", "cpu", {"seed": SEED, "cameras": CAMERAS, "runs": options.runs}, results))


def start_worker(model: str, size: str, runs: int) -> dict[str, object]:
    """What a fresh process measures."""
    command = [sys.executable, __file__, "--worker", "--models", model, "--sizes", size, "--runs", str(runs)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def measure_any(model: str, size: str, runs: int) -> dict[str, object]:
    """What a process measures for one of --models."""
    if model == "training":
        return measure_training(runs)
    if model in ("hull", "fused"):
        return measure_geometry(model == "fused", size, runs)
    return measure_view(model, size, runs)


def measure_training(runs: int) -> dict[str, object]:
    """Times of a training step of the recipe `views`."""
    from viewmend.training.loop import train
    from viewmend.training.recipes import views

    config = replace(views(), steps=runs + WARM_UP_STEPS, validate_every=0)
    worked_s: list[float] = []

    def note(progress: "Progress") -> None:
        worked_s.append(progress.elapsed_s * (1 - progress.waiting))

    with TemporaryDirectory() as folder:
        train(config, Path(folder) / "run", report=note)
    timed_s = worked_s[WARM_UP_STEPS - 1 :]
    steps_ms = [1e3 * (after - before) for before, after in pairwise(timed_s)]
    return {**summarise(steps_ms), "samples": config.batch}


def measure_geometry(fused: bool, size: str, runs: int) -> dict[str, object]:
    """Times of a frame's geometry, from its images and masks."""
    from viewmend import Stream, StreamConfig, Studio, StudioConfig
    from viewmend.models.registry import make_method

    width, height = (int(side) for side in size.split("x"))
    studio = Studio(StudioConfig(seed=SEED, cameras=CAMERAS, frames=SHOWN + 1, size_px=(width, height)))
    frame = studio.read(SHOWN)
    model = make_method("views")
    config = StreamConfig(geometry="fused" if fused else "hull", memory_mb=None)
    return dict(timed(lambda: Stream(model, config, studio.bounds).add_frame(frame), runs))


def measure_view(model: str, size: str, runs: int) -> dict[str, object]:
    """Times of a view, its refined pixels, and a hash of its picture."""
    from viewmend import Stream, StreamConfig, Studio, StudioConfig, orbit
    from viewmend.models.registry import make_method

    width, height = (int(side) for side in size.split("x"))
    times = WINDOW if model == "paper-small" else (SHOWN,)
    config = StudioConfig(seed=SEED, cameras=CAMERAS, frames=times[-1] + 1, size_px=(width, height))
    studio = Studio(config)
    stream = Stream(make_method(model), StreamConfig(memory_mb=None), studio.bounds)
    for time in times:
        stream.add_frame(studio.read(time))
    target = orbit([0.4], (width, height), elevation_rad=0.25)
    completed = stream.view(target).completed
    return {
        **timed(lambda: stream.view(target), runs),
        "refined_px": int((completed.view.refine_mask & (completed.view.mask > 0)).sum()),
        "picture": hashlib.sha256(completed.rgb.numpy().tobytes()).hexdigest()[:12],
    }


def count_pictures(options: argparse.Namespace) -> int:
    """The number of different pictures from fresh processes, every second one next to busy ones."""
    pictures = set()
    for number in range(options.starts):
        with busy(max(options.busy) if number % 2 else 0):
            pictures.add(start_worker(options.models[0], options.sizes[0], 1)["picture"])
    return len(pictures)


@contextmanager
def busy(count: int) -> Iterator[Sequence[subprocess.Popen[bytes]]]:
    """Processes that never rest, until the end of the block."""
    processes = [subprocess.Popen([sys.executable, "-c", BUSY_LOOP]) for _ in range(count)]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
