"""How many small bugs the tests find: python benchmarks/mutate.py [--rooms ...] [--count 20] [--again] [--write].

Bugs are drawn by a seed, as many of each kind, and put into a copy of the tree, one at a time. The tests that run
through the line are run, then all of their files; without such a test, all of the room's. What a test fails for, or
what does not end in time, is found. The state in --work is written after each bug: the same command goes on, --again
tries those that survived against the tests of now. Each run of tests is a fork of a process that has imported the
libraries.
"""

import argparse
import contextlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import time
import tomllib
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import coverage
import pytest
from measure import write
from mutations import Mutation, applied, mutations

# Imported once, for all runs; viewmend itself never, so that each run imports it as it is then.
import cv2, einops, msgspec, numba, safetensors.torch, starlette, torch, tyro, uvicorn, websockets  # noqa: E401, F401  # isort: skip

ROOT = Path(__file__).resolve().parents[1]
NAMED = Path(__file__).with_name("named_bugs.toml")
ROOMS = {
    "geometry": ("geometry", "laws/test_geometry_laws.py", "rendering/test_blending.py"),
    "rendering": ("rendering", "test_stream.py"),
    "inpainting": ("inpainting", "laws", "test_stream.py"),
    "evaluation": ("evaluation", "cli/test_evaluate.py", "cli/test_mend.py"),
    "training": ("training", "cli/test_train.py", "cli/test_samples_command.py"),
    "leave_one_out": ("leave_one_out", "evaluation/test_runner.py", "training/test_samples.py"),
    "live": ("live",),
    "cli": ("cli",),
}
"""The tests of each room of src/viewmend."""
IMPORTED = "-Wignore::pytest.PytestAssertRewriteWarning"
ALWAYS = ["-q", "-x", "-p", "no:cacheprovider", "--no-header", "--ignore=tests/live/browser", IMPORTED]
Change = Callable[[str], str | None]
LEAST_S, TIMES_AS_LONG, PATIENCE = 30.0, 3.0, 20.0


@dataclass
class Bug:
    """One bug and what became of it."""

    room: str
    path: str
    mutation: Mutation
    outcome: str = "open"
    """open, killed, timeout, survived, or gone where the line is no more."""
    by: str = ""
    """The test that failed."""
    seconds: float = 0.0


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


def main() -> None:
    """Draw, run, and print or write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS))
    parser.add_argument("--count", type=int, default=20, help="bugs a room")
    parser.add_argument("--seed", type=int, default=22)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "mutation", help="copy of the tree, and the state")
    parser.add_argument("--nice", type=int, default=10)
    parser.add_argument(
        "--named", action="store_true", help=f"try the bugs of {NAMED.name} instead, all written by hand"
    )
    parser.add_argument("--again", action="store_true", help="try those that survived once more")
    parser.add_argument("--write", action="store_true", help="keep the result under benchmarks/results")
    options = parser.parse_args()
    options.work = options.work.resolve()
    options.work.mkdir(parents=True, exist_ok=True)
    os.nice(options.nice)
    copy = Copy(options.work)
    if options.named:
        sys.exit(try_named(copy, options.work) > 0)
    for room in options.rooms:
        state = options.work / f"{room}--{options.seed}.json"
        bugs = load(state) if state.exists() else draw(room, options.count, options.seed)
        for bug in bugs:
            bug.outcome = "open" if options.again and bug.outcome == "survived" else bug.outcome
        if any(bug.outcome == "open" for bug in bugs):
            ways = tests_by_line(copy, room, options.work)
            for bug in bugs:
                if bug.outcome == "open":
                    try_bug(copy, bug, ways, options.work)
                    state.write_text(json.dumps([asdict(b) for b in bugs], indent=1))
    shutil.rmtree(copy.root)
    found = {room: load(options.work / f"{room}--{options.seed}.json") for room in options.rooms}
    result = {room: summary(bugs) for room, bugs in found.items()}
    if options.write:
        rows = [
            [room, b.path, b.mutation.line, b.mutation.kind, b.outcome, b.by] for room, of in found.items() for b in of
        ]
        config = {"seed": options.seed, "count": options.count}
        print(write("mutation", "cpu", config, {"rooms": result, "bugs": rows}))
    print(json.dumps(result, indent=1))


def draw(room: str, count: int, seed: int) -> list[Bug]:
    """So many bugs of a room, the kinds by turns."""
    rng = random.Random(f"{seed}/{room}")
    kinds: dict[str, list[Bug]] = {}
    for path in sorted((ROOT / "src" / "viewmend" / room).rglob("*.py")):
        for mutation in mutations(path.read_text()):
            kinds.setdefault(mutation.kind, []).append(Bug(room, path.relative_to(ROOT).as_posix(), mutation))
    left = [rng.sample(kinds[kind], len(kinds[kind])) for kind in sorted(kinds)]
    drawn: list[Bug] = []
    while len(drawn) < count and any(left):
        drawn += [bugs.pop() for bugs in left if bugs][: count - len(drawn)]
    return drawn


@dataclass(frozen=True)
class Ways:
    """Which tests of a room run through which lines."""

    tests: tuple[str, ...]
    """All of the room, as pytest is given them."""
    failing: tuple[str, ...]
    """Those that fail without a bug."""
    lines: dict[str, dict[str, list[str]]]
    """By file and line."""
    seconds: dict[str, float]


def tests_by_line(copy: Copy, room: str, work: Path) -> Ways:
    """Run the room's tests once, without a bug."""
    file = work / f"{room}--lines.json"
    tests = tuple(f"tests/{name}" for name in ROOMS[room] if (copy.root / "tests" / name).exists())

    def run() -> None:
        lines = coverage.Coverage(data_file=None, source=[str(copy.root / "src")], config_file=False)
        watch = Watch(lines)
        lines.start()
        failed = collect_failed(watch, [*ALWAYS[:1], *ALWAYS[2:], *tests])
        lines.stop()
        data = lines.get_data()
        by_file = {
            Path(name).relative_to(copy.root).as_posix(): {
                str(line): sorted(filter(None, contexts)) for line, contexts in data.contexts_by_lineno(name).items()
            }
            for name in data.measured_files()
        }
        file.write_text(json.dumps({"failing": failed, "lines": by_file, "seconds": watch.seconds}))

    if forked(run, 3600, copy.root, work / f"{room}--baseline.log") != 0:
        raise RuntimeError(f"{room}: the tests did not run; see {work / room}--baseline.log")
    found = json.loads(file.read_text())
    return Ways(tests, tuple(found["failing"]), found["lines"], found["seconds"])


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


