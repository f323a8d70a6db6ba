"""What an online baseline looks at, and when (Thiry et al. 2024, "Towards Online Real-Time ... Transformers")."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

Frames = Float[Tensor, "_frame 3 height width"]
"""Frames of one time in [-1, 1], 0 in the holes: the view first, then what cameras see, if the variant shows them."""


@dataclass(frozen=True)
class Clip:
    """One window of a stream at all times that a network sees at once (O)."""

    now: Frames
    neighbours: tuple[Frames, ...] = ()
    """The times just before, latest first."""
    references: tuple[Frames, ...] = ()
    """Times further back, latest first."""


@runtime_checkable
class OnlineNetwork(Protocol):
    """A published network that completes the latest frame of a stream."""

    def check_size(self, height: int, width: int) -> None:
        """ValueError for frames of a size that this network cannot take."""
        ...

    def complete_clip(self, clip: Clip) -> Float[Tensor, "3 height width"]:
        """O: the first frame of `clip.now`, filled, in [-1, 1], by a run of the unchanged network on all frames."""
        ...

    def complete_remembering(self, now: Frames, memory: tuple[Any, ...]) -> tuple[Float[Tensor, "3 height width"], Any]:
        """OM: the first frame of `now`, filled, and what later steps remember of this time.

        `memory` is what this method returned at earlier times, oldest first.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Which past times a network looks at."""

    neighbours: int = 3
    """The times just before the view's."""
    references: int = 3
    """Times further back, `step` apart."""
    step: int = 10
    """Frames between references."""
    grid: Literal["absolute", "relative"] = "absolute"
    """References are the latest multiples of `step` (as Thiry et al. do), or `step`, 2 `step`, ... frames back (as the
    paper on multi-view inpainting writes)."""

    def __post_init__(self) -> None:
        if min(self.neighbours, self.references) < 0 or self.step < 1:
            raise ValueError(f"expected neighbours and references of 0 or more and a step of 1 or more, got {self}")

    def neighbour_times(self, time: int) -> tuple[int, ...]:
        """The times just before `time`, latest first, none before 0."""
        return tuple(range(time - 1, max(time - self.neighbours, 0) - 1, -1))

    def reference_times(self, time: int) -> tuple[int, ...]:
        """The times further back, latest first, none before 0 and none of the neighbours."""
        if self.grid == "relative":
            times = [time - self.step * j for j in range(1, self.references + 1)]
            return tuple(t for t in times if 0 <= t < time - self.neighbours)
        latest = (time - self.neighbours - 1) // self.step
        return tuple(self.step * j for j in range(latest, latest - self.references, -1) if j >= 0)

    def times(self, time: int) -> tuple[int, ...]:
        """All past times that a view at `time` looks at, latest first."""
        return self.neighbour_times(time) + self.reference_times(time)

    def is_wanted_after(self, past: int, time: int) -> bool:
        """Whether a view later than `time` may look at the time `past`."""
        if self.grid == "relative":
            return time - past < max(self.neighbours, self.step * self.references)
        # What the next view leaves out no later one takes: its multiples only move on.
        return past in self.times(time + 1)
