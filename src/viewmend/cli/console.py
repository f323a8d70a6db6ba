"""What commands say to people: progress and messages on standard error, results on standard output."""

import contextlib
import json
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from viewmend.terminal import printable

_Item = TypeVar("_Item")
QUIET_S = 2.0
"""A bar appears only after this long: what is quick needs none."""
BEAT_S = 30.0
"""Seconds between lines that say how far a command is, where there is no terminal for a bar."""


def track(items: Iterable[_Item], description: str, total: int | None = None) -> Iterator[_Item]:
    """Pass `items` on, with a progress bar on standard error once two seconds went by.

    Where that is no terminal, a line every half minute says how far it is. `total` is the number of items; it is found
    by `len` where it is not given. A bar of an unknown total pulses.
    """
    if total is None and hasattr(items, "__len__"):
        total = len(items)  # pyright: ignore[reportArgumentType]
    if not sys.stderr.isatty():
        with Heartbeat(description) as heartbeat:
            for done, item in enumerate(items):
                heartbeat.text = f"{description}: {done}{'' if total is None else f' of {total}'}"
                yield item
        return
    start, bar, task = time.monotonic(), None, None
    try:
        for done, item in enumerate(items):
            if bar is None and time.monotonic() - start > QUIET_S:
                bar = _bar()
                bar.start()
                task = bar.add_task(description, total=total)
            if bar is not None and task is not None:
                bar.update(task, completed=done)
            yield item
    finally:
        if bar is not None:
            bar.stop()


def _bar():
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True), transient=True)


@contextlib.contextmanager
def busy(description: str) -> Iterator[None]:
    """Say what is going on once two seconds went by, for work that cannot be counted.

    Where there is no terminal, a line every half minute says it.
    """
    if not sys.stderr.isatty():
        with Heartbeat(description):
            yield
        return
    from rich.console import Console

    status = Console(stderr=True).status(description)
    timer = threading.Timer(QUIET_S, status.start)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()
        status.stop()


class Heartbeat:
    """Says its text on standard error every half minute; a context manager."""

    def __init__(self, text: str) -> None:
        self.text = text
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)

    def __enter__(self) -> "Heartbeat":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_S):
            say(self.text)


def say(message: str) -> None:
    """A line for the person who watches, on standard error."""
    print(printable(message), file=sys.stderr, flush=True)


def show(*lines: str) -> None:
    """Lines of a result, on standard output."""
    print("\n".join(map(printable, lines)), flush=True)


def print_json(value: object) -> None:
    """`value` as JSON on standard output; not-a-number becomes null, since JSON has none."""
    print(json.dumps(_without_nan(value), indent=2, allow_nan=False))


def _without_nan(value: object) -> object:
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return value


def in_db(value: float | None) -> str:
    """A figure of a table, five characters wide."""
    return "    -" if value is None else f"{value:5.2f}"
