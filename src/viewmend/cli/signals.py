"""What ends a command from outside: Ctrl-C and SIGTERM."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from viewmend.cli.console import say

Handler = Callable[[int, FrameType | None], None]


@contextlib.contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Have SIGTERM end a command as Ctrl-C does, so that what it has begun to write is removed."""
    own = os.getpid()

    def end(number: int, _: object) -> None:
        if os.getpid() != own:  # a child that was forked, of which nobody waits to hear
            os._exit(128 + number)
        raise SystemExit(128 + number)

    with _handled(end, signal.SIGTERM):
        yield


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], int]]:
    """Which of Ctrl-C and SIGTERM asked for the end of what goes on in steps, 0 for none; once more ends it at once."""
    asked: list[int] = []

    def ask(number: int, _: object) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)
        say("stopping after this step, with a checkpoint; once more to stop at once, with the last one")

    with _handled(ask, signal.SIGINT, signal.SIGTERM):
        yield lambda: sum(asked)


@contextlib.contextmanager
def _handled(handler: Handler, *signals: signal.Signals) -> Iterator[None]:
    """Handle signals; only the main thread can, elsewhere all stays as it was."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in signals}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
