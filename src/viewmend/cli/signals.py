"""Signals that end a command: Ctrl-C (SIGINT) and SIGTERM."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from viewmend.cli.console import say

Handler = Callable[[int, FrameType | None], None]


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
    """Let a loop finish its step after Ctrl-C or SIGTERM; a second signal interrupts it at once.

    Yields a function that returns the number of the signal, or 0 if there was none.
    """
    received: list[int] = []

    def request(number: int, _: object) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)
        say("stopping after this step and saving a checkpoint; press again to stop at once with the last checkpoint")

    with _handle(request, signal.SIGINT, signal.SIGTERM):
        yield lambda: sum(received)


@contextlib.contextmanager
def _handle(handler: Handler, *signals: signal.Signals) -> Iterator[None]:
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
