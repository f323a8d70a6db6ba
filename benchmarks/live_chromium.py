"""Chromium for benchmarks of the page; the name or path of another one is in VIEWMEND_CHROMIUM."""

import contextlib
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PARENT = 1
"""Place of the parent's number in /proc/PID/stat, after the name."""
TIMES = (11, 12)
"""Places of the ticks in user and kernel mode, likewise."""
NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def processor_s() -> float:
    """Processor seconds that the browser has used so far: of all processes that descend from this one (Linux only)."""
    parents: dict[int, int] = {}
    taken: dict[int, float] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # the process has ended
            _, _, text = stat.read_text().rpartition(")")
            fields = text.split()
            number = int(stat.parent.name)
            parents[number] = int(fields[PARENT])
            taken[number] = sum(int(fields[n]) for n in TIMES) / os.sysconf("SC_CLK_TCK")
    own = os.getpid()
    descendants = {own}
    while more := {number for number, parent in parents.items() if parent in descendants} - descendants:
        descendants |= more
    return sum(taken[number] for number in descendants - {own})


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A running browser."""
    from playwright.sync_api import sync_playwright

    executable = os.environ.get("VIEWMEND_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if executable is None:
        sys.exit("expected Chromium, found none; install it, or name it in VIEWMEND_CHROMIUM")
    with sync_playwright() as control:
        browser = control.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        yield browser
        browser.close()
