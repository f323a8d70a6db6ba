"""Fixtures and skips that all tests share."""

from collections import Counter
from pathlib import Path

import pytest
import torch

# Tests are many small computations: a second thread costs more than it brings.
torch.set_num_threads(1)

SHARED = Path(__file__).resolve().parents[2] / "shared"


BROWSER = "tests/live/browser/"
PAGE: Counter[str] = Counter()
"""How the tests of the page ended, and why they were skipped."""


def pytest_runtest_logreport(report):
    if not report.nodeid.startswith(BROWSER) or (report.when != "call" and report.passed):
        return
    PAGE[report.outcome] += 1
    if report.skipped:
        PAGE[str(report.longrepr[2]).removeprefix("Skipped: ")] += 1


def pytest_unconfigure(config):
    """The last line says whether a browser has seen the page."""
    if not PAGE or config.option.collectonly:
        return
    ran = PAGE["passed"] + PAGE["failed"]
    why = "; ".join(reason for reason in PAGE if reason not in ("passed", "failed", "skipped"))
    print(f"The page: {ran} tests in Chromium." if ran else f"The page: NOT TESTED IN A BROWSER ({why}).")


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    skip = pytest.mark.skip(reason="no CUDA device")
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(skip)


@pytest.fixture
def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The developers' folder of real captures and performers; tests that need it are skipped where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"the developers' folder {SHARED.name}/ is not beside the repository")
    return SHARED
