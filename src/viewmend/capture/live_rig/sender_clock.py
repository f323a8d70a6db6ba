"""A sender's own times, laid upon this machine's clock."""

from collections import deque

WINDOW_S = 10.0
"""The least delayed packet of so long says where the sender's clock is; clocks drift apart by less than 1 ms then."""
JUMP_S = 1.0
"""A sender whose times step by this much more or less than the time that passed has begun anew."""


class SenderClock:
    """Where a sender's clock is, by when its packets came.

    Networks only delay. The packet that was least delayed within the last seconds tells best, and a delay of the others
    does not change when their pictures were taken.
    """

    def __init__(self) -> None:
        self._offsets: deque[tuple[float, float]] = deque()
        """When a packet came and by how much that is later than the sender says, both growing."""
        self._last: tuple[float, float] | None = None

    def saw(self, sent_s: float, arrived_s: float) -> None:
        """A packet of this time came just now: it did not lie in a queue here."""
        if self._last is not None:
            step_s, passed_s = sent_s - self._last[0], arrived_s - self._last[1]
            if step_s < -JUMP_S or step_s > passed_s + JUMP_S:
                self._offsets.clear()
        self._last = sent_s, arrived_s
        offset_s = arrived_s - sent_s
        while self._offsets and self._offsets[-1][1] >= offset_s:
            self._offsets.pop()
        self._offsets.append((arrived_s, offset_s))
        while self._offsets[0][0] < arrived_s - WINDOW_S:
            self._offsets.popleft()

    def here_s(self, sent_s: float) -> float | None:
        """A sender's time on this machine's clock; None before any packet was seen to come."""
        return sent_s + self._offsets[0][1] if self._offsets else None
