"""One place for the newest of something."""

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Slot(Generic[T]):
    """One place between two threads: what is newer replaces what was not taken yet."""

    def __init__(self) -> None:
        self._lock = threading.Condition()
        self._value: T | None = None

    def put(self, value: T) -> bool:
        """Put a value in; whether another one was replaced."""
        with self._lock:
            replaced = self._value is not None
            self._value = value
            self._lock.notify()
        return replaced

    def take(self, timeout_s: float) -> T | None:
        """Take the value out, None where none came in time."""
        with self._lock:
            self._lock.wait_for(lambda: self._value is not None, timeout_s)
            value, self._value = self._value, None
        return value
