"""Predicts which pixels of a rendered view are wrong, from what is cheap: a few looks along each ray. Ours."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.inpainting.decoder import blend
from viewmend.inpainting.network import Network
from viewmend.inpainting.protocol import RenderQuality
from viewmend.inpainting.sweep.cells import CELL_PX, doubled, halved, nearest_depth, rim_depth, scattered, stacked
from viewmend.inpainting.sweep.lookup import STATS, Rays, Scale, look_up
from viewmend.inpainting.sweep.pyramids import Rig
from viewmend.inpainting.sweep.unet import UNet
from viewmend.views import CompletedView, IncompleteView

SHOWN_CHANNELS = 7
"""RGB, M, what is coloured, the largest of the source views' shares, and the depth in subject sizes."""
DEEPEST = 2.0
"""Depths are told up to so many subject sizes from the median."""
BEHIND = (0.0, 0.012, 0.03, 0.06, 0.11, 0.2, 0.36)
"""Where rays through cells of twice the size are looked at: z-depth behind the proxy, in subject sizes."""
BEHIND_CHANNELS = 24
"""What is kept of all places behind the proxy."""
LEAST_GAIN = 0.01**2
"""Pixels that are expected to change less are never chosen."""
LARGE_PX = 128
"""Root of the area of a subject that half the resolution is enough for, where nothing is read."""
LEAST_FADE = 0.02
"""Pixels that are expected to be background by less are left."""


class ErrorMap(NamedTuple):
    """What is expected of each pixel; 0 beyond the rim about the proxy."""

    wrong: Float[Tensor, "height width"]
    """Probability that a channel of the rendered colour is off by more than a tenth."""
    gain: Float[Tensor, "height width"]
    """Expected square of the change that the reader of whole views makes, mean of the channels."""
    alpha: Float[Tensor, "height width"]
    """How much of the pixel the subject covers."""
    rest: Float[Tensor, "height width"]
    """The gain that is left where the rendered colour was faded by `alpha`."""


def most_wrong(
    view: IncompleteView, gain: Float[Tensor, "height width"], fraction: float
) -> Float[Tensor, "height width"]:
    """1 on the paper's E, and where most is to be gained; at most on `fraction` of the proxy's pixels beside E."""
    first = (gain + view.holes).flatten()
    count = min(int(fraction * int((view.mask > 0).sum())), int((first > LEAST_GAIN).sum()))
    chosen = torch.zeros_like(first).index_fill(0, first.topk(count).indices, 1.0).view_as(view.mask)
    return torch.where(view.holes, 1.0, chosen)


def faded(view: IncompleteView, found: ErrorMap, fraction: float) -> IncompleteView:
    """The view with a soft E: 1 where it must be read, and elsewhere how much of the rendered colour is background.

    Args:
        view: what was rendered.
        found: what is expected of its pixels.
        fraction: at most this part of the proxy's pixels is read, as far as the paper's E is not more.
    """
    read = torch.minimum(most_wrong(view, found.rest, fraction), (view.error > 0).to(view.error))
    background = torch.where((read == 0) & (view.mask > 0), torch.minimum(1 - found.alpha, view.error), 0.0)
    fade = torch.where(background > LEAST_FADE, background, 0.0)
    return replace(view, error=torch.where(read > 0, view.error, fade), fade=fade)


def unread(
    view: IncompleteView, fades: Bool[Tensor, "height width"], fill: Float[Tensor, "3 height width"] | None = None
) -> CompletedView:
    """A view of which nothing is read: what is background fades, and holes show the fill, of which nobody is sure."""
    E, filled = view.error, view.holes if fill is not None else torch.zeros_like(view.holes)
    shown = view.rgb.new_zeros(view.rgb.shape) if fill is None else fill * filled
    return CompletedView(
        view,
        blend(view.rgb, E, shown, (fades | filled).to(E)),
        torch.where(fades, (1 - E) * view.mask, view.mask),
        torch.where(filled, (1 - E) * view.mask, view.mask),
        view.depth,
    )


