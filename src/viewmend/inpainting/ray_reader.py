"""A first guess for the holes that is read from the cameras, pixel by pixel. Ours.

Each missing pixel becomes a convex mix of what could be there: the colours that the cameras show along its ray, a
smooth fill from around it, and background. The network only weighs them.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.inpainting.prefill import fill
from viewmend.inpainting.rays import OFFSETS, RAY_CHANNELS, RaySamples, follow, windows
from viewmend.views import ContextViews, IncompleteView

RADIUS_PX = 5
"""How far a pixel looks around in the view."""
WINDOW_CHANNELS = 8
"""RGB, M, E of the view, and RGB of the smooth guess."""
SHOWN_CHANNELS = 7
"""What cameras that see a point agree about: RGB, and the means around."""
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


class RayReader(nn.Module):
    """Weighs the candidates of each missing pixel."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        points = len(OFFSETS)
        self.look = nn.Sequential(nn.Linear(RAY_CHANNELS, width), nn.GELU())
        self.compare = nn.Sequential(
            nn.Linear(width + RAY_CHANNELS + 2 * SHOWN_CHANNELS + 2, width),
            nn.GELU(),
            nn.Linear(width, width),
            nn.GELU(),
        )
        self.trust = nn.Linear(width, 1)
        self.point = nn.Sequential(
            nn.Linear(width + 2 * SHOWN_CHANNELS + 3, width), nn.GELU(), nn.Linear(width, POINT_FEATURES)
        )
        widths = (WINDOW_CHANNELS, *(width,) * (RADIUS_PX - 1), 2 * width)
        layers = [(nn.Conv2d(before, after, 3), nn.GELU()) for before, after in pairwise(widths)]
        self.around = nn.Sequential(*(part for layer in layers for part in layer))
        self.head = nn.Sequential(
            nn.Linear(points * POINT_FEATURES + 2 * width, 4 * width),
            nn.GELU(),
            nn.Linear(4 * width, 2 * width),
            nn.GELU(),
        )
        self.choose = nn.Linear(2 * width, points + 2)

    def forward(
        self,
        views: Sequence[IncompleteView],
        nearby: Sequence[ContextViews | None],
        pixels: Sequence[Int[Tensor, "_pixel 2"]] | None = None,
    ) -> list[Float[Tensor, "3 _h _w"]]:
        """The views' images with all missing pixels filled; known pixels stay bit for bit.

        Args:
            views: of any sizes.
            nearby: cameras at each view's own time; None where there are none, then the surroundings decide alone.
            pixels: read these (row, column) alone, and keep the smooth guess elsewhere; None for all that are missing.
        """
        guesses = [fill(view.rgb, view.error > 0, view.mask > 0) for view in views]
        if pixels is None:
            pixels = [torch.nonzero((view.error > 0) & (view.depth > 0).any()) for view in views]
        most = max([1, *(len(n.frame.cameras) for n in nearby if n is not None)])
        with torch.autocast(guesses[0].device.type, enabled=False):  # coordinates stay float32
            seen = [look_around(*own) for own in zip(views, nearby, pixels, guesses, strict=True)]
        samples, around = [s.padded(most) for s, _ in seen], torch.cat([a for _, a in seen])
        features, occupancy = torch.cat([s.features for s in samples]), torch.cat([s.occupancy for s in samples])
        size = max(1, len(features)) if torch.is_grad_enabled() else PIXELS_AT_ONCE
        parts = zip(features.split(size), occupancy.split(size), around.split(size), strict=True)
        read = torch.cat([self.mix(RaySamples(f, o), a) for f, o, a in parts]).split([len(p) for p in pixels])
        return [
            guess.movedim(0, -1).index_put(tuple(at.unbind(1)), rgb).movedim(-1, 0)
            for guess, at, rgb in zip(guesses, pixels, read, strict=True)
        ]

    def mix(self, samples: RaySamples, around: Float[Tensor, "pixel 8 11 11"]) -> Float[Tensor, "pixel 3"]:
        """The mixed colour of each pixel."""
        pixels = len(around)
        samples, around = RaySamples(_rounded_up(samples.features), _rounded_up(samples.occupancy)), _rounded_up(around)
        colours, features = self._points(samples)
        hidden = self.head(torch.cat([features.flatten(1), self.around(around).flatten(1)], 1))
        in_view = samples.features[..., 8].amax(2) > 0
        candidate = F.pad(in_view, (0, 2), value=True)
        shares = self.choose(hidden).float().masked_fill(~candidate, -torch.inf).softmax(1)
        guess = around[:, None, 5:, RADIUS_PX, RADIUS_PX]
        return (shares[..., None] * torch.cat([colours, guess, 0 * guess], 1)).sum(1)[:pixels]

    def _points(
        self, samples: RaySamples
    ) -> tuple[Float[Tensor, "pixel point 3"], Float[Tensor, "pixel point feature"]]:
        """Each point's colour, by the cameras that seem to see it, and what speaks for it being there."""
        seen, inside = samples.features, samples.features[..., 8:9]
        shown, fine, cosine = torch.cat([seen[..., :3], seen[..., 10:]], -1), seen[..., 4:5], seen[..., 6:7]
        # A first opinion on who sees the point: not far behind the proxy, and from about where the view is.
        prior = inside * (4 * cosine).exp() * (-4 * fine).sigmoid()
        prior = prior / (prior.sum(2, keepdim=True) + 1e-6)
        mean = (prior * shown).sum(2, keepdim=True)
        variance = CONTRAST * (prior * (shown - mean) ** 2).sum(2, keepdim=True)
        looked = self.look(seen)
        together = looked + (prior * looked).sum(2, keepdim=True)
        occupied = samples.occupancy[..., None, :1].expand_as(prior)
        told = [seen, mean.expand_as(shown), variance.expand_as(shown), together, occupied, prior]
        compared = self.compare(torch.cat(told, -1))
        scores = self.trust(compared).float() + (prior + 1e-4).log()
        trust = inside * scores.masked_fill(inside == 0, -1e4).softmax(2)
        agreed = (trust * shown).sum(2)
        spread = CONTRAST * (trust * (shown - agreed[:, :, None]) ** 2).sum(2)
        features = [(trust * compared).sum(2), agreed, spread, samples.occupancy, (trust**2).sum(2)]
        return agreed[..., :3], self.point(torch.cat(features, -1))


def _rounded_up(values: Float[Tensor, "pixel *feature"]) -> Float[Tensor, "more_pixels *feature"]:
    """With zeros for pixels behind, up to a multiple of `PIXELS_STEP`."""
    return F.pad(values, (0, 0) * (values.ndim - 1) + (0, -len(values) % PIXELS_STEP))


def look_around(
    view: IncompleteView,
    nearby: ContextViews | None,
    pixels: Int[Tensor, "pixel 2"],
    guess: Float[Tensor, "3 height width"] | None = None,
) -> tuple[RaySamples, Float[Tensor, "pixel 8 11 11"]]:
    """All that the reader is told of these pixels (row, column): along their rays, and around them in the view.

    guess: the view filled smoothly (`prefill.fill`), made where it is not given.
    """
    guess = fill(view.rgb, view.error > 0, view.mask > 0) if guess is None else guess
    shown = torch.cat([view.rgb, view.mask[None], view.error[None], guess])
    if nearby is not None and len(pixels):
        samples = follow(view, pixels, nearby)
    else:
        shape = (len(pixels), len(OFFSETS))
        samples = RaySamples(view.depth.new_zeros(*shape, 0, RAY_CHANNELS), view.depth.new_ones(*shape, 2))
    return samples, windows(shown, pixels, RADIUS_PX)
