"""Strangers are heard one after the other, in a small part of the time: who was let in is not kept waiting."""

import asyncio
import time
from collections import deque
from collections.abc import Callable

TURN_BYTES = 4096
"""How much of what a stranger has sent is read in one turn."""
PAUSE = 4.0
"""How long strangers wait after a turn, in lengths of the turn."""
PAUSE_S = 0.005
"""The least seconds that they wait: what answering takes comes after the turn."""


class Turns:
    """Gives strangers turns; of those who wait, who had none yet comes first."""

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], None]] = deque()
        self._free_at = 0.0
        self._planned: asyncio.TimerHandle | None = None
        self._given = False

    def ask(self, turn: Callable[[], None], first: bool) -> None:
        """Have `turn` called once it may be, at once where nobody else had one lately."""
        if not self._waiting and not self._given and time.monotonic() >= self._free_at:
            self._give(turn)
            return
        (self._waiting.appendleft if first else self._waiting.append)(turn)
        self._plan()

    def withdraw(self, turn: Callable[[], None]) -> None:
        """Forget about `turn`, if it waits: who asked is gone, and would take the time of others and hold memory."""
        if turn in self._waiting:
            self._waiting.remove(turn)

    def _plan(self) -> None:
        if self._waiting and self._planned is None and not self._given:
            wait_s = max(0.0, self._free_at - time.monotonic())
            self._planned = asyncio.get_running_loop().call_later(wait_s, self._next)

    def _next(self) -> None:
        self._planned = None
        if self._waiting:
            self._give(self._waiting.popleft())

    def _give(self, turn: Callable[[], None]) -> None:
        begun, self._given = time.monotonic(), True
        try:
            turn()
        finally:
            ended, self._given = time.monotonic(), False
            self._free_at = ended + max(PAUSE_S, PAUSE * (ended - begun))
            self._plan()
