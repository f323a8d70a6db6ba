"""The depth distribution and the prediction of `ViewSynthNet`."""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.models.compositing import blend
from viewmend.models.views.aggregation import AggregatedSamples
from viewmend.models.views.grid import CELL_PX, scatter_to_image
from viewmend.types import CompletedView, IncompleteView

Plane = Float[Tensor, "height width"]
Image = Float[Tensor, "3 height width"]
Mask = Bool[Tensor, "height width"]
LEAST_MASK = 0.1
"""Lower bound of the mask by which colours on black are divided."""
HOLE_GUESS = 0.7
"""Weight of `RayFill` in holes; `ViewSynthNet`, which saw few holes in training, has the rest."""
VISIBLE = 1 / 16
"""Alpha or colour from which pixels belong to an island."""
TINY, SMALL, FAINT = 0.001, 0.05, 0.6
"""Islands below the first share of the largest one's area are removed, and those below the second if their mean alpha
is below the third: remains of a phantom of the hull that was mostly recognised as one."""


class DepthDistribution(NamedTuple):
    """The depth hypotheses of the cells of a view, judged by their samples and their neighbours."""

    cells: Int[Tensor, "cell 2"]
    """Row and column."""
    cell_index: Int[Tensor, "rows columns"]
    """Index of the cell at each row and column; -1 where there is none."""
    depth: Float[Tensor, "rows columns"]
    """The proxy's nearest z-depth in each cell, metres; 0 where there is no cell."""
    logits: Float[Tensor, "cell sample"]
    """Of the surface being at each depth hypothesis."""
    samples: AggregatedSamples
    features: Float[Tensor, "1 feature rows columns"]
    """Output of the U-Net."""

    def interpolate(
        self, values: Float[Tensor, "cell channel"], pixels: Int[Tensor, "pixel 2"]
    ) -> Float[Tensor, "pixel channel"]:
        """The cells' values at pixels (row, column), bilinearly between existing cells."""
        padded = F.pad(F.pad(values, (0, 1), value=1.0), (0, 0, 0, 1))  # the last row stands for missing cells
        own = pixels // CELL_PX
        next_to = own + 2 * (pixels % CELL_PX) - 1  # a pixel's centre is a quarter of a cell off its cell's
        last = torch.tensor(self.cell_index.shape, device=own.device) - 1
        near = ((3 / 4, own), (1 / 4, torch.minimum(next_to.clamp(min=0), last)))
        parts = [a * b * padded[self.cell_index[rows[:, 0], columns[:, 1]]] for a, rows in near for b, columns in near]
        at = torch.stack(parts).sum(0)
        return at[:, :-1] / at[:, -1:].clamp_min(1e-6)


class ViewPrediction(NamedTuple):
    """The prediction for some pixels of a view."""

    pixels: Int[Tensor, "pixel 2"]
    """Row and column."""
    rgb: Float[Tensor, "pixel 3"]
    """In [0, 1], on black."""
    alpha: Float[Tensor, "pixel"]
    confidence: Float[Tensor, "pixel"]
    """Probability that no channel is off by more than a tenth."""
    depth: Float[Tensor, "pixel"]
    """z-depth, metres."""
    trust: Float[Tensor, "pixel view"]
    """Weights of the cameras."""
    distribution: DepthDistribution

    def composite_into(
        self, view: IncompleteView, predicted: Mask, fades: Mask, fill: Image | None = None, keep_remains: bool = False
    ) -> CompletedView:
        """The rendered view with this prediction: Fhat = E Ftilde + (1 - E) F.

        `predicted` are the pixels of this prediction. Those that are background in part, `fades`, are attenuated by E.
        `fill` is the output of `RayFill`, to blend into holes. `keep_remains` leaves `remains_of_phantoms` in the view.
        """
        E = view.error
        rgb, alpha, confidence, depth = (
            scatter_to_image(values, self.pixels, view.mask.shape)
            for values in (self.rgb, self.alpha[:, None], self.confidence[:, None], self.depth[:, None])
        )
        if fill is not None:
            guess = torch.minimum(HOLE_GUESS * fill + (1 - HOLE_GUESS) * rgb, alpha)  # `fill` has no alpha of its own
            rgb = torch.where(predicted & view.holes, guess, rgb)
        if not keep_remains:
            colour = torch.where(predicted, rgb.amax(0), view.rgb.amax(0))
            keep = ~remains_of_phantoms(colour, torch.where(predicted, alpha[0], view.mask), predicted)
            rgb, alpha, confidence, depth = rgb * keep, alpha * keep, confidence * keep, depth * keep
        return CompletedView(
            view,
            blend(view.rgb, E, rgb, (predicted | fades).to(E)),
            torch.where(predicted | fades, E * alpha[0] + (1 - E) * view.mask, view.mask),
            torch.where(predicted, E * confidence[0] + (1 - E), view.mask),
            torch.where(predicted, depth[0] * (alpha[0] > 0.5), view.depth),
        )


def remains_of_phantoms(colour: Plane, alpha: Plane, predicted: Mask) -> Mask:
    """Small islands around the subject all of whose pixels are `predicted`; `colour` is their largest channel."""
    visible, opacity = (torch.maximum(colour, alpha) > VISIBLE).cpu().numpy(), alpha.float().cpu().numpy()
    count, labels, stats, _ = cv2.connectedComponentsWithStats(visible.astype(np.uint8))
    if count <= 2:
        return torch.zeros_like(predicted)
    area = stats[:, cv2.CC_STAT_AREA]
    share, faint = area / area[1:].max(), np.bincount(labels.ravel(), opacity.ravel()) < FAINT * area
    rendered = np.bincount(labels[~predicted.cpu().numpy()], minlength=count) > 0
    small = ((share < TINY) | ((share < SMALL) & faint)) & ~rendered
    small[0] = False
    return torch.from_numpy(small[labels]).to(predicted.device)


def unpremultiply(colour: Float[Tensor, "pixel 3"], mask: Float[Tensor, "pixel 1"]) -> Float[Tensor, "pixel 3"]:
    """Colours on black, divided by their mask."""
    return (colour / mask.clamp_min(LEAST_MASK)).clamp(0, 1)
