"""Where measured figures come from: machine, versions, commit."""

import os
import platform
import subprocess
from dataclasses import dataclass
from pathlib import Path

import torch

from viewmend import __version__


@dataclass(frozen=True)
class Provenance:
    """What measured figures depend on besides their definition."""

    viewmend: str
    commit: str
    """Commit of the code, with "+" if files differed from it; "unknown" outside a checkout."""
    python: str
    torch: str
    device: str
    """Name of the processor or the GPU."""
    threads: int
    """Threads of torch in each process."""
    jobs: int
    """Number of processes running at once; they slow each other down."""
    load: float
    """One-minute load average of the machine at the start."""


def provenance(device: str, threads: int, jobs: int) -> Provenance:
    """The provenance of figures that are computed now."""
    name = torch.cuda.get_device_name(device) if device.startswith("cuda") else _processor()
    load = round(os.getloadavg()[0], 1)
    return Provenance(__version__, _commit(), platform.python_version(), torch.__version__, name, threads, jobs, load)


def _processor() -> str:
    file = Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.is_file() else []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def _commit() -> str:
    head = _git("rev-parse", "--short", "HEAD")
    changed = head and _git("status", "--porcelain", "--untracked-files=no", "--", ".")
    return head + ("+" if changed else "") if head else "unknown"


def _git(*arguments: str) -> str:
    folder = Path(__file__).parent
    try:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip()
