"""Timing (warm-up, synchronisation, median and 95th percentile) and result files, shared by all benchmarks."""

import itertools
import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path

import torch

RESULTS = Path(__file__).parent / "results"


def timed(
    work: Callable[[], object],
    runs: int = 30,
    warm_up: int = 3,
    device: str = "cpu",
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Milliseconds of `work()` over `runs` calls, after `warm_up` calls that are not counted.

    With `time.process_time` as the clock, they are processor time, which other programs hardly change.
    """
    taken = []
    for run in range(-warm_up, runs):
        synchronise(device)
        start = clock()
        work()
        synchronise(device)
        if run >= 0:
            taken.append(1e3 * (clock() - start))
    return summarise(taken)


def summarise(taken_ms: Sequence[float]) -> dict[str, float]:
    """Median, 95th percentile and minimum."""
    ordered = sorted(taken_ms)
    return {
        "median_ms": round(statistics.median(ordered), 2),
        "p95_ms": round(ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))], 2),
        "min_ms": round(ordered[0], 2),
    }


def machine(device: str) -> dict[str, object]:
    """The machine, its load, and the versions of Python, torch and this repository."""
    return {
        "device": torch.cuda.get_device_name(device) if device.startswith("cuda") else processor(),
        "threads": torch.get_num_threads(),
        "load_average": round(os.getloadavg()[0], 1),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "commit": _commit(),
    }


def write(what: str, device: str, config: object, results: object) -> Path:
    """Write the results to `result_file` with everything that the figures depend on; return its path."""
    path = result_file(what, device, config)
    today = date.today().isoformat()
    entry = {"what": what, "date": today, **machine(device), "config": config, "results": results}
    RESULTS.mkdir(exist_ok=True)
    path.write_text(json.dumps(entry, indent=2) + "\n")
    return path


def result_file(what: str, device: str, config: object) -> Path:
    """The file results/<what>--<device>--<date>.json, numbered from 2 on if results of another config have the name."""
    stem = f"{what}--{device.split(':')[0]}--{date.today().isoformat()}"
    names = itertools.chain([stem], (f"{stem}--{number}" for number in itertools.count(2)))
    paths = (RESULTS / f"{name}.json" for name in names)
    wanted = json.loads(json.dumps(config))
    return next(
        path for path in paths if not path.exists() or json.loads(path.read_text())["config"] == wanted
    )


def synchronise(device: str) -> None:
    """Wait for pending work on a GPU."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


def processor() -> str:
    """The CPU's name."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.is_file() else []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def _commit() -> str:
    command = ["git", "rev-parse", "--short", "HEAD"]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"
