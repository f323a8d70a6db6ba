"""Kill every command that writes: python research/kill_recovery.py [--commands mend ...].

Each command runs once completely, and the files that it opens for writing, renames, creates and removes are counted.
Then it is killed (SIGKILL) at some of these points, each time just after a file was opened, and run again. A kill may
leave files with unfinished names only, and the next run must remove them and produce the complete output. SIGTERM must
leave nothing. On a disk with too little space (a tmpfs; needs the right to mount) the command must print one line with
the path, exit with an error code and leave no partial file. Prints a table; exits with 1 if any check failed.
"""

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import benchmarks_path  # noqa: F401
from measure import write

# Imported once; every run is a fork of this process.
import cv2, einops, msgspec, numba, safetensors.torch, torch, tyro  # noqa: E401, F401  # isort: skip
from viewmend.cli import main as viewmend

TRAIN = "--steps 2 --batch 2 --workers 0 --validate-every 2 --validation-views 1 --checkpoint-every 1"
SMALL = "--frames 2 --size 96 --model telea"
COMMANDS = {
    "demo": f"demo --out AREA/out {SMALL}",
    "mend": "mend CAPTURE --out AREA/out --path orbit --model telea --alpha --depth",
    "studio": "studio AREA/out --scenes 2 --cameras 4 --frames 2 --size 96",
    "train": f"train finetune --captures CAPTURE --out AREA/out {TRAIN}",
    "train dstt": "train dstt --out AREA/out --steps 1 --batch 1 --workers 0 --shards SHARDS",
    "make-dataset": "make-dataset finetune --captures CAPTURE --out AREA/out --count 2 --workers 0",
    "evaluate": "evaluate P --out AREA/out --methods telea --scenes 1 --frames 2 --size 96 --jobs 1",
    "evaluate paper-table": "evaluate paper-table 1 P --ours telea --out AREA/out --scenes 1 --frames 1 --size 96",
    "masks": "masks CAPTURE AREA/out --method chroma --dark --no-clean",
    "calibrate": "calibrate ROUGH AREA/out --silhouettes --num-frames 1",
    "splits": "splits CAPTURE SECOND --out AREA/splits.json",
    "convert": "convert CAPTURE AREA/out",
    "export-scene": "export-scene CAPTURE AREA/out --views 2 --model telea",
    "check": "check CAPTURE --out AREA/check.png",
}
"""Every command that writes, on small inputs."""
UNFINISHED = re.compile(r"(^|/)(\.half-|\.viewmend(/|$)|\.[^/]+\.unfinished-\d+(/|$))")
GROWING = re.compile(r"(^|/)(log\.jsonl$|tensorboard(/|$))")
"""Files that grow line by line."""
PAGE = 4096
SPACE_FRACTIONS = (0.05, 0.5, 0.9)
Struck = Callable[[int, str, str], None]


@dataclass
class Outcome:
    """The results of one command."""

    points: int = 0
    """Files opened, renamed, created and removed by a complete run."""
    killed: int = 0
    ended: int = 0
    """Runs ended by SIGTERM."""
    full: int = 0
    faults: list[str] = field(default_factory=list)


class Area:
    """A folder in which one command runs."""

    def __init__(self, root: Path, command: str) -> None:
        self.root, self.command = root, command.replace("AREA", str(root)).split()

    def run(self, strike: Struck = lambda *_: None, rest: str = "") -> tuple[int, str, str]:
        """Run the command in a fork that calls `strike` at each point.

        Returns the exit code (negative: a signal), standard error, and the points. `rest` are further options.
        """
        with tempfile.TemporaryDirectory() as logs:
            said, points = Path(logs) / "said", Path(logs) / "points"
            child = os.fork()
            if not child:
                self._child(said, points, strike, rest.split())
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            return code, said.read_text(), points.read_text()

    def _child(self, said: Path, points: Path, strike: Struck, rest: list[str]) -> None:
        try:
            os.setsid()
            for number in (1, 2):
                os.dup2(os.open(said, os.O_CREAT | os.O_APPEND | os.O_WRONLY), number)
            log, own, count, root = points.open("w"), os.getpid(), 0, str(self.root)

            def hook(event: str, arguments: tuple[object, ...]) -> None:
                nonlocal count
                if (
                    event not in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir")
                    or os.getpid() != own
                ):
                    return
                path = os.fspath(arguments[0]) if isinstance(arguments[0], str | os.PathLike) else ""
                written = event != "open" or (
                    isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
                )
                if str(path).startswith(root) and written:
                    count += 1
                    log.write(f"{event} {path}\n")
                    log.flush()
                    strike(count, event, str(path))

            sys.addaudithook(hook)
            os._exit(viewmend([*self.command, *rest]))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(1)

    def files(self) -> dict[str, int]:
        """Size of each file by path, including folders with unfinished names."""
        paths = [path for path in self.root.rglob("*") if path.is_file() or UNFINISHED.search(str(path))]
        return {path.relative_to(self.root).as_posix(): path.stat().st_size for path in paths}

    def unfinished(self, killed: bool) -> list[str]:
        """Files that must not exist: partial ones, and without a kill also those with unfinished names."""
        bad = []
        for name, size in self.files().items():
            if UNFINISHED.search(name):
                bad += [] if killed or _kept(name) else [name]
            elif not size and not GROWING.search(name):
                bad.append(f"{name} (empty)")
            elif name.endswith(".json"):
                with contextlib.suppress(ValueError):
                    json.loads((self.root / name).read_text())
                    continue
                bad.append(f"{name} (half)")
        return bad


def _kept(name: str) -> bool:
    """Whether a complete run leaves this: manifest and lock."""
    return name.endswith((".viewmend", ".viewmend/files.json", ".viewmend/lock"))


