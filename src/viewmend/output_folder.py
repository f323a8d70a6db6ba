"""Folders that commands write to: one run at a time, and nobody's files are replaced but our own."""

import contextlib
import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator
from fnmatch import fnmatch
from pathlib import Path

import msgspec
from filelock import FileLock, Timeout

from viewmend.atomic_writes import remove_halves, undisturbed, write_text

HIDDEN = ".viewmend"
"""The folder that holds the lock, the manifest and what is not finished."""


class _Manifest(msgspec.Struct):
    files: dict[str, list[str]]


class OutputFolder:
    """A folder that this run alone writes to; a context manager.

    Its manifest lists the files that runs have made there. What lies in the way and is not listed, or was changed
    since, is somebody else's: no run goes on over it. What killed runs have left unfinished is removed at the start.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.draft = path / HIDDEN / "draft"
        """A folder for what is not finished; it is empty at the start, and gone at the end."""
        self._manifest = path / HIDDEN / "files.json"
        self._lock = FileLock(path / HIDDEN / "lock")
        self._new = False

    def __enter__(self) -> "OutputFolder":
        """Begin.

        Raises:
            ValueError: another run writes there, it is a file, or has a link where runs keep what they know.
            OSError: it cannot be made.
        """
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path}: expected a folder for the results, got a file; choose another --out")
        if (hidden := self.path / HIDDEN).is_symlink() or (hidden.exists() and not hidden.is_dir()):
            raise ValueError(f"{hidden}: expected a folder that a run has made, got something else; move it away")
        self._new = not self.path.exists()
        (self.path / HIDDEN).mkdir(parents=True, exist_ok=True)
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise ValueError(
                f"{self.path}: expected a folder that no other run writes to, got one in use; wait for that run's end, "
                "or choose another folder"
            ) from None
        shutil.rmtree(self.draft, ignore_errors=True)
        remove_halves(self.path)
        self.draft.mkdir()
        return self

    def __exit__(self, *_: object) -> None:
        with undisturbed():
            self._end()

    def _end(self) -> None:
        shutil.rmtree(self.draft, ignore_errors=True)
        # Before the lock is let go: what the next run makes in there is not this one's to remove.
        if self._new and [entry.name for entry in self.path.iterdir()] == [HIDDEN]:
            shutil.rmtree(self.path, ignore_errors=True)
        elif not self._manifest.exists():
            shutil.rmtree(self.path / HIDDEN, ignore_errors=True)
        self._lock.release()

    @property
    def listed(self) -> bool:
        """Whether runs have made files here, as far as the manifest says."""
        return bool(self._read())

    def demand_own(self, *patterns: str) -> None:
        """See that all files of these names, or in folders of these names, were made by runs.

        Raises:
            ValueError: one was not, or was changed since.
        """
        known = self._read()
        for file in self._files(patterns):
            name = file.relative_to(self.path).as_posix()
            digests = known.get(name, _any(known, name))
            if digests != [] and (digests is None or _digest(file) not in digests):
                raise ValueError(
                    f"{file}: expected no such file, or one that an earlier run made and nobody changed, got one of "
                    "somebody else's; move it away, or choose another folder"
                )

    def made(self, *patterns: str, changing: bool = False) -> None:
        """List files as made here; those that go on `changing` by their patterns alone, before they are there.

        What was listed as changing by one of these very patterns is from now on known by what is in it.
        """
        if changing:
            others = {n: value for n, value in self._read().items() if not any(fnmatch(n, p) for p in patterns)}
            self._write(others | {pattern: [] for pattern in patterns})
            return
        found = {file.relative_to(self.path).as_posix(): [_digest(file)] for file in self._files(patterns)}
        known = {name: value for name, value in self._read().items() if name not in patterns}
        kept = {name: value for name, value in known.items() if value == [] or (self.path / name).is_file()}
        self._write(kept | found)

    def publish(self, *names: str) -> None:
        """Put what the draft has of these names, files or folders, in the place of what earlier runs made of them.

        Raises:
            ValueError: something else lies there.
        """
        self.demand_own(*names)
        known, new = self._read(), {}
        for file in _below(self.draft, names):
            new[file.relative_to(self.draft).as_posix()] = [_digest(file)]
        # Killed in between, the folder has files of both runs, and all of them are ours.
        self._write({name: known.get(name, []) + new.get(name, []) for name in known | new})
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                (self.path / name).rename(self.draft / f"old-{name}")
            with contextlib.suppress(FileNotFoundError):
                (self.draft / name).rename(self.path / name)
        gone = {name for name in known if any(name == n or name.startswith(f"{n}/") for n in names)} - new.keys()
        self._write({name: value for name, value in (known | new).items() if name not in gone})

    def _files(self, patterns: Iterable[str]) -> Iterator[Path]:
        for pattern in patterns:
            for found in sorted(path for path in self.path.glob(pattern) if path.name != HIDDEN):
                yield from _below(self.path, [found.relative_to(self.path).as_posix()])

    def _read(self) -> dict[str, list[str]]:
        try:
            return msgspec.json.decode(self._manifest.read_bytes(), type=_Manifest).files
        except (OSError, msgspec.MsgspecError, RecursionError):
            return {}  # nothing is known to be ours

    def _write(self, files: dict[str, list[str]]) -> None:
        text = json.dumps({"made by": "viewmend", "files": files}, indent=1, sort_keys=True)
        write_text(self._manifest, text)


def _any(known: dict[str, list[str]], name: str) -> list[str] | None:
    """No digests where a pattern of changing files fits the name; None where it is not known."""
    return [] if any(value == [] and fnmatch(name, pattern) for pattern, value in known.items()) else None


def _below(root: Path, names: Iterable[str]) -> Iterator[Path]:
    """The files of these names, and those in folders of these names; links are not followed."""
    for name in names:
        path = root / name
        if path.is_dir() and not path.is_symlink():
            yield from (file for file in sorted(path.rglob("*")) if file.is_symlink() or not file.is_dir())
        elif path.is_symlink() or path.exists():
            yield path


def _digest(file: Path) -> str:
    if file.is_symlink() or not file.is_file():
        return "no file"
    with file.open("rb") as data:
        return hashlib.file_digest(data, "sha256").hexdigest()[:32]
