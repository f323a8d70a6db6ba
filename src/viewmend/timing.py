"""Milliseconds of the stages that a view goes through."""

import time
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

Times = TypeVar("Times", bound="StageTimes")


@dataclass(frozen=True, kw_only=True)
class StageTimes:
    """Milliseconds of each stage of one view, the device's work included.

    Examples:
        >>> from viewmend import StageTimes
        >>> StageTimes(geometry=30.0) + StageTimes(rendering=20.0)
        StageTimes(geometry=30.0, context=0.0, rendering=20.0, inpainting=0.0)
    """

    geometry: float = 0.0
    """Masks to geometry proxy. The first view of a time pays for it, the others have 0."""
    context: float = 0.0
    """Camera images to encoded context. The first view that needs an image pays for it."""
    rendering: float = 0.0
    """Proxy and images to the incomplete view."""
    inpainting: float = 0.0
    """Incomplete to completed view, without `context`."""

    def __add__(self: Times, other: "StageTimes") -> Times:
        """The stages of both views."""
        return replace(self, **{name: ms + getattr(other, name, 0.0) for name, ms in vars(self).items()})

    @property
    def total(self) -> float:
        """All stages."""
        return sum(vars(self).values())


def now_s(device: torch.device) -> float:
    """Seconds, once the device has done what was asked of it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def ms_since(start: float, device: torch.device) -> float:
    """Milliseconds since `now_s` gave `start`."""
    return 1000 * (now_s(device) - start)
