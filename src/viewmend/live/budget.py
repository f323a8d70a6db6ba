"""Holding a frame time: how much work the next view may cost, from what the last ones took.

The control law, docs/live.md in code:

* Levels are a ladder of efforts, from all that the model can do down to a small picture with little context. What is
  given up first: older context, then context tokens, then resolution.
* What a level will take is predicted from the medians of the last `MEMORY` frames' stage times, each brought to that
  level: geometry stays, rendering and encoding go with the pixels, filling with pixels, tokens and times, and the
  cameras' images are encoded at levels with context only.
* Down, at once: when the prediction for the present level is above the target, to the highest level predicted to take
  at most `AIM` of it. A single slow frame moves no median, three of five do.
* Up, one level, when the level above is predicted to take at most `AIM` of the target for `patience` frames in a row.
* A step up that has to be taken back within `PROBATION` frames doubles `patience`, up to `MOST_PATIENCE`: so where the
  prediction is wrong, the controller settles below instead of swinging. A step that lasts resets it.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

MEMORY = 5
AIM = 0.85
PATIENCE = 4
MOST_PATIENCE = 256
FIRST_FILL = 0.15
"""Work of a fill without the transformer, relative to all."""
PROBATION = 12


@dataclass(frozen=True)
class Level:
    """What one view is made with."""

    scale: float
    """Of width and height."""
    context_times: int
    """Of the window's times, the latest first; 0: no camera image is encoded."""
    top_k: int | None
    """Context tokens that survive pruning; None for all."""

    @property
    def relative_cost(self) -> float:
        """Work of filling, relative to the full level's."""
        tokens = min(self.top_k or 2048, 2048) / 2048
        if self.context_times == 0:
            return self.scale**2 * FIRST_FILL
        return self.scale**2 * (0.4 + 0.4 * self.context_times / 7 + 0.2 * tokens)


LADDER = (
    *(Level(scale, 0, 256) for scale in (0.25, 0.3, 0.36, 0.42, 0.5, 0.6, 0.7, 0.84, 1.0)),
    Level(1.0, 1, 256),
    Level(1.0, 2, 512),
    Level(1.0, 4, 1024),
    Level(1.0, 7, None),
)
"""From the cheapest level to all."""
FULL = LADDER[-1]


@dataclass(frozen=True)
class FrameMs:
    """Milliseconds of a frame's stages."""

    geometry: float
    pixels: float
    """Rendering, and encoding the picture."""
    filling: float | None
    """None where nothing was to be filled."""
    context: float | None = None
    """Encoding the cameras' images; None at a level without."""

    @property
    def total(self) -> float:
        """All of it."""
        return self.geometry + self.pixels + (self.filling or 0.0) + (self.context or 0.0)


class Budget:
    """Chooses one viewer's level, frame by frame."""

    def __init__(self, target_ms: float, levels: Sequence[Level] = LADDER) -> None:
        """Begin in the middle of the ladder.

        Raises:
            ValueError: a target that is not positive, or no levels.
        """
        if not target_ms > 0 or not levels:
            raise ValueError(f"expected a positive budget and levels, got {target_ms} ms and {len(levels)} levels")
        self.target_ms = target_ms
        self.levels = tuple(levels)
        self.index = len(levels) // 2
        self.measured_ms = 0.0
        # Each brought to the full level, as far as it depends on the level.
        self._geometry, self._pixels, self._filling, self._context = (deque[float](maxlen=MEMORY) for _ in range(4))
        self._patience, self._calm, self._since_up = PATIENCE, 0, PROBATION

    @property
    def level(self) -> Level:
        """What the next view is made with."""
        return self.levels[self.index]

    def predicted_ms(self, level: Level) -> float:
        """What a view of this level would take; 0 before the first frame."""
        filling = level.relative_cost + (_median(self._context) if level.context_times else 0.0)
        return _median(self._geometry) + _median(self._pixels) * level.scale**2 + _median(self._filling) * filling

    def record(self, level: Level, ms: FrameMs) -> None:
        """Learn from a frame, and choose the next one's level."""
        self.measured_ms = ms.total
        self._geometry.append(ms.geometry)
        self._pixels.append(ms.pixels / level.scale**2)
        if ms.filling is not None:
            self._filling.append(ms.filling / level.relative_cost)
        if ms.context is not None and ms.filling:
            # As a share of filling, which is measured at all levels: so it is known how a level without has changed.
            self._context.append(ms.context / (ms.filling / level.relative_cost))
        self._since_up += 1
        if self._since_up == PROBATION:
            self._patience = PATIENCE
        if self.predicted_ms(self.level) > self.target_ms and self.index > 0:
            self._down()
        elif self.index + 1 < len(self.levels):
            fits = self.predicted_ms(self.levels[self.index + 1]) <= AIM * self.target_ms
            self._calm = self._calm + 1 if fits else 0
            if self._calm >= self._patience:
                self.index, self._calm, self._since_up = self.index + 1, 0, 0

    def _down(self) -> None:
        if self._since_up < PROBATION:
            self._patience = min(MOST_PATIENCE, 2 * self._patience)
        good = [n for n in range(self.index) if self.predicted_ms(self.levels[n]) <= AIM * self.target_ms]
        self.index, self._calm, self._since_up = max(good, default=0), 0, PROBATION


def _median(values: Sequence[float]) -> float:
    return median(values) if values else 0.0
