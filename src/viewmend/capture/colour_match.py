"""Cameras of one rig made to agree on colours: an affine map of RGB each, from surface that several of them see.

The maps are fitted together by iteratively reweighted least squares (Huber, "Robust estimation of a location
parameter", 1964; for photographs that overlap: Brown and Lowe, "Automatic panoramic image stitching", 2007, 4): what is
seen of a point by all its cameras shall be of one colour. The mean map of all cameras stays the identity: nobody knows
which of them is right.
"""

from dataclasses import dataclass, replace

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from viewmend.capture.reduction import reduced
from viewmend.capture.surface_colours import LEAST_SHARED, SurfaceColours, surface_colours
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import reconstruct
from viewmend.views import MultiViewFrame

LONGEST_PX = 256
"""Images are reduced first: a hull is beside the true surface by some pixels, and few of so small ones."""
HULL = HullConfig(resolution=64)
FEWEST_CAMERAS = 4
"""In smaller rigs too little is left to judge by when a camera is left out."""
INLIER = 0.03
"""Colours farther from the mean than this count less: surface that is not where the hull is, and highlights."""
CLIPPED = 0.98
"""A value above is no measurement: the sensor has no more."""
HELD_TO_IDENTITY = 1e-4
"""How strongly each map is held to the identity, as a share of all points."""
STEPS = 8
TINY = 1e-9
SLABS = 4
"""Points lie in order of space; each of so many parts of the surface is judged by maps fitted to the others."""
WORTH = 0.9
"""Colours that were not fitted to must differ by less than this share of what they did before."""
NOTICED = 0.012
"""Cameras whose colours differ by less are left as they are: what maps cannot tell from the hull's error is as much."""

Maps = Float[Tensor, "view 3 4"]


@dataclass(frozen=True)
class ColourMatch:
    """The map of each camera, and how well cameras agree without and with it."""

    names: tuple[str, ...]
    """The cameras that are mapped."""
    maps: Maps
    """RGB, and 1, to RGB, of values in [0, 1]."""
    before: float
    """Mean distance, in RGB, of the colours that cameras show of a point to their mean."""
    after: float
    """The same in matched colours, for points that the maps were not fitted to."""

    @property
    def helps(self) -> bool:
        """Whether cameras agree better on surface that nothing was fitted to."""
        return self.before > NOTICED and self.after < WORTH * self.before

    @property
    def said(self) -> str:
        """What was done, in words."""
        return (
            f"colours of {len(self.names)} cameras are matched: on the same surface they differed by "
            f"{100 * self.before:.1f} %, and by {100 * self.after:.1f} % now; --no-match-colours leaves them"
        )

    def matched(self, frame: MultiViewFrame) -> MultiViewFrame:
        """The frame in matched colours; cameras without a map stay as they are."""
        rgb = frame.rgb.clone()
        for view, name in enumerate(frame.cameras.names):
            if name in self.names:
                own = self.maps[self.names.index(name)].to(rgb.device)
                values = own[:, :3] @ rgb[view].flatten(1).float() + 255 * own[:, 3:]
                rgb[view] = values.round().clamp(0, 255).to(torch.uint8).view_as(rgb[view])
        return replace(frame, rgb=rgb)


def colour_match(frame: MultiViewFrame, bounds: Bounds | None) -> ColourMatch | None:
    """How these cameras' colours are matched; None where they are too few, or share no surface.

    Args:
        frame: what they saw at one time, with masks; nothing else is looked at.
        bounds: the volume that may hold the subject; None to find it from the masks.
    """
    small = reduced(frame, LONGEST_PX)
    if small.mask is None or len(small.cameras) < FEWEST_CAMERAS:
        return None
    try:
        proxy = reconstruct(small.mask, small.cameras, bounds, HULL)
    except ValueError:
        return None
    colours = surface_colours(small, proxy)
    seen = colours.seen & (colours.rgb.amax(-1) < CLIPPED)
    seen &= seen.sum(0) > 1
    there = seen.sum(1) >= LEAST_SHARED
    if int(there.sum()) < FEWEST_CAMERAS:
        return None
    names = tuple(name for name, enough in zip(small.cameras.names, there.tolist(), strict=True) if enough)
    colours = SurfaceColours(colours.rgb[there].double(), seen[there])
    before, after = _disagreement(colours)
    return ColourMatch(names, _fitted(colours.rgb, colours.seen).float(), before, after)


def _disagreement(colours: SurfaceColours) -> tuple[float, float]:
    """Mean distance of colours from their point's mean, as they are, and matched by the rest of the surface."""
    before, after = [], []
    slab = torch.arange(colours.rgb.shape[1]) * SLABS // colours.rgb.shape[1]
    for number in range(SLABS):
        rgb, seen = colours.rgb[:, slab == number], colours.seen[:, slab == number]
        maps = _fitted(colours.rgb[:, slab != number], colours.seen[:, slab != number])
        before.append(_off(rgb, seen)[seen])
        after.append(_off(_mapped(rgb, maps), seen)[seen])
    return float(torch.cat(before).mean()), float(torch.cat(after).mean())


def _off(rgb: Float[Tensor, "view point 3"], weight: Shaped[Tensor, "view point"]) -> Float[Tensor, "view point"]:
    """How far colours are from the weighted mean of their point."""
    mean = (weight[..., None] * rgb).sum(0) / weight.sum(0).clamp(min=TINY)[:, None]
    return (rgb - mean).norm(dim=-1)


def _fitted(rgb: Float[Tensor, "view point 3"], seen: Bool[Tensor, "view point"]) -> Maps:
    """The maps with which all cameras that see a point see it in one colour."""
    seen = seen & (seen.sum(0) > 1)
    values, weight = torch.cat([rgb, torch.ones_like(rgb[..., :1])], -1), seen.to(rgb)
    maps = _solved(values, weight)
    for _ in range(STEPS):
        weight = seen / (_off(_mapped(rgb, maps), weight) / INLIER).clamp(min=1)
        maps = _solved(values, weight)
    return maps


def _solved(values: Float[Tensor, "view point 4"], weight: Float[Tensor, "view point"]) -> Maps:
    """Least squares of the distances to each point's weighted mean, which is itself of the maps."""
    views, points = weight.shape
    share = weight / weight.sum(0).clamp(min=TINY).sqrt()
    each = rearrange(share[..., None] * values, "view point k -> point (view k)")
    normal = torch.block_diag(*(values.mT @ (weight[..., None] * values))) - each.mT @ each
    held = HELD_TO_IDENTITY * points * torch.eye(4 * views).to(normal)
    identity, mean = torch.eye(4).to(normal).repeat(views, 1), torch.eye(4).to(normal).repeat(1, views)
    system = torch.cat([torch.cat([normal + held, mean.mT], 1), torch.cat([mean, mean.new_zeros(4, 4)], 1)])
    right = torch.cat([-normal @ identity[:, :3], identity.new_zeros(4, 3)])
    change = torch.linalg.solve(system, right)[: 4 * views]
    return rearrange(identity[:, :3] + change, "(view k) channel -> view channel k", k=4)


def _mapped(rgb: Float[Tensor, "view point 3"], maps: Maps) -> Float[Tensor, "view point 3"]:
    return rgb @ maps[..., :3].mT + maps[..., 3][:, None]