class ErrorNet(Network):
    """Convolutions over what a view shows, and over what the cameras show at the proxy and behind it."""

    def __init__(self, features: int) -> None:
        """`features` is the number of channels at half the resolution."""
        super().__init__()
        self.behind = nn.Sequential(
            *(nn.Linear(len(BEHIND) * STATS, 32), nn.ReLU(), nn.Linear(32, BEHIND_CHANNELS)),
        )
        self.decide = UNet(CELL_PX**2 * SHOWN_CHANNELS + STATS + BEHIND_CHANNELS, features)
        self.tell = nn.Conv2d(features, CELL_PX**2 * len(ErrorMap._fields), 1)

    def forward(self, view: IncompleteView, rig: Rig, scale: Scale | None = None) -> ErrorMap:
        """What is expected of a view's pixels; of E nothing is looked at.

        Args:
            view: or a part of one.
            rig: the cameras.
            scale: the whole view's, where this is a part of it.
        """
        scale, depth = scale or Scale.of(view), rim_depth(view.depth)
        height, width = depth.shape
        depth = F.pad(depth, (0, -width % (2 * CELL_PX), 0, -height % (2 * CELL_PX)))
        near = nearest_depth(depth)
        stats = self._stats(view, rig, scale, near, (0.0,), CELL_PX)
        away = torch.where(depth > 0, ((depth - scale.depth_m) / scale.size_m).clamp(-DEEPEST, DEEPEST), 0.0)
        shares = view.weights.sum(0) > 0, view.weights.amax(0)
        shown = torch.cat([view.rgb, torch.stack([view.mask, shares[0].to(depth), shares[1]])])
        shown = F.pad(shown, (0, depth.shape[1] - width, 0, depth.shape[0] - height))
        told = [F.pixel_unshuffle(torch.cat([shown, away[None]]), CELL_PX), stats]
        with self.autocast():
            behind = self._stats(view, rig, scale, nearest_depth(near), BEHIND, 2 * CELL_PX, self.behind)
            told.append(F.interpolate(behind[None].float(), scale_factor=2, mode="nearest")[0])
            found = self.tell(self.decide(stacked(*told)))
        found = F.pixel_shuffle(found.float().sigmoid(), CELL_PX)[0, :, :height, :width]
        return ErrorMap(*torch.where(depth[:height, :width] > 0, found, 0.0))

    def expected(self, view: IncompleteView, rig: Rig, quality: RenderQuality) -> ErrorMap:
        """What is expected of a whole view's pixels; a large subject's in half its resolution if nothing is read."""
        if quality.read_fraction != 0 or int((view.mask > 0).sum()) < LARGE_PX**2:
            return self(view, rig)
        rim, small = rim_depth(view.depth) > 0, halved(view)
        found = torch.stack(self(small, rig, Scale.of(view)))
        return ErrorMap(*torch.where(rim, doubled(found, rim_depth(small.depth) > 0, view.mask.shape), 0.0))

    @staticmethod
    def _stats(
        view: IncompleteView,
        rig: Rig,
        scale: Scale,
        near: Float[Tensor, "rows columns"],
        behind: Sequence[float],
        cell_px: int,
        layers: nn.Module | None = None,
    ) -> Float[Tensor, "channel rows columns"]:
        """An image of what cameras show in cells of this side, so far behind their nearest depth, in subject sizes."""
        cells = torch.nonzero(near > 0)
        along = near[tuple(cells.T)][:, None] + scale.size_m * near.new_tensor(behind)
        rays = Rays(view.camera, cell_px * (cells.flip(1).double() + 0.5), along)
        stats = look_up(rays, rig, view.source_views, float(cell_px), scale).stats.flatten(1)
        return scattered(stats if layers is None else layers(stats), cells, near.shape)
