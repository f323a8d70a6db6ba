"""Files that are whole or not there: written beside their place, then renamed."""

import errno
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

HALF = ".half-"
"""How the name of a file begins that is being written."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Have Ctrl-C and SIGTERM wait for the end of what must be done as a whole: removing what is unfinished, say."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread is ever interrupted
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
def naming(path: Path) -> Iterator[None]:
    """Have what finds no room on the disk say where: the errors of writes do not know their file.

    Raises:
        OSError: there was no room, with `path` unless it names a file.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM or error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_atomically(path: Path, write: Callable[[Path], object], durable: bool = False) -> None:
    """`write` a file beside `path`, which then takes its place; nobody ever sees half a file.

    A `durable` file is on the disk before it takes the place: a machine that stops leaves the old file or the new one.

    Raises:
        OSError: it cannot be written, with the path; what was at `path` is as it was.
    """
    beside = path.with_name(f"{HALF}{os.getpid()}-{path.name}")
    try:
        with naming(path):
            write(beside)
            if durable:
                _flush_to_disk(beside)
            beside.replace(path)
            if durable and os.name == "posix":  # elsewhere folders cannot be opened
                _flush_to_disk(path.parent)
    finally:
        with undisturbed():
            beside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """A file of text in UTF-8, whole or not there; raises as `write_atomically` does."""
    write_atomically(path, lambda beside: beside.write_text(text, encoding="utf-8"))


def remove_halves(folder: Path) -> None:
    """Remove what killed runs have left unfinished in a folder that this one alone writes to."""
    for half in folder.glob(f"{HALF}*"):
        if half.is_symlink() or not half.is_dir():
            half.unlink(missing_ok=True)


def remove_half_of(path: Path) -> None:
    """Remove what killed runs have left unfinished of one file, in a folder that others may write to, too."""
    name = re.compile(rf"{re.escape(HALF)}(\d+)-{re.escape(path.name)}")
    for entry in path.parent.iterdir() if path.parent.is_dir() else ():
        if (half := name.fullmatch(entry.name)) and not is_running(half[1]) and not entry.is_dir():
            entry.unlink(missing_ok=True)


def is_running(process: str) -> bool:
    """Whether a process of this machine has that number; True where it cannot be found out."""
    if os.name != "posix" or not process.isdigit():
        return True
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """A safetensors file, whole or not there; tensors are taken from any device.

    Raises:
        OSError: it cannot be written.
        FloatingPointError: a number is not finite; what was at `path` is as it was.
    """
    plain = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
    broken = [key for key, value in plain.items() if value.is_floating_point() and not bool(value.isfinite().all())]
    if broken:
        raise FloatingPointError(
            f"{path}: expected finite numbers, got others in {len(broken)} of {len(plain)} tensors ({broken[0]}); the "
            "file stays as it was: go on from there, with a lower learning rate"
        )

    def write(beside: Path) -> None:
        try:
            save_file(plain, beside, dict(metadata))
        except SafetensorError as error:
            raise OSError(f"{path}: expected room for the file, got: {error}; free some, or write elsewhere") from error
        beside.chmod(0o644)

    write_atomically(path, write, durable=True)


def _flush_to_disk(path: Path) -> None:
    number = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(number)
    finally:
        os.close(number)
