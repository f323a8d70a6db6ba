"""Predicts which pixels of a rendered view are wrong, from a few samples per ray."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.models.base import ErrorMap, RenderQuality
from viewmend.models.compositing import blend
from viewmend.models.network import Network
from viewmend.models.views.config import NUM_STATISTICS
from viewmend.models.views.grid import (
    CELL_PX,
    UNet,
    concatenate_channels,
    downsample2x,
    nearest_depth,
    scatter_to_image,
    upsample2x,
)
from viewmend.models.views.pyramids import SceneScale, SourceCameras
from viewmend.models.views.sampler import Rays, sample_rays
from viewmend.types import CompletedView, IncompleteView

IMAGE_CHANNELS = 7
"""A pixel has this many inputs: RGB, M, whether it is coloured, its largest source weight, and its
relative depth."""
DEEPEST = 2.0
"""Depths are clamped to this many subject sizes around the median."""
BEHIND = (0.0, 0.012, 0.03, 0.06, 0.11, 0.2, 0.36)
"""Rays of cells of 4 x 4 pixels are sampled at these z-depths behind the proxy, in subject sizes."""
BEHIND_CHANNELS = 24
"""The network keeps this many features of the samples behind the proxy."""
LARGE_PX = 128
"""A subject is judged at half the resolution if nothing is re-synthesised and the root of its area
is at least this, pixels."""


def fallback_view(
    view: IncompleteView,
    faded: Bool[Tensor, "height width"],
    fill: Float[Tensor, "3 height width"] | None = None,
) -> CompletedView:
    """The view without a prediction: background is attenuated, and holes get `fill` with a confidence of 0."""
    if fill is None:
        filled = torch.zeros_like(view.holes)
        rgb = torch.zeros_like(view.rgb)
    else:
        filled = view.holes
        rgb = fill * filled
    E = view.error
    return CompletedView(
        view,
        rgb=blend(view.rgb, E, rgb, (faded | filled).to(E)),
        alpha=torch.where(faded, (1 - E) * view.mask, view.mask),
        confidence=torch.where(filled, (1 - E) * view.mask, view.mask),
        depth=view.depth,
    )


class ErrorPredictor(Network):
    """Convolutions over the rendered view and the statistics of ray samples at the proxy and behind it."""

    def __init__(self, features: int) -> None:
        """`features` is the number of channels at half the resolution."""
        super().__init__()
        self.behind = nn.Sequential(
            nn.Linear(len(BEHIND) * NUM_STATISTICS, 32),
            nn.ReLU(),
            nn.Linear(32, BEHIND_CHANNELS),
        )
        self.unet = UNet(CELL_PX**2 * IMAGE_CHANNELS + NUM_STATISTICS + BEHIND_CHANNELS, features)
        self.head = nn.Conv2d(features, CELL_PX**2 * len(ErrorMap._fields), 1)

    def forward(
        self, view: IncompleteView, sources: SourceCameras, scale: SceneScale | None = None
    ) -> ErrorMap:
        """Predicted errors of a view's pixels; its E is not used. For a crop, `scale` is that of the whole view."""
        if scale is None:
            scale = SceneScale.of(view)
        height, width = view.depth.shape
        right = -width % (2 * CELL_PX)
        below = -height % (2 * CELL_PX)
        depth = F.pad(view.depth_with_rim, (0, right, 0, below))
        near = nearest_depth(depth)

        # The rendered view: the pixels of each cell as channels
        coloured = (view.weights.sum(0) > 0).to(depth)
        image = torch.cat([view.rgb, torch.stack([view.mask, coloured, view.weights.amax(0)])])
        around_median = ((depth - scale.depth_m) / scale.size_m).clamp(-DEEPEST, DEEPEST)
        relative = torch.where(depth > 0, around_median, 0.0)
        pixels = torch.cat([F.pad(image, (0, right, 0, below)), relative[None]])

        # Agreement of the cameras at the proxy, and in coarser cells behind it
        at_proxy = self._statistics(view, sources, scale, near, (0.0,), CELL_PX)
        with self.autocast():
            coarse = nearest_depth(near)
            behind = self._statistics(view, sources, scale, coarse, BEHIND, 2 * CELL_PX, self.behind)
            behind = F.interpolate(behind[None].float(), scale_factor=2, mode="nearest")[0]
            inputs = concatenate_channels(F.pixel_unshuffle(pixels, CELL_PX), at_proxy, behind)
            logits = self.head(self.unet(inputs))
        errors = F.pixel_shuffle(logits.float().sigmoid(), CELL_PX)[0, :, :height, :width]
        return ErrorMap(*torch.where(depth[:height, :width] > 0, errors, 0.0))

    def predict(self, view: IncompleteView, sources: SourceCameras, quality: RenderQuality) -> ErrorMap:
        """Predicted errors of a whole view; of a large subject at half the resolution if nothing is re-synthesised."""
        if quality.refine_fraction != 0 or int((view.mask > 0).sum()) < LARGE_PX**2:
            return self(view, sources)
        small = downsample2x(view)
        errors = torch.stack(self(small, sources))
        upsampled = upsample2x(errors, small.depth_with_rim > 0, view.mask.shape)
        return ErrorMap(*torch.where(view.depth_with_rim > 0, upsampled, 0.0))

    @staticmethod
    def _statistics(
        view: IncompleteView,
        sources: SourceCameras,
        scale: SceneScale,
        near: Float[Tensor, "rows columns"],
        behind: Sequence[float],
        cell_px: int,
        layers: nn.Module | None = None,
    ) -> Float[Tensor, "channel rows columns"]:
        """An image of cells with the statistics of samples at distances `behind` the nearest depth of each cell."""
        cells = torch.nonzero(near > 0)
        z = scale.depths_behind(near[tuple(cells.T)], behind)
        rays = Rays(view, scale, cells, z, cell_px=cell_px)
        statistics = sample_rays(rays, sources, float(cell_px)).statistics.flatten(1)
        features = statistics if layers is None else layers(statistics)
        return scatter_to_image(features, cells, near.shape)
