"""Atomic file writes: write to a temporary name in the same folder, then rename."""

import errno
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

TEMPORARY = ".half-"
"""Prefix of the temporary name."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def defer_signals() -> Iterator[None]:
    """Defer Ctrl-C and SIGTERM until the block ends, for clean-up that must complete."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread receives signals
        yield
        return
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handled = {number: handler for number, handler in before.items() if callable(handler)}
    for number in handled:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in handled.items():
            signal.signal(number, handler)
        for number in came[:1]:
            signal.raise_signal(number)


@contextmanager
def name_path_in_errors(path: Path) -> Iterator[None]:
    """Add the path to "disk full" errors, which do not carry one.

    Raises:
        OSError: the disk is full; `filename` is `path` unless already set.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM or error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_atomically(path: Path, write: Callable[[Path], object], durable: bool = False) -> None:
    """Call `write` with a temporary path, then rename it to `path`: readers never see a partial file.

    With `durable`, the data is flushed to disk before the rename, so that a power failure leaves
    the old or the new file.

    Raises:
        OSError: writing failed, with the path; an existing file at `path` is unchanged.
    """
    temporary = path.with_name(f"{TEMPORARY}{os.getpid()}-{path.name}")
    try:
        with name_path_in_errors(path):
            write(temporary)
            if durable:
                _flush_to_disk(temporary)
            temporary.replace(path)
            if durable and os.name == "posix":  # elsewhere folders cannot be opened
                _flush_to_disk(path.parent)
    finally:
        with defer_signals():
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically; raises as `write_atomically` does."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def remove_partial_files(folder: Path) -> None:
    """Remove temporary files of killed runs from a folder that only this run writes to."""
    for leftover in folder.glob(f"{TEMPORARY}*"):
        if leftover.is_symlink() or not leftover.is_dir():
            leftover.unlink(missing_ok=True)


def remove_partial_file(path: Path) -> None:
    """Remove temporary files of one file that killed runs left, in a folder that others may write to."""
    name = re.compile(rf"{re.escape(TEMPORARY)}(\d+)-{re.escape(path.name)}")
    for entry in path.parent.iterdir() if path.parent.is_dir() else ():
        leftover = name.fullmatch(entry.name)
        if leftover and not is_running(leftover[1]) and not entry.is_dir():
            entry.unlink(missing_ok=True)


def is_running(process: str) -> bool:
    """Whether a process with this id exists on this machine; True if that cannot be determined."""
    if os.name != "posix" or not process.isdigit():
        return True
    try:
        os.kill(int(process), 0)
    except (OSError, OverflowError) as error:
        return not isinstance(error, ProcessLookupError)
    return True


def _flush_to_disk(path: Path) -> None:
    number = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(number)
    finally:
        os.close(number)
