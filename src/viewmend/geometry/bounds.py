"""Axis-aligned boxes in the world."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.utils.tensors import OnDevice


@dataclass(frozen=True)
class Bounds(OnDevice):
    """The box between two corners, world coordinates, metres; `low` < `high` on every axis.

    Examples:
        >>> import torch
        >>> from viewmend import Bounds
        >>> Bounds(torch.zeros(3), torch.tensor([2.0, 4.0, 2.0])).center
        tensor([1., 2., 1.])
    """

    keeps_host_copy = True
    low: Float[Tensor, "3"]
    high: Float[Tensor, "3"]

    @property
    def diagonal_m(self) -> float:
        """Distance between opposite corners, metres."""
        return float(self.on_host.size_m.norm())

    @property
    def center(self) -> Float[Tensor, "3"]:
        """The box's middle."""
        return (self.low + self.high) / 2

    @property
    def size_m(self) -> Float[Tensor, "3"]:
        """Edge lengths, metres."""
        return self.high - self.low

    @property
    def corners(self) -> Float[Tensor, "8 3"]:
        """All eight corners."""
        return torch.cartesian_prod(
            *[torch.stack([low, high]) for low, high in zip(self.low, self.high, strict=True)]
        )
