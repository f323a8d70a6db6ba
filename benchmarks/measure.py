"""The one way to time: warm up, synchronise, take median and 95th percentile; and to write down what was measured."""

import json
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path

import torch

RESULTS = Path(__file__).parent / "results"


def timed(work: Callable[[], object], runs: int = 30, warm_up: int = 3, device: str = "cpu") -> dict[str, float]:
    """Milliseconds of `work()`: median and 95th percentile over `runs`, after `warm_up` runs that do not count."""
    spent = []
    for run in range(-warm_up, runs):
        _synchronise(device)
        start = time.perf_counter()
        work()
        _synchronise(device)
        if run >= 0:
            spent.append(1e3 * (time.perf_counter() - start))
    spent.sort()
    return {
        "median_ms": round(statistics.median(spent), 2),
        "p95_ms": round(spent[min(len(spent) - 1, int(0.95 * len(spent)))], 2),
        "min_ms": round(spent[0], 2),
    }


def record(what: str, device: str, config: object, figures: object) -> Path:
    """Write results/<what>--<device>--<date>.json with everything that a figure's value depends on."""
    name = torch.cuda.get_device_name() if device.startswith("cuda") else processor()
    entry = {
        "what": what,
        "device": name,
        "threads": torch.get_num_threads(),
        "date": date.today().isoformat(),
        "commit": _commit(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "config": config,
        "figures": figures,
    }
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{what}--{device.split(':')[0]}--{date.today().isoformat()}.json"
    path.write_text(json.dumps(entry, indent=2) + "\n")
    return path


def processor() -> str:
    """The CPU's name."""
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _synchronise(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def _commit() -> str:
    here = Path(__file__).parent
    done = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=here, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or "unknown"
