"""The offset of a sender's clock, estimated from the arrival times of its packets."""

from collections import deque
from dataclasses import dataclass

WINDOW_S = 10.0
"""The offset is taken from the least delayed packet of a window of this many seconds, in which clocks drift
apart by less than 1 ms."""
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
        """The offset of this machine's clock from the sender's, plus the packet's delay."""
        return self.arrived_s - self.sent_s


class SenderClock:
    """Estimates the offset of a sender's clock.

    Networks can only delay packets, so the least delayed packet of the window gives the best estimate.
    """

    def __init__(self) -> None:
        self._candidates: deque[Arrival] = deque()
        """The least delayed packet of the window, then the least delayed of those after it, and so on: as
        the first one leaves the window, the next takes its place."""
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
        # Earlier packets with a longer delay will never be the least delayed of a window again.
        while self._candidates and self._candidates[-1].offset_s >= packet.offset_s:
            self._candidates.pop()
        self._candidates.append(packet)
        while self._candidates[0].arrived_s < arrived_s - WINDOW_S:
            self._candidates.popleft()

    def to_local_s(self, sent_s: float) -> float | None:
        """Convert a time of the sender to this machine's clock; None before the first packet."""
        if not self._candidates:
            return None
        return sent_s + self._candidates[0].offset_s
