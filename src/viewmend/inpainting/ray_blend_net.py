"""A first guess for the holes that is read from the cameras, pixel by pixel. Ours.

Each missing pixel becomes a convex mix of what could be there: the colours that the cameras show along its ray, a
smooth fill from around it, and background. The network only weighs them.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.threads import heavy_operations, light_operations
from viewmend.inpainting.coarse_fill import CoarseFill, fill
from viewmend.inpainting.ray_sampling import (
    CELL_CHANNELS,
    CELLS,
    OFFSETS,
    RAY_CHANNELS,
    RayFeatures,
    SilhouetteConsistency,
    multi_scale_context,
    sample_along_rays,
    windows,
)
from viewmend.views import ContextViews, IncompleteView

RADIUS_PX = 5
"""How far a pixel looks around in the view."""
WINDOW_CHANNELS = 8
"""RGB, M, E of the view, and RGB of the coarse fill."""
SHOWN_CHANNELS = 7
"""What cameras that see a point agree about: colour, mean colour and mean coverage."""
POINT_FEATURES = 16
"""What is kept of each point of a ray."""
CONTRAST = 10.0
"""Variances of colours are small numbers: shown times this."""
PIXELS_AT_ONCE = 512
"""So many are read together where nothing is learned: with more, buffers are so large that the system hands them out
page by page, each time anew, which takes longer than to compute what is in them."""
PIXELS_STEP = 64
"""Layers work on a multiple of so many: convolutions and GELUs are compiled for each number they meet, which takes as
long, and a server that keeps a thousand of them has a heap full of holes."""


class RayInputs(NamedTuple):
    """All that the network is told of some missing pixels."""

    features: Float[Tensor, "pixel point view 14"]
    """`RayFeatures`, stacked."""
    consistency: Float[Tensor, "pixel point 4"]
    """`SilhouetteConsistency`, stacked."""
    window: Float[Tensor, "pixel 8 11 11"]
    """The view about each pixel: RGB, M, E, and RGB of the coarse fill."""
    surroundings: Float[Tensor, "place 12 11 11"]
    """The `multi_scale_context` of each place that differs."""
    place: Int[Tensor, "pixel"]
    """Index into `surroundings` of each pixel's place."""

    @staticmethod
    def cat(parts: Sequence["RayInputs"]) -> "RayInputs":
        """One after the other; those of fewer cameras get more that see nothing."""
        most = max([1, *(part.features.shape[2] for part in parts)])
        first, whole = 0, []
        for part in parts:
            more = most - part.features.shape[2]
            whole.append(part._replace(features=F.pad(part.features, (0, 0, 0, more)), place=part.place + first))
            first += len(part.surroundings)
        return RayInputs(*(torch.cat(values) for values in zip(*whole, strict=True)))


