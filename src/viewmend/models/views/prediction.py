"""The depth distribution and the prediction of `ViewSynthNet`."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.models.compositing import blend
from viewmend.models.views.aggregation import AggregatedSamples
from viewmend.models.views.config import OFFSETS
from viewmend.models.views.grid import CELL_PX, Pixels, scatter_to_image
from viewmend.models.views.pyramids import SceneScale
from viewmend.types import CompletedView, IncompleteView

Plane = Float[Tensor, "height width"]
Image = Float[Tensor, "3 height width"]
Mask = Bool[Tensor, "height width"]
MIN_MASK = 0.1
"""Colours on black are divided by their mask, but by no less than this."""
RAY_FILL_SHARE = 0.7
"""The colour of a hole takes this share from `RayFill`, and the rest from `ViewSynthNet`, which saw
few holes in training."""
SAME_SURFACE = 0.03
"""A pixel shows the surface of its cell if their depths on the proxy differ by less than this, in
subject sizes (`SceneScale.size_m`)."""


@dataclass(frozen=True)
class IslandRule:
    """Which islands around the subject are removed: remains of hull artefacts that the model left visible."""

    visible: float = 1 / 16
    """A pixel belongs to an island if its alpha or its colour is above this."""
    tiny: float = 0.001
    """An island is removed if its area is below this share of the largest one's."""
    small: float = 0.05
    """A faint island is removed if its area is below this share of the largest one's."""
    faint: float = 0.6
    """An island is faint if its mean alpha is below this."""


class DepthDistribution(NamedTuple):
    """The depth hypotheses of the cells of a view, with scores from their samples and their neighbourhood."""

    cells: Int[Tensor, "cell 2"]
    """Row and column of each cell."""
    cell_index: Int[Tensor, "rows columns"]
    """Index of the cell at each row and column; -1 where there is none."""
    proxy_depth: Float[Tensor, "rows columns"]
    """The proxy's nearest z-depth in each cell, metres; 0 where there is no cell."""
    logits: Float[Tensor, "cell sample"]
    """Logits of the surface being at each depth hypothesis."""
    samples: AggregatedSamples
    cameras: Int[Tensor, "cell view"] | None
    """Indices of the source cameras that were sampled in each cell; None for all."""
    features: Float[Tensor, "1 feature rows columns"]
    """Output of the U-Net."""
    cell_px: int = CELL_PX
    """Side of a cell, pixels of the view: larger in magnified views (`grid.LARGE_CELLS_FROM`)."""

    def interpolate(
        self, values: Float[Tensor, "cell channel"], pixels: Pixels
    ) -> Float[Tensor, "pixel channel"]:
        """The cells' values at pixels (row, column), interpolated bilinearly between existing cells."""
        weighted = F.pad(values, (0, 1), value=1.0)  # the last channel sums the weights of existing cells
        image = scatter_to_image(weighted, self.cells, self.cell_index.shape)[None]
        fine = F.interpolate(image, scale_factor=self.cell_px, mode="bilinear", align_corners=False)[0]
        rows, columns = pixels.unbind(1)
        total = fine.movedim(0, 2)[rows, columns]
        return total[:, :-1] / total[:, -1:].clamp_min(1e-6)


class HypothesisMeans(NamedTuple):
    """The depth hypotheses of pixels' rays, interpolated between cells, and means over them."""

    probability: Float[Tensor, "pixel sample"]
    """Probability of the surface being at each hypothesis."""
    rgba: Float[Tensor, "pixel 4"]
    """Mean RGB on black, and mean mask."""

    @classmethod
    def of(cls, distribution: DepthDistribution, pixels: Pixels) -> "HypothesisMeans":
        """Those of pixels (row, column)."""
        probability = distribution.logits.softmax(1)
        cell_rgba = (probability[:, None] @ distribution.samples.rgba)[:, 0]
        found = distribution.interpolate(torch.cat([probability, cell_rgba], 1), pixels)
        return cls(*found.split((len(OFFSETS), 4), 1))


class SurfacePoints(NamedTuple):
    """The points of the surface that some pixels show."""

    cell: Int[Tensor, "pixel"]
    """Index of each pixel's cell."""
    hypothesis: Int[Tensor, "pixel"]
    """Index of the most probable depth hypothesis."""
    probability: Float[Tensor, "pixel"]
    """Its probability."""
    offset: Float[Tensor, "pixel"]
    """Distance behind the proxy in subject sizes: the mean over the most probable hypothesis and
    its neighbours."""
    depth: Float[Tensor, "pixel"]
    """z-depth, metres."""


