"""How long pictures take, and how large they may be while several viewers wait for theirs."""

from collections import deque
from dataclasses import replace
from math import sqrt

from viewmend.live.budget import QualityLevel

LONGEST_S = 2.5
"""All who wait for a picture, one after the other, are served within so many seconds, as far as can be told: twice as
long where what is known comes late, or other programs take half of the machine."""
LEAST_PX = 20_000
"""Smaller pictures say little about large ones: what no resolution changes is most of their time."""
UNKNOWN_S_PER_PX = 3e-6
"""Seconds a pixel before any picture was made, all that a model can do: a slow machine's."""


class Pace:
    """Seconds a pixel, of one server; the slowest of its last large pictures counts."""

    def __init__(self) -> None:
        self._seconds_per_px: deque[float] = deque(maxlen=16)

    def record(self, pixels: float | int, level: QualityLevel, seconds: float) -> None:
        """A picture of so many pixels was made at a level."""
        if pixels >= LEAST_PX:
            self._seconds_per_px.append(seconds / (pixels * _cost(level)))

    def bounded(self, level: QualityLevel, pixels: float | int, waiting: int) -> QualityLevel:
        """The level, with a lower resolution where so many who each want a picture like it would wait too long.

        Args:
            level: as it was chosen for one viewer.
            pixels: of the whole picture, at a scale of 1.
            waiting: how many want one; a single viewer keeps nobody waiting.
        """
        each_s = max(self._seconds_per_px, default=UNKNOWN_S_PER_PX) * _cost(level) * pixels * level.scale**2
        if waiting < 2 or waiting * each_s <= LONGEST_S:
            return level
        return replace(level, scale=level.scale * sqrt(LONGEST_S / (waiting * each_s)))


def _cost(level: QualityLevel) -> float:
    """Cost of a pixel, relative to one at the full level."""
    return level.relative_cost / level.scale**2
