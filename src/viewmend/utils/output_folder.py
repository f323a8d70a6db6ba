"""Output folders of commands: one run at a time, and only files that earlier runs wrote are ever replaced."""

import contextlib
import json
import logging
import shutil
import warnings
from collections.abc import Iterable, Iterator
from fnmatch import fnmatch
from pathlib import Path
from uuid import uuid4

import msgspec
from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from viewmend.utils.atomic_writes import defer_signals, remove_partial_files, write_text
from viewmend.utils.untrusted_input import file_sha256

HIDDEN = ".viewmend"
"""Subfolder for the lock, the manifest and unfinished files."""
LOCK = "lock"
"""Name of the file that a run locks."""
MARKER = "in-use"
"""Name of the file that marks the folder as in use, on a file system without locks."""


class _Manifest(msgspec.Struct):
    files: dict[str, list[str]]


class OutputFolder:
    """Context manager: a folder that only this run writes to.

    A manifest lists the files that runs created, with their hashes. A file that is in the way and
    not listed, or was changed since, belongs to the user: the run refuses to overwrite it.
    Leftovers of killed runs are removed on entry.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.draft = path / HIDDEN / "draft"
        """Subfolder for unfinished files; empty on entry, removed on exit."""
        self._manifest = path / HIDDEN / "files.json"
        self._lock: BaseFileLock | None = None
        self._new = False

    def __enter__(self) -> "OutputFolder":
        """Create and lock the folder.

        Raises:
            ValueError: another run is using it, it is a file, or its hidden subfolder is a link or a file.
            OSError: it cannot be created or written to.
        """
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(
                f"{self.path}: expected a folder for the results, got a file; choose another --out"
            )
        hidden = self.path / HIDDEN
        if hidden.is_symlink() or (hidden.exists() and not hidden.is_dir()):
            raise ValueError(
                f"{hidden}: expected a folder that a run has made, got something else; move it away"
            )
        self._new = not self.path.exists()
        (self.path / HIDDEN).mkdir(parents=True, exist_ok=True)
        self._lock = _acquire_lock(self.path)
        shutil.rmtree(self.draft, ignore_errors=True)
        remove_partial_files(self.path)
        self.draft.mkdir()
        return self

    def __exit__(self, *_: object) -> None:
        with defer_signals():
            shutil.rmtree(self.draft, ignore_errors=True)
            # While still locked, so that files of the next run are never removed.
            if self._new and [entry.name for entry in self.path.iterdir()] == [HIDDEN]:
                shutil.rmtree(self.path, ignore_errors=True)
            elif not self._manifest.exists():
                shutil.rmtree(self.path / HIDDEN, ignore_errors=True)
            if self._lock is not None:
                self._lock.release()
                self._lock = None

    @property
    def listed(self) -> bool:
        """Whether the manifest lists any file."""
        return bool(self._read())

    def check_own_files(self, *patterns: str) -> None:
        """Check that all files matching these names, or in matching folders, were written by earlier runs.

        Raises:
            ValueError: one was not, or was changed since.
        """
        known = self._read()
        for file in self._files(patterns):
            name = file.relative_to(self.path).as_posix()
            changing = any(value == [] and fnmatch(name, pattern) for pattern, value in known.items())
            if not changing and _digest(file) not in known.get(name, ()):
                raise ValueError(
                    f"{file}: expected no such file, or an unchanged one from an earlier run, got one that was "
                    "added or changed since; move it away, or choose another folder"
                )

    def record(self, *patterns: str, changing: bool = False) -> None:
        """Record files in the manifest, by hash; with `changing`, by pattern only, before they exist.

        A pattern that was recorded as changing is replaced by the hashes of its files when recorded again.
        """
        if changing:
            others = {
                n: value for n, value in self._read().items() if not any(fnmatch(n, p) for p in patterns)
            }
            self._write(others | {pattern: [] for pattern in patterns})
            return
        found = {file.relative_to(self.path).as_posix(): [_digest(file)] for file in self._files(patterns)}
        known = {name: value for name, value in self._read().items() if name not in patterns}
        kept = {name: value for name, value in known.items() if value == [] or (self.path / name).is_file()}
        self._write(kept | found)

    def publish(self, *names: str) -> None:
        """Move these files or folders from the draft to their place, replacing those of earlier runs.

        Raises:
            ValueError: a file that no run wrote is in the way.
        """
        self.check_own_files(*names)
        known = self._read()
        new = {file.relative_to(self.draft).as_posix(): [_digest(file)] for file in _below(self.draft, names)}
        # If killed in between, the folder holds files of both runs, all of them in the manifest.
        self._write({name: known.get(name, []) + new.get(name, []) for name in known | new})
        # Interrupted in between, the earlier results would be removed with the draft.
        with defer_signals():
            for name in names:
                with contextlib.suppress(FileNotFoundError):
                    (self.path / name).rename(self.draft / f"old-{name}")
                with contextlib.suppress(FileNotFoundError):
                    (self.draft / name).rename(self.path / name)
            gone = {
                name for name in known if any(name == n or name.startswith(f"{n}/") for n in names)
            } - new.keys()
            self._write({name: value for name, value in (known | new).items() if name not in gone})

    def _files(self, patterns: Iterable[str]) -> Iterator[Path]:
        for pattern in patterns:
            for found in sorted(path for path in self.path.glob(pattern) if path.name != HIDDEN):
                yield from _below(self.path, [found.relative_to(self.path).as_posix()])

    def _read(self) -> dict[str, list[str]]:
        try:
            return msgspec.json.decode(self._manifest.read_bytes(), type=_Manifest).files
        except (OSError, msgspec.MsgspecError, RecursionError):
            return {}  # no readable manifest: own nothing

    def _write(self, files: dict[str, list[str]]) -> None:
        write_text(
            self._manifest, json.dumps({"made by": "viewmend", "files": files}, indent=1, sort_keys=True)
        )


def _acquire_lock(folder: Path) -> BaseFileLock:
    """Lock an output folder; without locks on its file system, a marker file does the same, which is reported once.

    Raises:
        ValueError: another run is using the folder.
        OSError: the folder cannot be written to.
    """
    in_use = (
        f"{folder}: expected a folder that no other run is using, got one in use; wait for that run to finish"
    )
    lock = FileLock(folder / HIDDEN / LOCK)
    try:
        with warnings.catch_warnings(
            record=True
        ) as fallback:  # where the call is missing, filelock makes a marker
            warnings.simplefilter("always")
            lock.acquire(timeout=0)
        if fallback:
            _warn_without_locks(folder, LOCK, "not implemented")
        return lock
    except Timeout:
        if _has_locks(folder):
            raise ValueError(f"{in_use}, or choose another folder") from None
        reason = "every lock is denied"
    except OSError as error:  # network file systems often have no locks
        reason = error.strerror or str(error)
    with contextlib.suppress(OSError):
        (folder / HIDDEN / LOCK).unlink()
    marker = SoftFileLock(folder / HIDDEN / MARKER)
    try:
        marker.acquire(timeout=0)
    except Timeout:
        path = folder / HIDDEN / MARKER
        raise ValueError(f"{in_use}; if none is running, remove {path}; or choose another folder") from None
    _warn_without_locks(folder, MARKER, reason)
    return marker


def _has_locks(folder: Path) -> bool:
    """Whether a new file in the folder can be locked: some file systems deny all locks as if others held them."""
    probe = folder / HIDDEN / f"{LOCK}-{uuid4().hex}"
    lock = FileLock(probe)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a fallback, as when the folder itself was locked
            lock.acquire(timeout=0)
        lock.release()
    except (Timeout, OSError):
        return False
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    return True


def _warn_without_locks(folder: Path, marker: str, reason: str) -> None:
    logging.getLogger("viewmend").warning(
        f"{folder}: its file system has no file locks ({reason}), so the file {HIDDEN}/{marker} marks the folder as in "
        "use; if other machines write to the same folder at the same time, use a local disk"
    )


def _below(root: Path, names: Iterable[str]) -> Iterator[Path]:
    """Files with these names and files in folders with these names; links are not followed."""
    for name in names:
        path = root / name
        if path.is_dir() and not path.is_symlink():
            yield from (file for file in sorted(path.rglob("*")) if file.is_symlink() or not file.is_dir())
        elif path.is_symlink() or path.exists():
            yield path


def _digest(file: Path) -> str:
    return "no file" if file.is_symlink() or not file.is_file() else file_sha256(file)[:32]
