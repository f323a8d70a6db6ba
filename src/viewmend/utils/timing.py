"""Timing of the stages of a view."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

Times = TypeVar("Times", bound="StageTimes")
_exact: ContextVar[bool] = ContextVar("exact", default=False)
"""Whether the device is waited for before a time is taken (`exact_times`)."""


@dataclass(frozen=True, kw_only=True)
class StageTimes:
    """Milliseconds of each stage of one view; on a GPU, within `exact_times` including the work there.

    Examples:
        >>> from viewmend import StageTimes
        >>> StageTimes(geometry=30.0) + StageTimes(rendering=20.0)
        StageTimes(geometry=30.0, context=0.0, rendering=20.0, inpainting=0.0)
    """

    geometry: float = 0.0
    """Masks to geometry proxy; 0 except for the first view of a frame."""
    context: float = 0.0
    """Camera images to encoded context; counted in the first view that needs an image."""
    rendering: float = 0.0
    """Proxy and images to the incomplete view."""
    inpainting: float = 0.0
    """Incomplete to completed view, excluding `context`."""

    def __add__(self: Times, other: "StageTimes") -> Times:
        """Sum by stage."""
        return replace(self, **{name: ms + getattr(other, name, 0.0) for name, ms in vars(self).items()})

    @property
    def total(self) -> float:
        """Sum of all stages."""
        return sum(vars(self).values())


@contextmanager
def exact_times() -> Iterator[None]:
    """Wait for the device before each time is taken, so that a stage's time includes its work there.

    Outside of it, a stage's time on a device ends when its work has been handed over, and nothing waits.
    """
    token = _exact.set(True)
    try:
        yield
    finally:
        _exact.reset(token)


def now_s(device: torch.device) -> float:
    """Current time in seconds, within `exact_times` after synchronising the device."""
    if device.type == "cuda" and _exact.get():
        torch.cuda.synchronize(device)
    return time.perf_counter()


def ms_since(start: float, device: torch.device) -> float:
    """Milliseconds since `start`, a value of `now_s`."""
    return 1000 * (now_s(device) - start)
