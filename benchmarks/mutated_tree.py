"""A broken copy of the tree, and the runs of its tests: what `mutate.py` stands on.

Each run of tests is a fork of a process that has imported the libraries.
"""

import contextlib
import os
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import coverage
import pytest

# Imported once, for all runs; viewmend itself never, so that each run imports it as it is then.
import cv2, einops, msgspec, numba, safetensors.torch, starlette, torch, tyro, uvicorn, websockets  # noqa: E401, F401  # isort: skip

ROOT = Path(__file__).resolve().parents[1]
IMPORTED = "-Wignore::pytest.PytestAssertRewriteWarning"
ALWAYS = ["-q", "-x", "-p", "no:cacheprovider", "--no-header", "--ignore=tests/live/browser", IMPORTED]
Change = Callable[[str], str | None]
PATIENCE = 20.0
"""How many times as long as its seconds of the processor a run may take by the clock."""


class Copy:
    """A copy of the tree, in which files are broken and mended again."""

    def __init__(self, work: Path) -> None:
        self.root = work / "tree"
        shutil.rmtree(self.root, ignore_errors=True)
        ignored = shutil.ignore_patterns(".git", "out", "node_modules", ".venv", ".hypothesis", ".pytest_cache")
        shutil.copytree(ROOT, self.root, symlinks=True, ignore=ignored)
        shared = ROOT.parent / "shared"
        if shared.is_dir() and not (work / "shared").exists():
            (work / "shared").symlink_to(shared)
        self._stamp = time.time()

    def with_bug(self, bug: str, change: Change, run: Callable[[], tuple[str, str]]) -> tuple[str, str]:
        """`run` while this file is changed; it is mended whatever happens."""
        path = self.root / bug
        good, stat = path.read_text(), path.stat()
        broken = change(good)
        if broken is None:
            return "gone", ""
        caches = [*path.parent.glob("__pycache__/*.nb[ic]")]
        held = {cache: cache.read_bytes() for cache in caches}  # compiled callers know nothing of a callee's change
        try:
            path.write_text(broken)
            self._stamp += 1  # what was compiled of another bug a moment ago is of another time
            os.utime(path, (self._stamp, self._stamp))
            for cache in caches:
                cache.unlink()
            return run()
        finally:
            path.write_text(good)
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
            for cache in path.parent.glob("__pycache__/*.nb[ic]"):
                cache.unlink()
            for cache, data in held.items():
                cache.write_bytes(data)


class Watch:
    """A plugin of pytest: which test failed first, how long each took, and which lines it ran."""

    def __init__(self, lines: coverage.Coverage | None = None) -> None:
        self.lines, self.failed = lines, ""
        self.seconds: dict[str, float] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        if self.lines is not None:
            self.lines.switch_context(item.nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.failed and not self.failed:
            self.failed = report.nodeid

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed and not self.failed:
            self.failed = f"{report.nodeid} (import)"


def collect_failed(watch: Watch, arguments: list[str]) -> list[str]:
    """All tests that fail, without a bug."""
    failed: list[str] = []

    class Failures:
        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.failed:
                failed.append(report.nodeid)

    code = pytest.main(arguments, plugins=[watch, Failures()])
    if code not in (0, 1):
        raise RuntimeError(f"the tests could not be collected: pytest left with {int(code)}")
    return failed


def found_by(copy: Copy, tests: list[str], within_s: float, work: Path) -> tuple[str, str]:
    """The outcome of these tests, and the one that failed."""
    said = work / "failed.txt"
    said.unlink(missing_ok=True)

    def run() -> None:
        watch = Watch()
        code = pytest.main([*ALWAYS, *tests], plugins=[watch])
        if code not in (0, 5):
            said.write_text(watch.failed or f"pytest left with {int(code)}")

    status = forked(run, within_s, copy.root, work / "last.log")
    if status is None:
        return "timeout", ""
    if status or said.exists():
        return "killed", said.read_text() if said.exists() else f"the process died ({status})"
    return "survived", ""


def forked(work: Callable[[], object], within_s: float, where: Path, log: Path) -> int | None:
    """The status of `work` in a process of its own, in a folder; None if it took too many seconds of the processor.

    By the clock it may take `PATIENCE` times as long.
    """
    child = os.fork()
    if not child:
        try:
            os.setsid()
            os.chdir(where)
            output = os.open(log, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
            os.dup2(output, 1)
            os.dup2(output, 2)
            os.environ["PYTHONPATH"] = str(where / "src")
            # The checkout's own packages, and this folder's modules, some of which are called as folders of tests are.
            sys.path[:] = [
                str(where / "src"),
                *(p for p in sys.path if Path(p) not in (ROOT / "src", Path(__file__).parent)),
            ]
            resource.setrlimit(resource.RLIMIT_CPU, (round(within_s), round(within_s) + 5))
            work()
            sys.stdout.flush()
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(1)
    end = time.monotonic() + PATIENCE * within_s
    ended = status = 0
    while not ended and time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        time.sleep(0.05)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    if not ended:
        os.waitpid(child, 0)
    timed_out = not ended or (os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGKILL))
    return None if timed_out else status
