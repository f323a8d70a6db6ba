"""Holding a frame time: the quality of the next view is chosen by what the last views took.

The control law, docs/live.md in code:

* The ladder has quality levels from a small picture without context up to all that the model can do. Going down,
  older context is given up first, then context tokens, then all context, then resolution. With a model that tells
  where most is to be gained, it is the part of the subject that is read, then resolution.
* The time that a level will take is predicted from the medians of the last `MEMORY_FRAMES` frames. Each stage is scaled
  to the level: geometry stays, rendering and encoding grow with the pixels, inpainting grows with pixels, tokens and
  times. The context stage counts at levels with context only.
* The level goes down at once when its own prediction is above the target. It goes to the highest level that is
  predicted to take at most `HEADROOM` of the target. One slow frame moves no median; three of five do.
* The level goes up by one when the next level is predicted to take at most `HEADROOM` of the target for several frames
  in a row: `UP_AFTER_FRAMES`, to begin with.
* A step up that is taken back within `PROBATION_FRAMES` doubles this number, up to `MAX_UP_AFTER_FRAMES`. A step that
  lasts resets it. Where a prediction is wrong, the level settles below and does not swing.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from viewmend.inpainting.protocol import ViewInpainter
from viewmend.live.protocol import FrameTimes

MEMORY_FRAMES = 5
HEADROOM = 0.85
UP_AFTER_FRAMES = 4
MAX_UP_AFTER_FRAMES = 256
PROBATION_FRAMES = 12
COARSE_FILL_COST = 0.15
"""Cost of a fill without the transformer, relative to the full level's."""
READING_FIXED, READING_COST = 0.1, 0.3
"""Costs of what no resolution changes, and of reading however little, relative to reading all."""
FADING_FIXED, FADING_COST = 0.05, 0.13
"""The same costs of finding out what is background, where nothing is read."""


@dataclass(frozen=True)
class QualityLevel:
    """What one view is made with."""

    scale: float
    """Factor of width and height."""
    context_times: int
    """How many times of the window are context, the latest first; 0: no camera image is encoded."""
    top_k: int | None
    """Context tokens that survive pruning; None for all."""
    read_fraction: float | None = None
    """The part of the subject that is read; None for all that the error rule asks. With 0 background fades alone."""

    @property
    def relative_cost(self) -> float:
        """Cost of inpainting, relative to the full level's."""
        if self.read_fraction == 0:
            return FADING_FIXED + self.scale**2 * FADING_COST
        if self.read_fraction is not None:
            read = (1 - READING_FIXED - READING_COST) * self.read_fraction
            return READING_FIXED + self.scale**2 * (READING_COST + read)
        tokens = min(self.top_k or 2048, 2048) / 2048
        if self.context_times == 0:
            return self.scale**2 * COARSE_FILL_COST
        return self.scale**2 * (0.4 + 0.4 * self.context_times / 7 + 0.2 * tokens)


FULL = QualityLevel(1.0, 7, None)


@dataclass(frozen=True)
class Ladder:
    """What views may be made with, for one kind of model."""

    levels: tuple[QualityLevel, ...]
    """The cheapest first; the last is `FULL`."""
    moving: QualityLevel
    """What a moving view is made with where there is no budget."""
    still: QualityLevel
    """What a view that has been still for a moment is made with: sharp, but soon there."""


SCALES = (0.25, 0.3, 0.36, 0.42, 0.5, 0.6, 0.7, 0.84, 1.0)
CONTEXT_LADDER = Ladder(
    (
        *(QualityLevel(scale, 0, 256) for scale in SCALES),
        QualityLevel(1.0, 1, 256),
        QualityLevel(1.0, 2, 512),
        QualityLevel(1.0, 4, 1024),
        FULL,
    ),
    moving=QualityLevel(0.5, 0, 256),
    still=QualityLevel(1.0, 0, None),
)
READING_LADDER = Ladder(
    (
        *(QualityLevel(scale, 7, None, 0.0) for scale in SCALES),
        *(QualityLevel(1.0, 7, None, fraction) for fraction in (0.1, 0.25, 0.5)),
        FULL,
    ),
    moving=QualityLevel(1.0, 7, None, 0.0),
    still=QualityLevel(1.0, 7, None, 0.0),
)


def ladder_for(inpainter: ViewInpainter) -> Ladder:
    """The ladder of a model; one that has `tells_errors` reads a part of the subject, others use less context."""
    return READING_LADDER if getattr(inpainter, "tells_errors", False) else CONTEXT_LADDER


class Budget:
    """Chooses one viewer's quality level, frame by frame."""

    def __init__(self, target_ms: float, levels: Sequence[QualityLevel] = CONTEXT_LADDER.levels) -> None:
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
        # Each is scaled to the full level, as far as it depends on the level.
        self._geometry, self._pixels, self._inpainting, self._context = (
            deque[float](maxlen=MEMORY_FRAMES) for _ in range(4)
        )
        self._up_after, self._frames_with_room, self._frames_since_up = UP_AFTER_FRAMES, 0, PROBATION_FRAMES

    @property
    def level(self) -> QualityLevel:
        """What the next view is made with."""
        return self.levels[self.index]

    def predicted_ms(self, level: QualityLevel) -> float:
        """What a view of this level would take; 0 before the first frame."""
        inpainting = level.relative_cost + (_median(self._context) if level.context_times else 0.0)
        return _median(self._geometry) + _median(self._pixels) * level.scale**2 + _median(self._inpainting) * inpainting

    def record(self, level: QualityLevel, times: FrameTimes) -> None:
        """Learn from a frame, and choose the next one's level."""
        self.measured_ms = times.total - times.wait
        self._geometry.append(times.geometry)
        self._pixels.append((times.rendering + times.encode) / level.scale**2)
        if times.inpainting > 0:  # else nothing was to be filled
            inpainting = times.inpainting / level.relative_cost
            self._inpainting.append(inpainting)
            if level.context_times:
                # Relative to inpainting, which all levels measure: so a level without context learns of a slow device.
                self._context.append(times.context / inpainting)
        self._frames_since_up += 1
        if self._frames_since_up == PROBATION_FRAMES:
            self._up_after = UP_AFTER_FRAMES
        if self.predicted_ms(self.level) > self.target_ms and self.index > 0:
            self._down()
        elif self.index + 1 < len(self.levels):
            fits = self.predicted_ms(self.levels[self.index + 1]) <= HEADROOM * self.target_ms
            self._frames_with_room = self._frames_with_room + 1 if fits else 0
            if self._frames_with_room >= self._up_after:
                self.index, self._frames_with_room, self._frames_since_up = self.index + 1, 0, 0

    def as_json(self) -> dict[str, float | int | None]:
        """The part `budget` of the message `stats`."""
        return {
            "target_ms": round(self.target_ms, 1),
            "predicted_ms": round(self.predicted_ms(self.level), 1),
            "measured_ms": round(self.measured_ms, 1),
            "scale": self.level.scale,
            "top_k": self.level.top_k,
            "context_times": self.level.context_times,
            "read_fraction": self.level.read_fraction,
            "level": self.index,
            "levels": len(self.levels),
        }

    def _down(self) -> None:
        if self._frames_since_up < PROBATION_FRAMES:
            self._up_after = min(MAX_UP_AFTER_FRAMES, 2 * self._up_after)
        good = [n for n in range(self.index) if self.predicted_ms(self.levels[n]) <= HEADROOM * self.target_ms]
        self.index, self._frames_with_room, self._frames_since_up = max(good, default=0), 0, PROBATION_FRAMES


def _median(values: Sequence[float]) -> float:
    return median(values) if values else 0.0
