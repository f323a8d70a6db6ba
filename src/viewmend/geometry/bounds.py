"""Axis-aligned boxes in the world."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Bounds:
    """The box between two corners, world coordinates, metres; `low` < `high` on every axis."""

    low: Float[Tensor, "3"]
    high: Float[Tensor, "3"]

    @property
    def center(self) -> Float[Tensor, "3"]:
        """The box's middle."""
        return (self.low + self.high) / 2

    @property
    def size_m(self) -> Float[Tensor, "3"]:
        """Edge lengths, metres."""
        return self.high - self.low

    def grown(self, fraction: float) -> "Bounds":
        """The box with every side longer by `fraction` of its length, about the same centre."""
        margin = self.size_m * (fraction / 2)
        return Bounds(self.low - margin, self.high + margin)

    def to(self, device: torch.device | str) -> "Bounds":
        """The same box on `device`."""
        return replace(self, low=self.low.to(device), high=self.high.to(device))
