"""Says at the end how much was tried; VIEWMEND_FUZZ_REPORT=FILE writes it as JSON."""

import json
import os
from dataclasses import asdict
from pathlib import Path

from fuzz.inputs import TRIED


def pytest_terminal_summary(terminalreporter):
    if not TRIED:
        return
    terminalreporter.write_line("\nparser                              inputs   read   worst s   worst MB   failures")
    for name, tried in TRIED.items():
        terminalreporter.write_line(
            f"{name.removeprefix('test_')[:34]:34} {tried.inputs:7} {tried.read:6} {tried.worst_s:9.2f} "
            f"{tried.worst_mb:10.0f} {tried.failures:10}"
        )
    if file := os.environ.get("VIEWMEND_FUZZ_REPORT"):
        report = {name: {k: round(v, 2) for k, v in asdict(tried).items()} for name, tried in TRIED.items()}
        Path(file).write_text(json.dumps(report, indent=1) + "\n")
