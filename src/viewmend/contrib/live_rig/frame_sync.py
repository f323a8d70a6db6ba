"""Pictures of cameras that run on their own, put together by when they were taken."""

import math
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from viewmend.data.native_capture import CameraImages

AWAY_S = 0.5
"""A camera that was silent for so long is not waited for."""
FOLLOWS = 0.05
"""How much of the cameras' median distance to its ticks a time line takes over at each of them."""
SPARE = 4
"""Number of complete frames that are kept until they are taken; the oldest are dropped."""


@dataclass(frozen=True)
class Taken:
    """One camera's images and when they were taken, on this machine's monotonic clock."""

    taken_s: float
    images: CameraImages


@dataclass
class Together:
    """What the cameras took at one time."""

    tick: int
    since_s: float
    """When the first of them was there."""
    taken: dict[str, Taken] = field(default_factory=dict)

    @property
    def spread_s(self) -> float:
        """Between the first and the last that was taken."""
        times = [taken.taken_s for taken in self.taken.values()]
        return max(times) - min(times) if times else 0.0


class TimeLine:
    """Ticks at equal distances, which follow the cameras' own rate and phase."""

    def __init__(self, interval_s: float) -> None:
        self.interval_s = interval_s
        self._origin_s: float | None = None

    def nearest(self, taken_s: float) -> tuple[int, float]:
        """The nearest tick, and how much later than it this was taken; the first that asks sets tick 0."""
        if self._origin_s is None:
            self._origin_s = taken_s
        tick = math.floor((taken_s - self._origin_s) / self.interval_s + 0.5)
        return tick, taken_s - self._origin_s - tick * self.interval_s

    def follow(self, offsets_s: Sequence[float]) -> None:
        """Move towards the cameras, which were so much later than a tick."""
        if self._origin_s is not None and offsets_s:
            self._origin_s += FOLLOWS * statistics.median(offsets_s)


class Aligner:
    """Takes pictures as they come, in any order, and gives them out together. One thread at a time.

    Each camera has one place at each of the few times that wait. A time is complete when each camera has it or is past
    it; cameras that are away are not waited for, late ones for `wait_s`.
    """

    def __init__(self, names: Sequence[str], interval_s: float, tolerance_s: float, wait_s: float) -> None:
        """Begin.

        Args:
            names: of the cameras.
            interval_s: between two times.
            tolerance_s: how far from its time a picture may have been taken.
            wait_s: how long a time waits after its first picture.
        """
        self._line = TimeLine(interval_s)
        self._tolerance_s, self._wait_s = tolerance_s, wait_s
        self._most = SPARE + math.ceil(wait_s / interval_s)
        self._waiting: dict[int, Together] = {}
        self._done = -math.inf
        self._newest: dict[str, float] = dict.fromkeys(names, -math.inf)
        """The last tick of each camera."""
        self._heard_s: dict[str, float] = dict.fromkeys(names, -math.inf)
        self.counts: dict[str, Counter[str]] = {name: Counter() for name in names}

    def wants(self, taken_s: float, period_s: float) -> bool:
        """Whether, of pictures every `period_s`, the one that was taken then would be the nearest to a tick."""
        return period_s > self._line.interval_s / 1.5 or abs(self._line.nearest(taken_s)[1]) <= period_s / 2

    def put(self, name: str, taken: Taken, now_s: float) -> None:
        """Take in one camera's picture. What is late, in the future or far from its time is counted and dropped."""
        counts = self.counts[name]
        self._heard_s[name] = now_s
        if taken.taken_s > now_s + self._line.interval_s / 2:  # a clock that jumps must not take all others along
            counts["misaligned"] += 1
            return
        tick, offset_s = self._line.nearest(taken.taken_s)
        self._newest[name] = max(self._newest[name], tick)
        if tick <= self._done:
            counts["late"] += 1
        elif abs(offset_s) > self._tolerance_s:
            counts["misaligned"] += 1
        else:
            together = self._waiting.setdefault(tick, Together(tick, now_s))
            other = together.taken.get(name)
            if other is not None:
                counts["surplus"] += 1
            if other is None or abs(offset_s) < abs(self._line.nearest(other.taken_s)[1]):
                together.taken[name] = taken
            self._drop_oldest()

    def take(self, now_s: float) -> list[Together]:
        """The times that are complete or waited long enough, the oldest first."""
        out = []
        for tick in sorted(self._waiting):
            together = self._waiting[tick]
            if not self._complete(together, now_s):
                break
            del self._waiting[tick]
            self._done = tick
            self._count(together, now_s)
            self._line.follow([self._line.nearest(taken.taken_s)[1] for taken in together.taken.values()])
            out.append(together)
        return out

    def _drop_oldest(self) -> None:
        """Drop the oldest of more times than may wait: the newest win."""
        while len(self._waiting) > self._most:
            self._done = min(self._waiting)
            for name in self._waiting.pop(self._done).taken:
                self.counts[name]["replaced"] += 1

    def _complete(self, together: Together, now_s: float) -> bool:
        if now_s >= together.since_s + self._wait_s:
            return True
        return not any(self._newest[name] < together.tick for name in self._present(now_s))

    def _present(self, now_s: float) -> list[str]:
        return [name for name, heard_s in self._heard_s.items() if heard_s > now_s - AWAY_S]

    def _count(self, together: Together, now_s: float) -> None:
        for name in together.taken:
            self.counts[name]["used"] += 1
        for name in set(self._present(now_s)) - set(together.taken):
            self.counts[name]["missing"] += 1
