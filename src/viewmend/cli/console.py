"""Messages and progress on standard error, results on standard output, and signals that end a command."""

import contextlib
import io
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from types import FrameType
from typing import TypeVar

from viewmend.utils.logging import printable

_Item = TypeVar("_Item")
LONG_S = 60.0
"""Work that takes longer than this, seconds, is announced with its duration."""
INTERVAL_S = 30.0
"""Seconds between progress lines if standard error is not a terminal."""
REPEATED_S = 1.0
"""Ctrl-C so soon after the first signal is the same request: torchrun and `timeout` pass it on, and
signal again."""


def track(items: Iterable[_Item], description: str, total: int | None = None) -> Iterator[_Item]:
    """Iterate over `items` with a progress bar on standard error, or progress lines if it is not a terminal.

    `total` is the number of items, by default their `len`. Without either, the bar shows activity only.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    if not sys.stderr.isatty():
        start = time.monotonic()
        done = 0

        def text() -> str:
            if not total:
                return f"{description}: {done}"
            left_s = (time.monotonic() - start) * (total / done - 1) if done else None
            return (
                f"{description}: {done} of {total}{'' if left_s is None else f', {_duration(left_s)} left'}"
            )

        with Heartbeat(text):
            for done, item in enumerate(items):  # noqa: B007 (read by `text`)
                yield item
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        yield from bar.track(items, total, description=description)


def announce_duration(items: Sequence[_Item], what: str, advice: str = "") -> Iterator[_Item]:
    """Iterate over `items`, and print how long they will take, by the second one, if that is long.

    `what` names the items in the message, which `advice` follows.
    """
    ended_s = []
    for item in items:
        yield item
        ended_s.append(time.monotonic())
        if len(ended_s) == 2:
            left_s = (len(items) - 2) * (ended_s[1] - ended_s[0])
            if left_s > LONG_S:
                more = f"; {advice}" if advice else ""
                say(f"{len(items)} {what} will take about {_duration(left_s)}{more}")


def _duration(seconds: float) -> str:
    """A rough length of time in words."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@contextlib.contextmanager
def busy(description: str) -> Iterator[None]:
    """Show that work of unknown length is going on; lines on standard error if it is not a terminal."""
    if not sys.stderr.isatty():
        start = time.monotonic()
        with Heartbeat(lambda: f"{description}: {_duration(time.monotonic() - start)} so far"):
            yield
        return
    from rich.console import Console

    with Console(stderr=True).status(description):
        yield


class Heartbeat:
    """Prints a text to standard error at a regular interval; a context manager."""

    def __init__(self, text: Callable[[], str]) -> None:
        self._text = text
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Heartbeat":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(INTERVAL_S):
            say(self._text())


def say(message: str) -> None:
    """Print a line for the user to standard error."""
    print(printable(message), file=sys.stderr, flush=True)


def use_utf8_names() -> None:
    """Start this process again in Python's UTF-8 mode if names in its arguments and folders have another encoding.

    In a locale such as C, names of files and arguments would not equal the same names in calibrations,
    which are UTF-8. Standard output and error keep their encoding. Does nothing a second time.
    """
    is_utf8 = sys.getfilesystemencoding().lower().replace("-", "") == "utf8"
    if is_utf8 or os.environ.get("PYTHONUTF8") == "1":
        return
    os.environ["PYTHONUTF8"] = "1"
    os.environ.setdefault("PYTHONIOENCODING", sys.stdout.encoding)
    os.execv(sys.executable, sys.orig_argv)


def escape_unencodable() -> None:
    """Make standard output and error escape the characters that their encoding lacks.

    Names of cameras and folders may have letters of any script, but the encoding of a console or
    pipe may be as small as cp1252 or ASCII.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def show(*lines: str) -> None:
    """Print lines of a result to standard output."""
    print("\n".join(map(printable, lines)), flush=True)


def print_json(value: object) -> None:
    """Print a value as JSON to standard output. NaN and infinity, which JSON does not have, become null."""
    print(json.dumps(_replace_nan(value), indent=2, allow_nan=False))


def _replace_nan(value: object) -> object:
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    if isinstance(value, dict):
        return {key: _replace_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nan(item) for item in value]
    return value


def in_db(value: float | None) -> str:
    """A number of a table, five characters wide."""
    return "    -" if value is None else f"{value:5.2f}"


@contextlib.contextmanager
def exit_on_sigterm() -> Iterator[None]:
    """Make SIGTERM unwind the stack as Ctrl-C does, so that partial output is removed."""
    parent = os.getpid()

    def end(number: int, _: object) -> None:
        if os.getpid() != parent:  # a forked child: nothing to clean up
            os._exit(128 + number)
        raise SystemExit(128 + number)

    with _handle(end, signal.SIGTERM):
        yield


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], int]]:
    """Let a loop finish its step after Ctrl-C or SIGTERM; Ctrl-C after more than `REPEATED_S` interrupts it at once.

    Yields a function that returns the number of the first signal, or 0 if there was none.
    """
    first = 0
    at_s = 0.0

    def request(number: int, _: object) -> None:
        nonlocal first, at_s
        if not first:
            first = number
            at_s = time.monotonic()
            say("stopping after this step and saving a checkpoint; press Ctrl-C again to stop at once")
        elif number == signal.SIGINT and time.monotonic() - at_s > REPEATED_S:
            raise KeyboardInterrupt

    with _handle(request, signal.SIGINT, signal.SIGTERM):
        yield lambda: first


@contextlib.contextmanager
def _handle(handler: Callable[[int, FrameType | None], None], *signals: signal.Signals) -> Iterator[None]:
    """Install a handler; does nothing outside the main thread, where Python does not allow it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in signals}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