def killed_at(number: int, sent: signal.Signals) -> Struck:
    """Open the file at this point, then send the signal."""

    def strike(count: int, event: str, path: str) -> None:
        if count == number:
            if event == "open" and sent == signal.SIGKILL:
                os.close(os.open(path, os.O_CREAT | os.O_TRUNC | os.O_WRONLY, 0o644))
            os.kill(os.getpid(), sent)

    return strike


@contextlib.contextmanager
def disk(folder: Path, free_bytes: int) -> Iterator[Path]:
    """A file system with this much space, rounded up to pages."""
    place = folder / "disk"
    place.mkdir()
    pages = free_bytes // PAGE + 1
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={pages * PAGE}", "tmpfs", place], check=True)
    try:
        (place / "full").write_bytes(bytes(PAGE))
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)
        place.rmdir()


@contextlib.contextmanager
def fresh(folder: Path) -> Iterator[Path]:
    """An empty folder with the same name each time, since files may be named after their inputs."""
    place = folder / "area"
    place.mkdir()
    try:
        yield place
    finally:
        shutil.rmtree(place)


def check(command: str, points: int, folder: Path) -> Outcome:
    """All checks of one command."""
    outcome = Outcome()
    with fresh(folder) as place:
        area = Area(place, command)
        code, said, log = area.run()
        lines, whole = log.splitlines(), area.files()
        outcome.points, room = len(lines), sum(whole.values())
        opened = [path for event, _, path in (line.partition(" ") for line in lines) if event == "open"]
        plain = {p for p in opened if not UNFINISHED.search(p) and not GROWING.search(p)}
        outcome.faults += [f"{path} is written in place" for path in sorted(plain)]
        if code or not whole:
            outcome.faults.append(f"complete run: {code}, {said[-600:]}")
            return outcome
    for n in range(points):
        number = 1 + round(n * (len(lines) - 1) / max(1, points - 1))
        for sent in (signal.SIGKILL, signal.SIGTERM):
            with fresh(folder) as place:
                faults = _faults_after_signal(Area(place, command), number, sent, set(whole))
            outcome.killed += sent == signal.SIGKILL
            outcome.ended += sent == signal.SIGTERM
            outcome.faults += [
                f"{sent.name} at {number} ({lines[number - 1][-80:]}): {fault}" for fault in faults
            ]
    for part in SPACE_FRACTIONS:
        with contextlib.suppress(subprocess.CalledProcessError, FileNotFoundError):
            with disk(folder, int(part * room)) as place:
                faults = _faults_on_full_disk(Area(place, command))
            outcome.full += 1
            outcome.faults += [f"a disk of {part:.0%}: {fault}" for fault in faults]
    return outcome


def _faults_after_signal(area: Area, number: int, sent: signal.Signals, whole: set[str]) -> list[str]:
    """Send a signal at this point and run again; the faults."""
    code, said, _ = area.run(killed_at(number, sent))
    expected = -9 if sent == signal.SIGKILL else 143
    faults = [] if code == expected else [f"exit code {code}"]
    faults += [] if sent == signal.SIGKILL or "Traceback" not in said else [said[-600:]]
    faults += [f"left {name}" for name in area.unfinished(sent == signal.SIGKILL)]
    code, said, _ = area.run()
    made = code == 2 and "expected no such folder, it exists" in said
    if made and (rest := re.search(r"go on with (--.+?), or", said)):
        code, said, _ = area.run(rest=rest[1])
    faults += [f"the next run: {code}, {said[-600:]}"] if code and not made else []
    faults += [f"the next run leaves {name}" for name in area.unfinished(False)]
    missing = {name for name in whole - set(area.files()) if not GROWING.search(name)}
    return faults + [f"the next run lacks {name}" for name in sorted(missing)[:3]]


def _faults_on_full_disk(area: Area) -> list[str]:
    code, said, _ = area.run()
    errors = [line for line in said.splitlines() if line.startswith("viewmend: error:")]
    good = code == 2 and len(errors) == 1 and str(area.root) in errors[0] and "Traceback" not in said
    return ([] if good else [f"exit code {code}, {said[-600:]}"]) + [
        f"left {n}" for n in area.unfinished(False)
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--points", type=int, default=5, help="kills, and SIGTERMs, per command")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    given = parser.parse_args()
    outcomes: dict[str, Outcome] = {}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        inputs = {
            "CAPTURE": folder / "inputs/scene_00003",
            "SECOND": folder / "inputs/scene_00004",
            "ROUGH": folder / "rough/scene_00003",
            "SHARDS": folder / "shards",
        }
        making = ["studio AREA/inputs --seed 3 --scenes 2 --cameras 5 --frames 2 --size 128"]
        making += ["studio AREA/rough --seed 3 --cameras 6 --frames 1 --size 128 --imperfect"]
        if "train dstt" in given.commands:
            making += ["make-dataset dstt --count 1 --workers 0 --out AREA/shards"]
        for command in making:
            code, said, _ = Area(folder, command).run()
            assert code == 0, said
        for name in given.commands:
            began, command = time.monotonic(), COMMANDS[name]
            for word, path in inputs.items():
                command = command.replace(word, str(path))
            one = outcomes[name] = check(command, given.points, folder)
            print(
                f"| {name} | {one.points} | {one.killed} | {one.ended} | {one.full} | {len(one.faults)} |",
                flush=True,
            )
            print(*one.faults, f"{time.monotonic() - began:.0f} s", sep="\n", file=sys.stderr, flush=True)
    if given.write:
        results = {name: vars(one) for name, one in outcomes.items()}
        print(write("kill_recovery", "cpu", {"points": given.points}, results))
    return any(one.faults for one in outcomes.values())


if __name__ == "__main__":
    sys.exit(main())
