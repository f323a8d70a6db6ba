"""Timing of the stages of a view."""

import time
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

Times = TypeVar("Times", bound="StageTimes")


@dataclass(frozen=True, kw_only=True)
class StageTimes:
    """Milliseconds of each stage of one view, including the work on the device.

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


def now_s(device: torch.device) -> float:
    """Current time in seconds, after synchronising the device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def ms_since(start: float, device: torch.device) -> float:
    """Milliseconds since `start`, a value of `now_s`."""
    return 1000 * (now_s(device) - start)
