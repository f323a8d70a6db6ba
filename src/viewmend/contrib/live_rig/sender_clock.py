"""A sender's clock, estimated from the arrival of its packets."""

from collections import deque
from dataclasses import dataclass

WINDOW_S = 10.0
"""The clock is set by the least delayed packet of a window of this many seconds, in which clocks
drift apart by less than 1 ms."""
JUMP_S = 1.0
"""A sender has restarted if its timestamps go back by more than this many seconds, or forward by this
much more than the elapsed time."""


@dataclass(frozen=True)
class Arrival:
    """A packet's timestamp on the sender's clock, and its arrival on this machine's clock."""

    sent_s: float
    arrived_s: float

    @property
    def offset_s(self) -> float:
        """This machine's clock minus the sender's, plus the delay."""
        return self.arrived_s - self.sent_s


class SenderClock:
    """Estimates the offset of a sender's clock.

    Networks only delay, so the least delayed packet of the last seconds is the best estimate.
    """

    def __init__(self) -> None:
        self._candidates: deque[Arrival] = deque()
        """The least delayed packet of the window, then those that may replace it later. Arrivals and
        offsets increase."""
        self._last: Arrival | None = None

    def add_packet(self, sent_s: float, arrived_s: float) -> None:
        """Add a packet that has just arrived, without waiting in a queue of this machine."""
        packet = Arrival(sent_s, arrived_s)
        if self._last is not None:
            step_s = packet.sent_s - self._last.sent_s
            elapsed_s = packet.arrived_s - self._last.arrived_s
            if step_s < -JUMP_S or step_s > elapsed_s + JUMP_S:
                self._candidates.clear()
        self._last = packet
        while self._candidates and self._candidates[-1].offset_s >= packet.offset_s:
            self._candidates.pop()
        self._candidates.append(packet)
        while self._candidates[0].arrived_s < arrived_s - WINDOW_S:
            self._candidates.popleft()

    def to_local_s(self, sent_s: float) -> float | None:
        """A sender's time on this machine's clock; None before the first packet."""
        if not self._candidates:
            return None
        return sent_s + self._candidates[0].offset_s
