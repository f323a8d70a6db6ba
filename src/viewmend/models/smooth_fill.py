"""Fills holes smoothly from their surroundings; and the base class of fills."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.models.base import ContextProvider, Inpainter, RenderQuality, State
from viewmend.models.compositing import blend
from viewmend.types import CompletedView, IncompleteView

Image = Float[Tensor, "channel height width"]
Pixels = Bool[Tensor, "height width"]
MARGIN_PX = 8
"""More than the distance over which a fill depends on its surroundings: outside a crop, views are black."""
REACH_PX = 2
"""Largest distance along an axis between a pixel near the edge of a hole and the pixels it is filled from."""
THIN_PX = 2 * REACH_PX + 1
"""A hole is thin where no square of this side fits into it."""


class Fill(Inpainter):
    """Base class of inpainters without state that fill all of E."""

    margin_px: int | None = None
    """See `crop_margin_px`."""

    def fill_view(self, view: IncompleteView, context: ContextProvider) -> Float[Tensor, "3 height width"]:
        """Colours for the pixels of E; other pixels are ignored."""
        raise NotImplementedError

    def crop_margin_px(self, quality: RenderQuality) -> int | None:
        """See `Inpainter.crop_margin_px`."""
        return self.margin_px

    @torch.no_grad()
    def step(
        self, view: IncompleteView, context: ContextProvider, state: State
    ) -> tuple[CompletedView, State]:
        """The view with E filled; a view without E is returned as it is."""
        if not bool((view.error > 0).any()):
            return CompletedView(view, view.rgb), state
        filled = self.fill_view(view, context)
        return CompletedView(
            view, blend(view.rgb, view.error, filled, torch.ones_like(view.mask), clamp=False)
        ), state


class SmoothFill(Fill):
    """`fill` as an inpainter: it uses no camera."""

    margin_px = MARGIN_PX

    def fill_view(self, view: IncompleteView, context: ContextProvider) -> Float[Tensor, "3 height width"]:
        """The view's image with all of E filled."""
        return fill(view.rgb, view.error > 0, view.mask > 0).clamp(0, 1)


def fill(rgb: Image, missing: Pixels, subject: Pixels) -> Image:
    """The image with every missing pixel filled from the others, which are unchanged, bit for bit.

    Pixels of thin holes become the mean of known pixels nearby, weighted by distance, background
    included: at a silhouette they are half background. In wide holes only pixels of the `subject`
    count; farther than `REACH_PX` from any of these, holes are filled by `pull_push`.
    """
    wide = wide_holes(missing)
    return fill_wide(rgb, missing, subject, wide) if bool(wide.any()) else fill_thin(rgb, missing)


def wide_holes(missing: Pixels) -> Pixels:
    """The missing pixels that a square of `THIN_PX` of missing pixels contains."""
    return missing & spread(~spread(~missing))


def fill_thin(rgb: Image, missing: Pixels) -> Image:
    """`fill` without wide holes: all missing pixels are within reach of known ones."""
    return from_near(rgb, ~missing, missing)[0]


def fill_wide(rgb: Image, missing: Pixels, subject: Pixels, wide: Pixels) -> Image:
    """`fill` with wide holes."""
    known = ~missing
    near = fill_thin(rgb, missing)
    filled, reached = from_near(rgb, known & subject, missing)
    deep = missing & ~reached
    if bool(deep.any()):
        filled = torch.where(deep, pull_push(filled, ~deep & subject), filled)
    return torch.where(wide, filled, near)


def from_near(rgb: Image, known: Pixels, missing: Pixels) -> tuple[Image, Pixels]:
    """Missing pixels as the weighted mean of the known ones within reach; and which missing pixels have any."""
    near = _sum_around(torch.cat([rgb * known, known[None].to(rgb)]))
    colour = near[:-1]
    weight = near[-1]
    reached = missing & (weight > 0)
    return torch.where(reached, colour / weight.clamp_min(1e-6), rgb), reached


def _sum_around(image: Image) -> Image:
    """Sums over the pixels within reach, weighted by a Gaussian of distance with a sigma of one pixel.

    On the CPU, shifts along each axis are faster than a convolution, which reorders memory.
    """
    if image.device.type != "cpu":
        offset = torch.arange(-REACH_PX, REACH_PX + 1)
        along = (-0.5 * offset**2).exp()
        kernel = torch.outer(along, along).to(image)
        groups = len(image)
        return F.conv2d(image[None], kernel.expand(groups, 1, -1, -1), padding=REACH_PX, groups=groups)[0]
    for axis in (1, 2):
        length = image.shape[axis]
        pad = (0, 0, REACH_PX, REACH_PX) if axis == 1 else (REACH_PX, REACH_PX)
        around = F.pad(image, pad)
        image = around.narrow(axis, REACH_PX, length).clone()
        for i in range(2 * REACH_PX + 1):
            if i != REACH_PX:
                image.add_(around.narrow(axis, i, length), alpha=math.exp(-0.5 * (i - REACH_PX) ** 2))
    return image


def spread(pixels: Pixels) -> Pixels:
    """Where a square of `THIN_PX` around a pixel contains any of them; there are none outside the image."""
    for axis, pad in ((0, (0, 0, REACH_PX, REACH_PX)), (1, (REACH_PX, REACH_PX))):
        pixels = F.pad(pixels, pad).unfold(axis, THIN_PX, 1).any(-1)
    return pixels


def pull_push(rgb: Image, known: Pixels) -> Image:
    """The image with every unknown pixel filled smoothly from the known ones, which are unchanged, bit for bit.

    Pull: means of the known pixels at halved resolutions, down to one pixel. Push: unknown pixels
    get the interpolated colour of the coarser level. Without any known pixel the fill is 0.
    """
    weight = known.to(rgb)[None, None]
    levels = [(rgb[None] * weight, weight)]
    while max(levels[-1][0].shape[2:]) > 1:
        colour, weight = (F.avg_pool2d(x, 2, ceil_mode=True, count_include_pad=False) for x in levels[-1])
        # A coarse pixel with any known one counts in full from here on.
        levels.append((colour / weight.clamp_min(1e-6) * (weight > 0), (weight > 0).to(rgb)))
    filled = levels[-1][0]
    for colour, weight in reversed(levels[:-1]):
        coarse = F.interpolate(filled, size=colour.shape[2:], mode="bilinear", align_corners=False)
        filled = torch.where(weight > 0, colour, coarse)
    return torch.where(known, rgb, filled[0])
