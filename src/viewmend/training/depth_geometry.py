"""Geometry as other renderers have it: depth maps of the true surface, with the errors of real ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras

EXACT = 0.35
"""Fraction of depth maps without errors."""


@dataclass(frozen=True, kw_only=True)
class DepthErrors:
    """Errors of the depth maps of one scene; lengths in metres, for people of natural size."""

    bias_m: float = 0.0
    """Added to every depth: below 0 the surface is in front of the true one."""
    noise_m: float = 0.0
    """Standard deviation of independent noise in each pixel."""
    waves_m: float = 0.0
    """Standard deviation of noise that changes over `waves_px`."""
    waves_px: int = 16
    step_m: float = 0.0
    """Depths are rounded to multiples of this; 0 keeps them."""
    smooth_px: int = 0
    """Depths are averaged over squares of this radius, inside the silhouette."""
    grow_px: int = 0
    """Pixels by which the silhouette grows; below 0 it shrinks."""
    holes: float = 0.0
    """Fraction of the surface without depth, in spots."""
    points: float = 0.0
    """Fraction of the pixels that remain, as squares of three pixels, like splatted points; 0 keeps all."""
    behind: bool = False
    """Whether a farther surface shows between the points, instead of none."""
    seed: int = 0
    """Seed of the random numbers of all maps of the scene."""

    @classmethod
    def draw(cls, random: Random) -> "DepthErrors":
        """No errors, or a random mix of all kinds."""
        if random.random() < EXACT:
            return cls()

        def some(most: float) -> float:
            return most * random.random() ** 2 if random.random() < 0.5 else 0.0

        return cls(
            bias_m=random.choice((-1, 1)) * some(0.03),
            noise_m=some(0.01),
            waves_m=some(0.025),
            waves_px=random.choice((6, 12, 24)),
            step_m=some(0.03),
            smooth_px=random.choice((0, 0, 1, 3, 6)),
            grow_px=random.choice((-2, -1, 0, 0, 1, 2, 4)),
            holes=some(0.08),
            points=random.uniform(0.08, 0.4) if random.random() < 0.3 else 0.0,
            behind=random.random() < 0.5,
            seed=random.getrandbits(32),
        )

    def generator(self) -> torch.Generator:
        """The random numbers of the scene's maps, to be passed to `apply` for one map after the other."""
        return torch.Generator().manual_seed(self.seed)

    def apply(
        self, depth: Float[Tensor, "height width"], generator: torch.Generator
    ) -> Float[Tensor, "height width"]:
        """A depth map, 0 where there is no surface, with these errors."""
        there = depth > 0
        if self.smooth_px:
            depth = torch.where(there, _mean(depth, self.smooth_px), 0.0)
        if self.grow_px > 0:
            grown = F.max_pool2d(there[None].float(), 2 * self.grow_px + 1, 1, self.grow_px)[0] > 0
            depth = torch.where(there, depth, _mean(depth, self.grow_px) * grown)
        elif self.grow_px < 0:
            gone = F.max_pool2d((~there)[None].float(), 1 - 2 * self.grow_px, 1, -self.grow_px)[0] > 0
            depth = torch.where(gone, 0.0, depth)
        there = depth > 0
        if self.holes:
            sides = [-(-side // 5) for side in depth.shape]
            spots = torch.rand(1, 1, *sides, generator=generator) < self.holes
            there = there & (F.interpolate(spots.float(), size=depth.shape, mode="bilinear")[0, 0] < 0.5)
        depth = depth + self.bias_m + self.noise_m * torch.randn(depth.shape, generator=generator)
        if self.waves_m:
            sides = [-(-side // self.waves_px) + 1 for side in depth.shape]
            coarse = torch.randn(1, 1, *sides, generator=generator)
            depth = depth + self.waves_m * F.interpolate(coarse, size=depth.shape, mode="bicubic")[0, 0]
        if self.step_m:
            depth = (depth / self.step_m).round() * self.step_m
        depth = torch.where(there, depth.clamp_min(1e-3), 0.0)
        if not self.points:
            return depth
        # Some of the pixels as squares; the nearest square wins.
        kept = (depth > 0) & (torch.rand(depth.shape, generator=generator) < self.points)
        nearest = -F.max_pool2d(-torch.where(kept, depth, torch.inf)[None], 3, 1, 1)[0]
        between = depth + 0.25 * (depth > 0) if self.behind else torch.zeros_like(depth)
        return torch.where(nearest.isinf(), between, nearest)


def _mean(depth: Float[Tensor, "height width"], radius_px: int) -> Float[Tensor, "height width"]:
    """The mean of the depths in a square around each pixel; 0 where there are none."""
    both = torch.stack([depth, (depth > 0).to(depth)])
    total, count = F.avg_pool2d(both[None], 2 * radius_px + 1, 1, radius_px)[0]
    return torch.where(count > 0, total / count.clamp_min(1e-6), 0.0)


@dataclass(frozen=True)
class DepthMaps:
    """Depth maps of cameras as a `DepthProvider`."""

    names: Sequence[str]
    maps: Float[Tensor, "view height width"]

    def depth(self, cameras: Cameras) -> Float[Tensor, "view height width"]:
        """The maps of these cameras."""
        return self.maps[[self.names.index(name) for name in cameras.names]]
