"""Coarse fills: what holes are filled with before the patch transformer; here, smoothly from around them. Ours."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.inpainting.decoder import blend
from viewmend.inpainting.network import Network
from viewmend.inpainting.protocol import ContextProvider, RenderQuality, State
from viewmend.views import CompletedView, ContextViews, IncompleteView

MARGIN_PX = 8
REACH_PX = 2
"""How far the edge of a hole is from what it is filled from."""
THIN_PX = 2 * REACH_PX + 1
"""A hole is thin where no square of this side fits in."""


class CoarseFill(Network):
    """A fill of whole images that keeps known pixels; on its own, an inpainter without a state."""

    num_ray_views = 0
    """Cameras at the view's own time that it looks at."""

    def forward(
        self, views: Sequence[IncompleteView], ray_views: Sequence[ContextViews | None]
    ) -> list[Float[Tensor, "3 _h _w"]]:
        """The views' images with all missing pixels filled; known pixels stay bit for bit."""
        raise NotImplementedError

    def ray_views(self, view: IncompleteView, context: ContextProvider) -> ContextViews | None:
        """The source views and the closest others, at the view's own time; None where it looks at none."""
        names = view.closest_views(self.num_ray_views)
        return context(view.time, names) if names else None

    def crop_margin_px(self, quality: RenderQuality) -> int:
        """More than a fill looks around itself: a crop's border does to it what the black of the view would."""
        return MARGIN_PX

    @torch.no_grad()
    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """The view with its holes filled; a view without holes comes back at once."""
        if not bool((view.error > 0).any()):
            return CompletedView(view, view.rgb), state
        filled = self([view], [self.ray_views(view, context)])[0].float()
        return CompletedView(view, blend(view.rgb, view.error, filled, torch.ones_like(view.mask))), state


class SmoothFill(CoarseFill):
    """`fill` on its own: from the surroundings, no camera is looked at."""

    @property
    def background(self) -> None:
        """It paints upon whatever it is shown."""
        return

    def forward(
        self, views: Sequence[IncompleteView], ray_views: Sequence[ContextViews | None]
    ) -> list[Float[Tensor, "3 _h _w"]]:
        """The views' images with all missing pixels filled; known pixels stay bit for bit."""
        return [fill(view.rgb, view.error > 0, view.mask > 0) for view in views]


def fill(
    rgb: Float[Tensor, "channel height width"],
    missing: Bool[Tensor, "height width"],
    subject: Bool[Tensor, "height width"],
) -> Float[Tensor, "channel height width"]:
    """The image with every missing pixel filled from the others, which stay bit for bit.

    Thin holes take the mean of what is near them, by distance, background too: at a silhouette they are half
    background. Where holes are wide, only the `subject` counts. What is farther than `REACH_PX` from anything known is
    `pull_push`ed from the subject's pixels.
    """
    near, _ = from_near(rgb, ~missing, missing)
    wide = missing & spread(~spread(~missing))
    if not bool(wide.any()):
        return near  # nor is anything out of reach: around what is, a square of THIN_PX is missing
    filled, reached = from_near(rgb, ~missing & subject, missing)
    deep = missing & ~reached
    if bool(deep.any()):
        filled = torch.where(deep, pull_push(filled, ~deep & subject), filled)
    return torch.where(wide, filled, near)


def from_near(
    rgb: Float[Tensor, "channel height width"],
    known: Bool[Tensor, "height width"],
    missing: Bool[Tensor, "height width"],
) -> tuple[Float[Tensor, "channel height width"], Bool[Tensor, "height width"]]:
    """Missing pixels as the mean of the known ones within reach, by distance; and which have any."""
    near = _sum_around(torch.cat([rgb * known, known[None].to(rgb)]))
    colour, weight = near[:-1], near[-1]
    reached = missing & (weight > 0)
    return torch.where(reached, colour / weight.clamp_min(1e-6), rgb), reached


def _sum_around(image: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel height width"]:
    """Sums of the pixels within reach, weighed by a Gaussian of distance (of one pixel's sigma).

    By shifts along each axis: a convolution library spends more on its own order of memory.
    """
    for axis in (1, 2):
        length = image.shape[axis]
        pad = (0, 0, REACH_PX, REACH_PX) if axis == 1 else (REACH_PX, REACH_PX)
        around = F.pad(image, pad)
        image = torch.zeros_like(image)
        for i in range(2 * REACH_PX + 1):
            image.add_(around.narrow(axis, i, length), alpha=math.exp(-0.5 * (i - REACH_PX) ** 2))
    return image


def spread(pixels: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Where a square of `THIN_PX`, around a pixel, holds any of them; there are none beyond the image."""
    for axis, pad in ((0, (0, 0, REACH_PX, REACH_PX)), (1, (REACH_PX, REACH_PX))):
        around, length = F.pad(pixels, pad), pixels.shape[axis]
        pixels = torch.stack([around.narrow(axis, i, length) for i in range(THIN_PX)]).any(0)
    return pixels


def pull_push(
    rgb: Float[Tensor, "channel height width"], known: Bool[Tensor, "height width"]
) -> Float[Tensor, "channel height width"]:
    """The image with every unknown pixel filled smoothly from the known ones; known pixels bit for bit.

    Pull: means of the known pixels at halved resolutions, until one pixel is left. Push: unknown pixels take the
    coarser level's colour, interpolated. Without any known pixel the fill is 0.
    """
    weight = known.to(rgb)[None, None]
    levels = [(rgb[None] * weight, weight)]
    while max(levels[-1][0].shape[2:]) > 1:
        colour, weight = (F.avg_pool2d(x, 2, ceil_mode=True, count_include_pad=False) for x in levels[-1])
        levels.append((colour / weight.clamp_min(1e-6), weight.clamp_max(1)))
        # A coarse pixel with any known one counts in full from here on.
        levels[-1] = (levels[-1][0] * (weight > 0), (weight > 0).to(rgb))
    filled = levels[-1][0]
    for colour, weight in reversed(levels[:-1]):
        coarse = F.interpolate(filled, size=colour.shape[2:], mode="bilinear", align_corners=False)
        filled = torch.where(weight > 0, colour, coarse)
    return torch.where(known, rgb, filled[0])
