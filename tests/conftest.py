"""Fixtures and skips that all tests share."""

import gc
from collections import Counter
from pathlib import Path

import pytest
import torch
from reference.shared_scenes import make_once, write_balls, write_takes

# Tests are many small computations: a second thread costs more than it brings.
torch.set_num_threads(1)
# What is imported and collected stays until the end; searching it for garbage takes seconds.
gc.disable()
# A training with workers thaws what was frozen after collection; each later search of it would take 0.4 s.
gc.unfreeze = lambda: None

SHARED = Path(__file__).resolve().parents[2] / "shared"
SKIPPED: Counter[str] = Counter()
"""How many tests were skipped, by reason."""


def pytest_runtest_logreport(report):
    if report.skipped and isinstance(report.longrepr, tuple):
        SKIPPED[str(report.longrepr[2]).removeprefix("Skipped: ")] += 1


def pytest_collectreport(report):
    if report.skipped and isinstance(report.longrepr, tuple):
        SKIPPED[f"{Path(report.nodeid).name}: {str(report.longrepr[2]).removeprefix('Skipped: ')}"] += 1


def pytest_unconfigure(config):
    """Print what was skipped and why, as the last line."""
    if not config.option.collectonly:
        reasons = "; ".join(f"{count} ({reason})" for reason, count in SKIPPED.most_common())
        print(f"Skipped: {reasons or 'nothing'}.")


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items):
    if torch.cuda.is_available():
        return
    skip = pytest.mark.skip(reason="no CUDA device")
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(skip)


@pytest.fixture
def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def no_weights(tmp_path, monkeypatch) -> None:
    """No published weights, whatever this machine has."""
    for name in ("VIEWMEND_WEIGHTS", "XDG_CACHE_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "nowhere"))


@pytest.fixture
def with_ray() -> None:
    """Skips a test without Ray. `import ray` would not tell: it may find the folder tests/contrib/ray."""
    pytest.importorskip("ray.exceptions", reason="needs the extra: pip install 'viewmend[ray]'")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The developers' folder of real captures and performers; tests that need it are skipped where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"the developers' folder {SHARED.name}/ is not next to the repository")
    return SHARED


@pytest.fixture(scope="session")
def takes(tmp_path_factory) -> Path:
    """A folder with the captures of `reference.shared_scenes.write_takes`; leave them as they are."""
    return make_once(tmp_path_factory, "takes", write_takes)


@pytest.fixture(scope="session")
def balls(tmp_path_factory) -> Path:
    """A folder with the captures of `reference.shared_scenes.write_balls`; leave them as they are."""
    return make_once(tmp_path_factory, "balls", write_balls)
