"""Ends a computation between two of its steps once its result is not needed any more."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_is_cancelled: ContextVar[Callable[[], bool]] = ContextVar("is_cancelled", default=lambda: False)


class CancelledError(Exception):
    """The result of a computation is not needed any more."""


@contextmanager
def cancellable(is_cancelled: Callable[[], bool]) -> Iterator[None]:
    """Let `stop_if_cancelled` raise within, on this thread, as soon as `is_cancelled` is true."""
    token = _is_cancelled.set(is_cancelled)
    try:
        yield
    finally:
        _is_cancelled.reset(token)


def stop_if_cancelled() -> None:
    """Mark a point at which a long computation may end.

    Raises:
        CancelledError: the caller does not need the result any more.
    """
    if _is_cancelled.get()():
        raise CancelledError
