"""How long pictures take, and how large they may be while several viewers wait for theirs."""

from collections import deque
from dataclasses import replace
from math import inf, sqrt

from viewmend.live.budget import QualityLevel

LONGEST_S = 2.5
"""All who wait for a picture, one after the other, are served within so many seconds, as far as can be told: twice as
long where what is known comes late, or other programs take half of the machine."""
ALONE_S = 1.0
"""So long may a picture take that nobody else waits for, as far as can be told, where there are other viewers."""
LEAST_PX = 20_000
"""Smaller pictures say little about large ones: what no resolution changes is most of their time."""
UNKNOWN_S_PER_PX = 6e-6
"""Seconds a pixel before any picture was made, all that a model can do: a slow machine's."""


class Pace:
    """Seconds a pixel, of one server; the slowest of its last large pictures counts."""

    def __init__(self) -> None:
        self._seconds_per_px: deque[float] = deque(maxlen=16)

    def record(self, pixels: float | int, level: QualityLevel, seconds: float) -> None:
        """A picture of so many pixels was made at a level."""
        if pixels >= LEAST_PX:
            self._seconds_per_px.append(seconds / (pixels * _cost(level)))

    def bounded(self, level: QualityLevel, pixels: float | int, waiting: int, company: bool = False) -> QualityLevel:
        """The level, with a lower resolution where so many who each want a picture like it would wait too long.

        Args:
            level: as it was chosen for one viewer.
            pixels: of the whole picture, at a scale of 1.
            waiting: how many want one; a single viewer keeps nobody waiting.
            company: whether there are other viewers, who do not wait for a picture now.
        """
        each_s = max(self._seconds_per_px, default=UNKNOWN_S_PER_PX) * _cost(level) * pixels * level.scale**2
        longest_s = LONGEST_S / waiting if waiting > 1 else ALONE_S if company else inf
        return level if each_s <= longest_s else replace(level, scale=level.scale * sqrt(longest_s / each_s))


def _cost(level: QualityLevel) -> float:
    """Cost of a pixel, relative to one at the full level."""
    return level.relative_cost / level.scale**2
