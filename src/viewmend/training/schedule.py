"""How far a run is, how fast it goes, and what that makes of the learning rate and of averages."""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from viewmend.training.plan import Recipe

RECENT_STEPS = 50
"""Rates are of so many last steps."""


def learning_rate_factor(step: int, progress: float, warmup: int) -> float:
    """Linear warm-up, then a cosine to zero as `progress` goes from 0 to 1."""
    return min((step + 1) / warmup, 1.0) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))


def averaging(decay: float) -> Callable[[Sequence[Tensor], Sequence[Tensor], Tensor | int], None]:
    """Moves averages towards weights by 1 - decay; at first faster, to forget what training began with."""

    @torch.no_grad()
    def update(averages: Sequence[Tensor], weights: Sequence[Tensor], count: Tensor | int) -> None:
        kept = min(decay, (1 + int(count)) / (10 + int(count)))
        for average, weight in zip(averages, weights, strict=True):
            average.lerp_(weight, 1 - kept)

    return update


@dataclass(frozen=True)
class Pace:
    """How fast a run goes, over its last steps."""

    samples_per_s: float
    """Samples that the optimiser used, whatever else went on."""
    waiting: float
    """Share of the time in which it waited for samples."""
    eta_s: float | None
    """Until the end, at this pace with all that came between the steps; None before the second."""


class Schedule:
    """The clock of a run that began `before_s` ago."""

    def __init__(self, recipe: Recipe, before_s: float) -> None:
        self.recipe = recipe
        self._began = time.monotonic() - before_s
        self._recent: deque[tuple[float, float, int]] = deque(maxlen=RECENT_STEPS + 1)
        """When each step ended, what it waited, its samples."""
        self._asked = self._waited_s = 0.0

    def elapsed_s(self) -> float:
        """Seconds of the run, of all its parts if it was stopped."""
        return time.monotonic() - self._began

    def progress(self, step: int) -> float:
        """Share of the run before `step`, by steps or minutes, whichever is further."""
        minutes = self.recipe.minutes
        return max(step / self.recipe.steps, self.elapsed_s() / 60 / minutes if minutes else 0.0)

    def wait(self) -> None:
        """A step asks for its samples."""
        if not self._recent:
            self._recent.append((time.monotonic(), 0.0, 0))
        self._asked = time.monotonic()

    def got(self) -> None:
        """The step has its samples."""
        self._waited_s = time.monotonic() - self._asked

    def made(self, step: int, samples: int) -> Pace:
        """`step` steps are made, the last with so many samples: the pace."""
        self._recent.append((time.monotonic(), self._waited_s, samples))
        span_s = max(self._recent[-1][0] - self._recent[0][0], 1e-9)
        counted = list(self._recent)[1:]
        by_steps = (self.recipe.steps - step) * span_s / len(counted)
        minutes = self.recipe.minutes
        by_time = 60 * minutes - self.elapsed_s() if minutes else math.inf
        return Pace(
            sum(n for _, _, n in counted) / span_s,
            sum(waited for _, waited, _ in counted) / span_s,
            max(0.0, min(by_steps, by_time)) if len(counted) > 1 else None,
        )
