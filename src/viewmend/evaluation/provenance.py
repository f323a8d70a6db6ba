"""Where figures come from: machine, versions, commit."""

import os
import platform
import subprocess
from dataclasses import dataclass
from pathlib import Path

import torch

from viewmend import __version__


@dataclass(frozen=True)
class Provenance:
    """What figures depend on besides their definition."""

    viewmend: str
    commit: str
    """Commit of the code, with "+" if files differed from it; "unknown" outside a checkout."""
    python: str
    torch: str
    device: str
    """The processor's or the GPU's name."""
    threads: int
    """Threads of torch in each process."""
    jobs: int
    """Processes at work at the same time, which slow each other down."""
    load: float
    """Load of the machine, a minute's average at the start: other work slows this one down, too."""


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
    def git(*words: str) -> str:
        command = ["git", *words]
        try:
            done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
        except OSError:
            return ""
        return done.stdout.strip()

    head = git("rev-parse", "--short", "HEAD")
    return (
        head + ("+" if git("status", "--porcelain", "--untracked-files=no", "--", ".") else "") if head else "unknown"
    )
