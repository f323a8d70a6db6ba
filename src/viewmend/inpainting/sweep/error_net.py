"""Predicts which pixels of a rendered view are wrong, from what is cheap: one look along each ray. Ours."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.inpainting.network import Network
from viewmend.inpainting.sweep.cells import CELL_PX, nearest_depth, rim_depth, scattered
from viewmend.inpainting.sweep.lookup import STATS, Rays, Scale, look_up
from viewmend.inpainting.sweep.pyramids import Rig
from viewmend.inpainting.sweep.unet import UNet
from viewmend.views import IncompleteView

SHOWN_CHANNELS = 7
"""RGB, M, what is coloured, the largest of the source views' shares, and the depth in subject sizes."""
DEEPEST = 2.0
"""Depths are told up to so many subject sizes from the median."""

LEAST_GAIN = 0.01**2
"""Pixels that are expected to change less are never chosen."""


class ErrorMap(NamedTuple):
    """What is expected of each pixel; 0 beyond the rim about the proxy."""

    wrong: Float[Tensor, "height width"]
    """Probability that a channel of the rendered colour is off by more than a tenth."""
    gain: Float[Tensor, "height width"]
    """Expected square of the change that the reader of whole views makes, mean of the channels."""


def most_wrong(view: IncompleteView, found: ErrorMap, fraction: float) -> Float[Tensor, "height width"]:
    """E of the rule `wrong`: 1 on the paper's E, and where most is to be gained.

    Args:
        view: what was rendered.
        found: what is expected of its pixels.
        fraction: at most this part of the proxy's pixels, as far as the paper's E is not more.
    """
    first = (found.gain + view.holes).flatten()
    count = min(int(fraction * int((view.mask > 0).sum())), int((first > LEAST_GAIN).sum()))
    chosen = torch.zeros_like(first).index_fill(0, first.topk(count).indices, 1.0).view_as(view.mask)
    return torch.where(view.holes, 1.0, chosen)


class ErrorNet(Network):
    """Convolutions over what a view shows, and over what the cameras show where the proxy is."""

    def __init__(self, features: int) -> None:
        """`features` is the number of channels at half the resolution."""
        super().__init__()
        self.decide = UNet(CELL_PX**2 * SHOWN_CHANNELS + STATS, features)
        self.tell = nn.Conv2d(features, CELL_PX**2 * len(ErrorMap._fields), 1)

    def forward(self, view: IncompleteView, rig: Rig, scale: Scale | None = None) -> ErrorMap:
        """What is expected of a view's pixels; of E nothing is looked at.

        Args:
            view: or a part of one.
            rig: the cameras.
            scale: the whole view's, where this is a part of it.
        """
        scale, depth = scale or Scale.of(view), rim_depth(view.depth)
        (height, width), near = depth.shape, nearest_depth(depth)
        cells = torch.nonzero(near > 0)
        middles = CELL_PX * (cells.flip(1).double() + 0.5)
        rays = Rays(view.camera, middles, near[tuple(cells.T)][:, None])
        stats = look_up(rays, rig, view.source_views, float(CELL_PX), scale).stats[:, 0]
        away = torch.where(depth > 0, ((depth - scale.depth_m) / scale.size_m).clamp(-DEEPEST, DEEPEST), 0.0)
        shares = view.weights.sum(0) > 0, view.weights.amax(0)
        shown = torch.cat([view.rgb, torch.stack([view.mask, shares[0].to(depth), shares[1], away])])
        shown = F.pad(shown, (0, width % CELL_PX, 0, height % CELL_PX))
        told = torch.cat([F.pixel_unshuffle(shown, CELL_PX), scattered(stats, cells, near.shape)])
        with self.autocast():
            found = self.tell(self.decide(told[None]))
        found = F.pixel_shuffle(found.float().sigmoid(), CELL_PX)[0, :, :height, :width]
        return ErrorMap(*torch.where(depth > 0, found, 0.0))