class ViewPrediction(NamedTuple):
    """The prediction for some pixels of a view."""

    pixels: Pixels
    rgb: Float[Tensor, "pixel 3"]
    """Colours in [0, 1], on black."""
    alpha: Float[Tensor, "pixel"]
    confidence: Float[Tensor, "pixel"]
    """Probability that no channel is off by more than a tenth."""
    depth: Float[Tensor, "pixel"]
    """z-depth, metres."""
    trust: Float[Tensor, "pixel view"]
    """Weights of the cameras."""
    distribution: DepthDistribution

    def composite_into(
        self,
        view: IncompleteView,
        predicted: Mask,
        faded: Mask,
        fill: Image | None = None,
        keep_islands: bool = False,
    ) -> CompletedView:
        """The rendered view with this prediction: Fhat = E Ftilde + (1 - E) F.

        Args:
            view: the rendered view.
            predicted: the pixels of this prediction.
            faded: pixels that are partly background, which are attenuated by E.
            fill: the output of `RayFill`, to blend into holes.
            keep_islands: keep the `artefact_islands`, which are removed otherwise.
        """
        shape = view.mask.shape
        values = [self.rgb, self.alpha[:, None], self.confidence[:, None], self.depth[:, None]]
        planes = scatter_to_image(torch.cat(values, 1), self.pixels, shape)
        if fill is not None:
            mixed = torch.lerp(planes[:3], fill, RAY_FILL_SHARE)
            under_alpha = torch.minimum(mixed, planes[3])  # the fill has no alpha of its own
            rgb = torch.where(predicted & view.holes, under_alpha, planes[:3])
            planes = torch.cat([rgb, planes[3:]])
        if not keep_islands:
            shown = torch.where(predicted, planes[:4], torch.cat([view.rgb, view.mask[None]]))
            islands = artefact_islands(shown, predicted)
            planes = planes if islands is None else planes * ~islands
        rgb = planes[:3]
        alpha, confidence, depth = planes[3:]

        E = view.error
        changed = predicted | faded

        # The confidence of a pixel that is not predicted is 1 on the subject and 0 elsewhere
        return CompletedView(
            view,
            rgb=blend(view.rgb, E, rgb, changed),
            alpha=torch.where(changed, torch.lerp(view.mask, alpha, E), view.mask),
            confidence=torch.where(predicted, torch.addcmul(1 - E, E, confidence), view.mask),
            depth=torch.where(predicted, depth * (alpha > 0.5), view.depth),
        )


def surface_points(
    proxy_depth: Plane,
    scale: SceneScale,
    pixels: Pixels,
    distribution: DepthDistribution,
    shares: Float[Tensor, "pixel sample"],
) -> SurfacePoints:
    """The points that pixels show, by the depth distribution of the cells around them.

    A pixel's point lies behind its own depth on the proxy, or behind that of its cell, if the cell
    has the depth of another surface in front of it. `shares` are the probabilities of the depth hypotheses.
    """
    # The most probable hypothesis, and the mean offset around it
    probability, best = shares.max(1)
    sums = ((shares + 1e-6) @ _sums_of_neighbours().to(shares)).unflatten(1, (2, len(OFFSETS)))
    weighted, weight = sums.gather(2, best[:, None, None].expand(-1, 2, 1)).squeeze(2).unbind(1)
    offset = weighted / weight

    # The depth that the offset is added to: the pixel's own, or that of a nearer surface in its cell
    cell_row, cell_column = (pixels // distribution.cell_px).unbind(1)
    cell = distribution.cell_index[cell_row, cell_column]
    own_depth = proxy_depth[tuple(pixels.T)]
    cell_depth = distribution.proxy_depth[cell_row, cell_column]
    same_surface = (own_depth - cell_depth).abs() < SAME_SURFACE * scale.size_m
    depth = torch.where(same_surface, own_depth, cell_depth) + scale.size_m * offset
    return SurfacePoints(cell, best, probability, offset, depth)


def _sums_of_neighbours() -> Float[Tensor, "sample 28"]:
    """A matrix that sums shares times `OFFSETS` over each depth hypothesis and its neighbours, and shares alone.

    The first and the last hypothesis have one neighbour, and count twice.
    """
    hypothesis = torch.arange(len(OFFSETS))
    around = (hypothesis[:, None] + torch.tensor([-1, 0, 1])).clamp(0, len(OFFSETS) - 1)
    counted = (around[..., None] == hypothesis).sum(1).T
    return torch.cat([counted * torch.tensor(OFFSETS)[:, None], counted], 1)


def artefact_islands(rgba: Float[Tensor, "4 height width"], predicted: Mask) -> Mask | None:
    """Pixels of islands to remove by `IslandRule`; None if there are none.

    All pixels of such an island are `predicted`.
    """
    rule = IslandRule()
    visible = (rgba.amax(0) > rule.visible).cpu().numpy()
    count, labels, stats, _ = cv2.connectedComponentsWithStats(visible.astype(np.uint8))
    if count <= 2:  # the background and at most one island
        return None
    area = stats[:, cv2.CC_STAT_AREA]
    share = area / area[1:].max()
    total_alpha = np.bincount(labels.ravel(), rgba[3].float().cpu().numpy().ravel())
    faint = total_alpha < rule.faint * area
    rendered = np.bincount(labels[~predicted.cpu().numpy()], minlength=count) > 0
    small = (share < rule.tiny) | ((share < rule.small) & faint)
    removed = small & ~rendered
    removed[0] = False  # the background
    if not removed.any():
        return None
    return torch.from_numpy(removed[labels]).to(predicted.device)


def unpremultiply(rgba: Float[Tensor, "*pixel 4"]) -> Float[Tensor, "*pixel 3"]:
    """Colours on black, divided by their mask."""
    return (rgba[..., :3] / rgba[..., 3:].clamp_min(MIN_MASK)).clamp(0, 1)