def try_bug(copy: Copy, bug: Bug, ways: Ways, work: Path) -> None:
    """See whether a test finds it."""
    began = time.monotonic()
    bug.outcome, bug.by = copy.with_bug(
        bug.path, lambda good: applied(good, bug.mutation), lambda: judged(copy, bug, ways, work)
    )
    bug.seconds = round(time.monotonic() - began, 1)
    old, new = (text.strip() for text in (bug.mutation.old, bug.mutation.new))
    print(f"{bug.outcome:8} {bug.seconds:6} s {bug.path}:{bug.mutation.line} {old} -> {new} [{bug.by}]", flush=True)


def judged(copy: Copy, bug: Bug, ways: Ways, work: Path) -> tuple[str, str]:
    """The outcome and the test that failed, in the tests nearest first."""
    for tests in selections(bug, ways):
        known = [t for t in tests if t in ways.seconds] or list(ways.seconds)
        within = LEAST_S + TIMES_AS_LONG * sum(ways.seconds[t] for t in known)
        outcome = found_by(copy, [*(f"--deselect={test}" for test in ways.failing), *tests], within, work)
        if outcome[0] != "survived":
            return outcome
    return "survived", ""


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


def try_named(copy: Copy, work: Path) -> int:
    """The bugs of `NAMED`, each against its tests; how many are not found."""
    missed = 0
    bugs = tomllib.loads(NAMED.read_text())["bug"]
    for bug in bugs:

        def change(good: str, bug: dict[str, str] = bug) -> str | None:
            return good.replace(bug["old"], bug["new"]) if good.count(bug["old"]) == 1 else None

        tests = bug["tests"]
        outcome, by = copy.with_bug(bug["path"], change, lambda tests=tests: found_by(copy, tests, 600, work))
        missed += outcome not in ("killed", "timeout")
        print(f"{outcome:8} {bug['says']} [{by}]", flush=True)
    return missed


def selections(bug: Bug, ways: Ways) -> Iterator[list[str]]:
    """The tests that run through the bug's lines, the quick ones first; then all in their files; else the room's."""
    of_file = ways.lines.get(bug.path, {})
    span = range(bug.mutation.line, bug.mutation.line + bug.mutation.old.count("\n"))
    through = {test for line in span for test in of_file.get(str(line), ()) if test in ways.seconds}
    if through:
        exact = sorted(through, key=lambda test: ways.seconds[test])
        yield exact[:200]
        yield sorted({test.split("::")[0] for test in through})
    else:
        stem = Path(bug.path).stem.strip("_").split("_")[0]
        yield sorted(expand(ways), key=lambda file: stem not in file)


def expand(ways: Ways) -> list[str]:
    """The room's files of tests."""
    return sorted({test.split("::")[0] for test in ways.seconds})


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


def load(state: Path) -> list[Bug]:
    """The bugs of a room as they were written."""
    return [Bug(**(bug | {"mutation": Mutation(**bug["mutation"])})) for bug in json.loads(state.read_text())]


def summary(bugs: list[Bug]) -> dict[str, object]:
    """Counts, and the survivors."""
    counts = {o: sum(b.outcome == o for b in bugs) for o in ("killed", "timeout", "survived", "gone", "open")}
    survived = [
        f"{b.path}:{b.mutation.line} {b.mutation.old.strip()} -> {b.mutation.new.strip()}"
        for b in bugs
        if b.outcome == "survived"
    ]
    tried = counts["killed"] + counts["timeout"] + counts["survived"]
    share = round((counts["killed"] + counts["timeout"]) / tried, 3) if tried else None
    return {**counts, "share": share, "survivors": survived}


if __name__ == "__main__":
    main()
