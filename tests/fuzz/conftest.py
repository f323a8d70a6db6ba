"""Prints statistics at the end; VIEWMEND_FUZZ_REPORT=FILE writes them as JSON."""

import json
import os
from dataclasses import asdict
from pathlib import Path

from fuzz.inputs import STATISTICS


def pytest_terminal_summary(terminalreporter):
    if not STATISTICS:
        return
    terminalreporter.write_line("\nparser                              inputs   read   worst s   worst MB   failures")
    for name, found in STATISTICS.items():
        terminalreporter.write_line(
            f"{name.removeprefix('test_')[:34]:34} {found.inputs:7} {found.read:6} {found.worst_s:9.2f} "
            f"{found.worst_mb:10.0f} {found.failures:10}"
        )
    if file := os.environ.get("VIEWMEND_FUZZ_REPORT"):
        report = {name: {k: round(v, 2) for k, v in asdict(found).items()} for name, found in STATISTICS.items()}
        Path(file).write_text(json.dumps(report, indent=1) + "\n")
