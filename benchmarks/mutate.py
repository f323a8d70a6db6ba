"""How many small bugs the tests find: python benchmarks/mutate.py [--rooms ...] [--count 20] [--again] [--write].

Bugs are drawn by a seed, as many of each kind, and put into a copy of the tree, one at a time. The tests that run
through the line are run, the quick ones first; without such a test, all of the room's. What a test fails for, or what
does not end in time, is found. The state in --work is written after each bug: the same command goes on, --again tries
those that survived against the tests of now.
"""

import argparse
import hashlib
import json
import os
import random
import shutil
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import coverage
from measure import write
from mutated_tree import ALWAYS, ROOT, Copy, Watch, collect_failed, forked, found_by
from mutations import Mutation, applied, mutations

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
LEAST_S, TIMES_AS_LONG, AT_ONCE = 30.0, 3.0, 200


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
        bugs = drawn_or_known(state, room, options.count, options.seed)
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


def drawn_or_known(state: Path, room: str, count: int, seed: int) -> list[Bug]:
    """The bugs of an earlier run; where more are asked for now, more are drawn."""
    known = load(state) if state.exists() else []
    return known + draw(room, count, seed)[len(known) :]


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
    """Run the room's tests once, without a bug, unless that was done with this very tree."""
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
        values = {"of": now, "failing": failed, "lines": by_file, "seconds": watch.seconds}
        file.write_text(json.dumps(values))

    before, now = (json.loads(file.read_text()) if file.exists() else {}), fingerprint(copy.root)
    if before.get("of") == now:
        return Ways(tests, tuple(before["failing"]), before["lines"], before["seconds"])
    if forked(run, 3600, copy.root, work / f"{room}--baseline.log") != 0:
        raise RuntimeError(f"{room}: the tests did not run; see {work / room}--baseline.log")
    found = json.loads(file.read_text())
    return Ways(tests, tuple(found["failing"]), found["lines"], found["seconds"])


def fingerprint(root: Path) -> str:
    """Of all code and tests of a tree."""
    found = hashlib.sha256()
    for path in sorted(file for part in ("src", "tests") for file in (root / part).rglob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()


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
    """The tests that run through the bug's lines, the quick ones first; where there is none, all of the room's."""
    of_file = ways.lines.get(bug.path, {})
    span = range(bug.mutation.line, bug.mutation.line + bug.mutation.old.count("\n"))
    through = {test for line in span for test in of_file.get(str(line), ()) if test in ways.seconds}
    if through:
        exact = sorted(through, key=lambda test: ways.seconds[test])
        yield from (exact[n : n + AT_ONCE] for n in range(0, len(exact), AT_ONCE))
    else:
        stem = Path(bug.path).stem.strip("_").split("_")[0]
        yield sorted(expand(ways), key=lambda file: stem not in file)


def expand(ways: Ways) -> list[str]:
    """The room's files of tests."""
    return sorted({test.split("::")[0] for test in ways.seconds})


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
