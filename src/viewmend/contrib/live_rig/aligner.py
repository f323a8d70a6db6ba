"""Synchronisation: groups the cameras' images, which arrive in any order, by the time of their exposure.

There is one frame per tick. Ticks are evenly spaced in time. Each camera contributes
the image that was taken closest to the tick.
"""

import math
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from viewmend.data.camera_images import CameraImages

ABSENT_S = 0.5
"""Groups do not wait for a camera that was silent for more than this many seconds, or for more than
`ABSENT_TICKS` if that is longer."""
ABSENT_TICKS = 1.5
"""A camera that sends one image per tick is never silent for more than this many ticks. At low frame rates,
that is longer than `ABSENT_S`."""
PHASE_GAIN = 0.05
"""Ticks follow the exposures of the cameras: after each group, all later ticks are moved by the median offset
of the group's images from their tick, times this factor."""
FAST_RATIO = 1.5
"""A camera that takes at least this many images per tick is fast: only those nearest to a tick are used."""
EXTRA_GROUPS = 4
"""An `Aligner` keeps as many groups as there are ticks in the time that a group may wait for images, and this
many more. If there are more than that, the oldest are dropped."""


@dataclass(frozen=True)
class TimedImages:
    """One exposure of a camera (image and mask), and when it was taken, on this machine's monotonic clock."""

    taken_s: float
    images: CameraImages


@dataclass
class ImageGroup:
    """The cameras' images of one tick."""

    since_s: float
    """When the first of these images arrived."""
    by_camera: dict[str, TimedImages] = field(default_factory=dict)

    @property
    def spread_s(self) -> float:
        """Time between the first and the last exposure."""
        times = [timed.taken_s for timed in self.by_camera.values()]
        return max(times) - min(times)


@dataclass(frozen=True)
class NearestTick:
    """The tick nearest to an image."""

    number: int
    offset_s: float
    """Time of the image, relative to the tick."""


class Aligner:
    """Groups images by tick. One thread at a time may call it.

    A group is complete when each camera has sent an image for the group's tick or a later tick. Cameras that
    have been silent for the longer of `ABSENT_S` and `ABSENT_TICKS` are not waited for.
    """

    def __init__(self, names: Sequence[str], interval_s: float, tolerance_s: float, wait_s: float) -> None:
        """Set up.

        Args:
            names: the cameras.
            interval_s: time between two ticks.
            tolerance_s: largest difference between the time of an image and its tick.
            wait_s: how long an incomplete group waits for more images.
        """
        self._interval_s = interval_s
        self._tolerance_s = tolerance_s
        self._wait_s = wait_s
        self._absent_s = max(ABSENT_S, ABSENT_TICKS * interval_s)
        self._origin_s: float | None = None
        """Time of tick 0; None before the first image."""
        self._max_groups = EXTRA_GROUPS + math.ceil(wait_s / interval_s)
        self._groups: dict[int, ImageGroup] = {}
        self._last_finished = -math.inf
        """The last tick that was taken or dropped."""
        self._last_tick: dict[str, float] = dict.fromkeys(names, -math.inf)
        """The last tick for which each camera sent an image."""
        self._heard_s: dict[str, float] = dict.fromkeys(names, -math.inf)
        """When each camera's last image arrived."""
        self.counts: dict[str, Counter[str]] = {name: Counter() for name in names}

    def wants(self, taken_s: float, period_s: float) -> bool:
        """Whether an image may be used. From a fast camera, only the image nearest to each tick is used.

        `period_s` is the time between two images of the camera; 0 if it is unknown. Before `put` has set
        tick 0, all images are wanted.
        """
        is_fast = period_s > 0 and self._interval_s >= FAST_RATIO * period_s
        if not is_fast or self._origin_s is None:
            return True
        return abs(self._nearest(taken_s).offset_s) <= period_s / 2

    def _nearest(self, taken_s: float) -> NearestTick:
        """The tick nearest to a time; the first call sets tick 0."""
        if self._origin_s is None:
            self._origin_s = taken_s
        number = math.floor((taken_s - self._origin_s) / self._interval_s + 0.5)
        return NearestTick(number, taken_s - self._origin_s - number * self._interval_s)

    def put(self, name: str, timed: TimedImages, now_s: float) -> None:
        """Add one camera's image. One that is late, in the future or far from its tick is counted and dropped."""
        counts = self.counts[name]
        # An image from the future is dropped before it can affect ticks, and its camera, whose clock is wrong, is
        # not waited for.
        if timed.taken_s > now_s + self._interval_s / 2:
            counts["misaligned"] += 1
            return
        self._heard_s[name] = now_s
        tick = self._nearest(timed.taken_s)
        self._last_tick[name] = max(self._last_tick[name], tick.number)
        if tick.number <= self._last_finished:
            counts["late"] += 1
            return
        if abs(tick.offset_s) > self._tolerance_s:
            counts["misaligned"] += 1
            return

        # Of two images of one camera, keep the one nearer to the tick.
        group = self._groups.setdefault(tick.number, ImageGroup(now_s))
        other = group.by_camera.get(name)
        if other is not None:
            counts["surplus"] += 1
        if other is None or abs(tick.offset_s) < abs(self._nearest(other.taken_s).offset_s):
            group.by_camera[name] = timed
        self._drop_oldest()

    def _drop_oldest(self) -> None:
        while len(self._groups) > self._max_groups:
            oldest = min(self._groups)
            for name in self._groups.pop(oldest).by_camera:
                self.counts[name]["replaced"] += 1
            self._last_finished = oldest

    def take(self, now_s: float) -> list[ImageGroup]:
        """Remove and return the groups that are complete or have waited long enough, the oldest first."""
        if self._origin_s is None:
            return []
        taken: list[ImageGroup] = []
        present = {name for name, heard_s in self._heard_s.items() if heard_s > now_s - self._absent_s}
        for tick in sorted(self._groups):
            group = self._groups[tick]
            is_incomplete = any(self._last_tick[name] < tick for name in present)
            if is_incomplete and now_s < group.since_s + self._wait_s:
                break
            del self._groups[tick]
            self._last_finished = tick
            for name in group.by_camera:
                self.counts[name]["used"] += 1
            for name in present - group.by_camera.keys():
                self.counts[name]["missing"] += 1
            offsets_s = [self._nearest(timed.taken_s).offset_s for timed in group.by_camera.values()]
            self._origin_s += PHASE_GAIN * statistics.median(offsets_s)
            taken.append(group)
        return taken
