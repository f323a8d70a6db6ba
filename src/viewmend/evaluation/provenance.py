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
    """Commit of the code, with "+" if files differed from it; "unknown" if no commit has the code."""
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
    # An environment may lie in another project's repository, which does not track the package.
    head = _git("ls-files", "--", Path(__file__).name) and _git("rev-parse", "--short", "HEAD")
    load = round(os.getloadavg()[0], 1)
    changed = head and _git("status", "--porcelain", "--untracked-files=no", "--", ".")
    commit = f"{head}{'+' if changed else ''}" or "unknown"
    python = platform.python_version()
    return Provenance(__version__, commit, python, torch.__version__, name, threads, jobs, load)


def _processor() -> str:
    file = Path("/proc/cpuinfo")
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    folder = Path(__file__).parent
    try:
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        return ""
