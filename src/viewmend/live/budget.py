"""Frame time: chooses the quality of a viewer's next view, and keeps waits for other viewers' views short.

docs/live.md describes the ladders of quality levels. The control law of `Budget`:

* The time of a level is predicted from the medians of the last `MEMORY_FRAMES` frames, each stage
  scaled to the level.
* The level goes down as soon as its own prediction is above the target: to the highest level that
  is predicted to take at most `HEADROOM` of the target.
* It goes up by one when the next level is predicted to take at most `HEADROOM` of the target for
  several frames in a row, at first `UP_AFTER_FRAMES`. A step up that is undone within
  `PROBATION_FRAMES` doubles this number, up to `MAX_UP_AFTER_FRAMES`; a step that lasts resets it.
  So the level settles below a wrong prediction.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from statistics import median

from viewmend.live.protocol import FrameTimes
from viewmend.live.quality import Ladder, QualityLevel
from viewmend.models.base import Inpainter

MEMORY_FRAMES = 5
"""Number of the last frames whose median times predict the next."""
HEADROOM = 0.85
"""Fraction of the target that a level may be predicted to take to be chosen."""
UP_AFTER_FRAMES = 4
"""The level first goes up after this many frames in a row with room for the next one."""
MAX_UP_AFTER_FRAMES = 256
"""Largest number of frames with room that a step up can need."""
PROBATION_FRAMES = 12
"""A step up that is undone within this many frames was wrong."""
MAX_WAIT_S = 2.5
"""The resolution is limited so that all waiting viewers, one after the other, are served within this time."""
IDLE_WAIT_S = 1.0
"""Time limit for an image, in seconds, when other viewers are connected but idle."""
MIN_MEASURED_PX = 20_000
"""Images with fewer pixels are not measured: most of their time does not depend on resolution."""
DEFAULT_S_PER_PX = 6e-6
"""Seconds per pixel at full quality before any measurement, as on a slow machine."""
SCALES = (0.25, 0.3, 0.36, 0.42, 0.5, 0.6, 0.7, 0.84, 1.0)
"""Scales of the resolution, from the cheapest level up."""
FULL = QualityLevel(scale=1.0, context_times=None, top_k=None)
"""The highest level: everything that a model can do, as by default in `RenderQuality`."""
CONTEXT_LADDER = Ladder(
    (
        *(QualityLevel(scale, 0, 256) for scale in SCALES),
        QualityLevel(1.0, 1, 256),
        QualityLevel(1.0, 2, 512),
        QualityLevel(1.0, 4, 512),
        FULL,
    ),
    moving=QualityLevel(0.5, 0, 256),
    still=QualityLevel(1.0, 0, None),
)
"""The ladder of models that inpaint holes by attention to context, from less to more context."""
REFINE_LADDER = Ladder(
    (
        *(QualityLevel(scale, None, None, 0.0) for scale in SCALES),
        *(QualityLevel(1.0, None, None, fraction) for fraction in (0.1, 0.25, 0.5)),
        FULL,
    ),
    moving=QualityLevel(1.0, None, None, 0.0),
    still=QualityLevel(1.0, None, None, 0.0),
)
"""The ladder of models that predict errors, from smaller to larger parts of the subject."""


def ladder_for(inpainter: Inpainter) -> Ladder:
    """The ladder of a model: smaller parts of the subject if it predicts errors, less context otherwise."""
    return REFINE_LADDER if inpainter.predicts_errors else CONTEXT_LADDER


class Budget:
    """Chooses the quality level of one viewer, frame by frame."""

    def __init__(self, target_ms: float, levels: Sequence[QualityLevel] = CONTEXT_LADDER.levels) -> None:
        """Start in the middle of the ladder; ValueError if the target is not positive, or there are no levels."""
        if not target_ms > 0 or not levels:
            raise ValueError(
                f"expected a positive budget and levels, got {target_ms} ms and {len(levels)} levels"
            )
        self.budget_ms = target_ms
        """Time that a view may take if there are no other viewers."""
        self.target_ms = target_ms
        """Time that the next view may take."""
        self.levels = tuple(levels)
        self.index = len(levels) // 2
        self.measured_ms = 0.0
        """Time of the last frame."""

        # Times of the last frames, in ms, scaled to the full level where they depend on the level.
        # Context is relative to inpainting.
        self._geometry = deque[float](maxlen=MEMORY_FRAMES)
        self._pixels = deque[float](maxlen=MEMORY_FRAMES)
        self._inpainting = deque[float](maxlen=MEMORY_FRAMES)
        self._context = deque[float](maxlen=MEMORY_FRAMES)

        self._up_after = UP_AFTER_FRAMES
        self._frames_with_room = 0
        self._frames_since_up = PROBATION_FRAMES

    @property
    def level(self) -> QualityLevel:
        """The quality level of the next view."""
        return self.levels[self.index]

    def predict_ms(self, level: QualityLevel) -> float:
        """The predicted time of a view at this level; 0 before the first frame."""
        stages = (self._geometry, self._pixels, self._inpainting, self._context)
        geometry, pixels, inpainting, context = (median(times or (0.0,)) for times in stages)
        cost = level.relative_cost + (0.0 if level.context_times == 0 else context)
        return geometry + pixels * level.scale**2 + inpainting * cost

    def record(self, level: QualityLevel, times: FrameTimes) -> None:
        """Add the measured times of a frame, and choose the level of the next one."""
        self.measured_ms = times.total - times.wait
        self._geometry.append(times.geometry)
        self._pixels.append((times.rendering + times.encode) / level.scale**2)
        if times.inpainting > 0:  # 0 if the view had no holes
            inpainting = times.inpainting / level.relative_cost
            self._inpainting.append(inpainting)
            if level.context_times != 0:
                # Relative to inpainting, which every level measures, so that a level without
                # context follows a device that has become slower.
                self._context.append(times.context / inpainting)
        self._frames_since_up += 1
        if self._frames_since_up == PROBATION_FRAMES:
            self._up_after = UP_AFTER_FRAMES
        if self.predict_ms(self.level) > self.target_ms and self.index > 0:
            if self._frames_since_up < PROBATION_FRAMES:
                self._up_after = min(MAX_UP_AFTER_FRAMES, 2 * self._up_after)
            fitting = [
                n for n in range(self.index) if self.predict_ms(self.levels[n]) <= HEADROOM * self.target_ms
            ]
            self.index = max(fitting, default=0)
            self._frames_with_room = 0
            self._frames_since_up = PROBATION_FRAMES
        elif self.index + 1 < len(self.levels):
            fits = self.predict_ms(self.levels[self.index + 1]) <= HEADROOM * self.target_ms
            self._frames_with_room = self._frames_with_room + 1 if fits else 0
            if self._frames_with_room >= self._up_after:
                self.index += 1
                self._frames_with_room = 0
                self._frames_since_up = 0

    def as_json(self) -> dict[str, float | int | None]:
        """The part `budget` of the message `stats`."""
        return {
            "target_ms": round(self.target_ms, 1),
            "predicted_ms": round(self.predict_ms(self.level), 1),
            "measured_ms": round(self.measured_ms, 1),
            "scale": self.level.scale,
            "top_k": self.level.top_k,
            "context_times": self.level.context_times,
            "refine_fraction": self.level.refine_fraction,
            "level": self.index,
            "levels": len(self.levels),
        }


class ResolutionLimit:
    """Lowers the resolution of views so that no viewer of a server waits too long for another one's image."""

    def __init__(self) -> None:
        self._seconds_per_px: deque[float] = deque(maxlen=16)
        """Seconds per pixel of the last large images, at the full level; the slowest one counts."""

    def record(self, pixels: float | int, level: QualityLevel, seconds: float) -> None:
        """Add the time of an image of this many pixels at this level."""
        if pixels >= MIN_MEASURED_PX:
            self._seconds_per_px.append(seconds / (pixels * _cost_per_px(level)))

    def apply(
        self, level: QualityLevel, pixels: float | int, num_waiting: int, has_other_viewers: bool = False
    ) -> QualityLevel:
        """Lower the resolution of a level if its image is predicted to keep other viewers waiting too long.

        Args:
            level: the level that was chosen for the view.
            pixels: number of pixels of the image at scale 1.
            num_waiting: number of viewers that wait for an image, including this one.
            has_other_viewers: whether others are connected, waiting or not.
        """
        if num_waiting > 1:
            limit_s = MAX_WAIT_S / num_waiting
        elif has_other_viewers:
            limit_s = IDLE_WAIT_S
        else:
            return level
        seconds_per_px = max(self._seconds_per_px, default=DEFAULT_S_PER_PX) * _cost_per_px(level)
        image_s = seconds_per_px * pixels * level.scale**2
        if image_s <= limit_s:
            return level
        return replace(level, scale=level.scale * sqrt(limit_s / image_s))


def _cost_per_px(level: QualityLevel) -> float:
    """Cost of a pixel, relative to one at the full level."""
    return level.relative_cost / level.scale**2