class RayBlendNet(CoarseFill):
    """Weighs the candidates of each missing pixel."""

    def __init__(self, num_ray_views: int = 8, width: int = 32) -> None:
        super().__init__()
        self.num_ray_views = num_ray_views
        points = len(OFFSETS)
        self.look = nn.Sequential(nn.Linear(RAY_CHANNELS, width), nn.GELU())
        self.compare = nn.Sequential(
            nn.Linear(width + RAY_CHANNELS + 2 * SHOWN_CHANNELS + 3, width),
            nn.GELU(),
            nn.Linear(width, width),
            nn.GELU(),
        )
        self.trust = nn.Linear(width, 1)
        self.point = nn.Sequential(
            nn.Linear(width + 2 * SHOWN_CHANNELS + 5, width), nn.GELU(), nn.Linear(width, POINT_FEATURES)
        )
        widths = (WINDOW_CHANNELS, *(width,) * (RADIUS_PX - 1), 2 * width)
        layers = [(nn.Conv2d(before, after, 3), nn.GELU()) for before, after in pairwise(widths)]
        self.around = nn.Sequential(*(part for layer in layers for part in layer))
        sizes, deep = len(CELLS), 2 * width
        self.far = nn.Sequential(
            *(nn.Conv2d(sizes * CELL_CHANNELS, sizes * 24, 3, groups=sizes), nn.GELU()),
            *(nn.Conv2d(sizes * 24, sizes * width, 3, stride=2, groups=sizes), nn.GELU()),
            *(nn.Conv2d(sizes * width, sizes * deep, 4, groups=sizes), nn.GELU()),
        )
        told = points * POINT_FEATURES + (1 + sizes) * deep
        # Once a pixel, not once a point and camera: width is cheap here, and worth more than anywhere else.
        self.head = nn.Sequential(
            *(nn.Linear(told, 22 * width), nn.GELU()), *(nn.Linear(22 * width, 20 * width), nn.GELU())
        )
        self.choose = nn.Linear(20 * width, points + 2)

    @light_operations()
    def forward(
        self,
        views: Sequence[IncompleteView],
        ray_views: Sequence[ContextViews | None],
        pixels: Sequence[Int[Tensor, "_pixel 2"]] | None = None,
    ) -> list[Float[Tensor, "3 _h _w"]]:
        """The views' images with all missing pixels filled; known pixels stay bit for bit.

        Args:
            views: of any sizes.
            ray_views: cameras at each view's own time; None where there are none, then the surroundings decide alone.
            pixels: read these (row, column) alone, and keep the smooth guess elsewhere; None for all that are missing.
        """
        guesses = [fill(view.rgb, view.error > 0, view.mask > 0) for view in views]
        if pixels is None:
            pixels = [torch.nonzero((view.error > 0) & (view.depth > 0).any()) for view in views]
        seen = [look_around(*own) for own in zip(views, ray_views, pixels, guesses, strict=True)]
        read = self.mix(RayInputs.cat(seen)).split([len(p) for p in pixels])
        return [
            guess.movedim(0, -1).index_put(tuple(at.unbind(1)), rgb).movedim(-1, 0)
            for guess, at, rgb in zip(guesses, pixels, read, strict=True)
        ]

    @heavy_operations()
    def mix(self, told: RayInputs) -> Float[Tensor, "pixel 3"]:
        """The mixed colour of each pixel."""
        size = max(1, len(told.place)) if torch.is_grad_enabled() else PIXELS_AT_ONCE
        with self.autocast():
            far = [self.far(_rounded_up(part)).flatten(1)[: len(part)] for part in told.surroundings.split(size)]
            per_pixel = (told.features, told.consistency, told.window, torch.cat(far)[told.place])
            parts = (values.split(size) for values in per_pixel)
            return torch.cat([self._mix(*part) for part in zip(*parts, strict=True)])

    def _mix(
        self,
        features: Float[Tensor, "pixel point view 14"],
        consistency: Float[Tensor, "pixel point 4"],
        window: Float[Tensor, "pixel 8 11 11"],
        far: Float[Tensor, "pixel feature"],
    ) -> Float[Tensor, "pixel 3"]:
        parts = map(_rounded_up, (features, consistency, window, far))
        return self.mixed(*parts)[: len(features)]

    def mixed(
        self,
        features: Float[Tensor, "pixel point view 14"],
        consistency: Float[Tensor, "pixel point 4"],
        window: Float[Tensor, "pixel 8 11 11"],
        far: Float[Tensor, "pixel feature"],
    ) -> Float[Tensor, "pixel 3"]:
        """The mixed colour of each pixel, all at once; `far` is what `self.far` made of its surroundings."""
        colours, points = self._points(features, consistency)
        hidden = self.head(torch.cat([points.flatten(1), self.around(window).flatten(1), far], 1))
        candidate = F.pad(RayFeatures.unstack(features).in_view.amax((2, 3)) > 0, (0, 2), value=True)
        weights = self.choose(hidden).float().masked_fill(~candidate, -torch.inf).softmax(1)
        coarse_fill = window[:, None, -3:, RADIUS_PX, RADIUS_PX]
        return (weights[..., None] * torch.cat([colours, coarse_fill, 0 * coarse_fill], 1)).sum(1)

    def _points(
        self, features: Float[Tensor, "pixel point view 14"], consistency: Float[Tensor, "pixel point 4"]
    ) -> tuple[Float[Tensor, "pixel point 3"], Float[Tensor, "pixel point feature"]]:
        """Each point's colour, by the cameras that seem to see it, and what speaks for it being there."""
        seen, silhouettes = RayFeatures.unstack(features), SilhouetteConsistency.unstack(consistency)
        shown = torch.cat([seen.colour, seen.mean_colour, seen.mean_coverage], -1)
        # A first opinion on who sees the point: not far behind the proxy, and from about where the view is.
        prior = seen.in_view * (4 * seen.viewing_cosine).exp() * (-4 * seen.depth_difference).sigmoid()
        prior = prior / (prior.sum(2, keepdim=True) + 1e-6)
        mean = (prior * shown).sum(2, keepdim=True)
        variance = CONTRAST * (prior * (shown - mean) ** 2).sum(2, keepdim=True)
        looked = self.look(features)
        together = looked + (prior * looked).sum(2, keepdim=True)
        least = torch.cat([silhouettes.least, silhouettes.least_mean], -1)[:, :, None].expand(*prior.shape[:-1], -1)
        told = [features, mean.expand_as(shown), variance.expand_as(shown), together, least, prior]
        compared = self.compare(torch.cat(told, -1))
        scores = self.trust(compared).float() + (prior + 1e-4).log()
        trust = seen.in_view * scores.masked_fill(seen.in_view == 0, -1e4).softmax(2)
        agreed = (trust * shown).sum(2)
        spread = CONTRAST * (trust * (shown - agreed[:, :, None]) ** 2).sum(2)
        point = [(trust * compared).sum(2), agreed, spread, consistency, (trust**2).sum(2)]
        return agreed[..., :3], self.point(torch.cat(point, -1))


def _rounded_up(values: Float[Tensor, "pixel *feature"]) -> Float[Tensor, "more_pixels *feature"]:
    """The values, and zeros for more pixels behind, up to a multiple of `PIXELS_STEP`."""
    return F.pad(values, (0, 0) * (values.ndim - 1) + (0, -len(values) % PIXELS_STEP))


def look_around(
    view: IncompleteView,
    ray_views: ContextViews | None,
    pixels: Int[Tensor, "pixel 2"],
    guess: Float[Tensor, "3 height width"] | None = None,
) -> RayInputs:
    """All that the network is told of these pixels (row, column): along their rays, and around them in the view.

    `guess` is the view with its holes filled by `coarse_fill.fill`; it is made where it is not given.
    """
    guess = fill(view.rgb, view.error > 0, view.mask > 0) if guess is None else guess
    shown = torch.cat([view.rgb, view.mask[None], view.error[None], guess])
    if ray_views is not None and len(pixels):
        features, consistency = (values.stack() for values in sample_along_rays(view, pixels, ray_views))
    else:
        shape = (len(pixels), len(OFFSETS))
        features, consistency = view.depth.new_zeros(*shape, 0, RAY_CHANNELS), view.depth.new_ones(*shape, 4)
    window = windows(shown, pixels, RADIUS_PX)
    return RayInputs(features, consistency, window, *multi_scale_context(view, guess, pixels))
