"""What a reader of whole views finds, cell by cell and pixel by pixel."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.inpainting.decoder import blend
from viewmend.inpainting.sweep.alpha_fit import recomposed, with_slope
from viewmend.inpainting.sweep.cells import CELL_PX, scattered
from viewmend.inpainting.sweep.place_net import Weighed
from viewmend.views import CompletedView, IncompleteView

LEAST_MASK = 0.1
"""Colours upon black are divided by no less than this."""
HOLE_GUESS = 0.7
"""Weight of what `RayBlendNet` reads in holes; the rest is this reader's, which saw few holes in training."""


class Swept(NamedTuple):
    """What was decided for the cells of a view."""

    cells: Int[Tensor, "cell 2"]
    """Row and column."""
    cell_index: Int[Tensor, "rows columns"]
    """Which of them lies there; -1 where none does."""
    depth: Float[Tensor, "rows columns"]
    """The proxy's nearest z-depth in each cell that is read, metres, else 0."""
    logits: Float[Tensor, "cell place"]
    """How much speaks for each place being the surface."""
    weighed: Weighed
    """What was made of each place."""
    decided: Float[Tensor, "1 feature rows columns"]


class Reading(NamedTuple):
    """What was read of a view, pixel by pixel."""

    pixels: Int[Tensor, "pixel 2"]
    """Row and column."""
    rgb: Float[Tensor, "pixel 3"]
    """Upon black."""
    alpha: Float[Tensor, "pixel"]
    confidence: Float[Tensor, "pixel"]
    """Probability that no channel is off by a tenth."""
    depth: Float[Tensor, "pixel"]
    """z-depth, metres."""
    trust: Float[Tensor, "pixel view"]
    """Shares of the cameras."""
    swept: Swept

    def laid_into(
        self,
        view: IncompleteView,
        read: Bool[Tensor, "height width"],
        fades: Bool[Tensor, "height width"],
        alpha_slope: float | Float[Tensor, ""],
        in_holes: Float[Tensor, "3 height width"] | None = None,
    ) -> CompletedView:
        """The view with what was read of it.

        Args:
            view: what was rendered.
            read: which pixels were read.
            fades: which are known to be background in part.
            alpha_slope: what the logits of alpha are multiplied by.
            in_holes: what `RayBlendNet` made of holes; None without.
        """
        E = view.error
        rgb, alpha, confidence, depth = (
            scattered(values, self.pixels, view.mask.shape)
            for values in (self.rgb, self.alpha[:, None], self.confidence[:, None], self.depth[:, None])
        )
        soft = with_slope(alpha, alpha_slope)
        rgb, alpha = recomposed(rgb, alpha[0], soft[0]), soft
        if in_holes is not None:
            rgb = torch.where(read & view.holes, HOLE_GUESS * in_holes + (1 - HOLE_GUESS) * rgb, rgb)
        return CompletedView(
            view,
            blend(view.rgb, E, rgb, (read | fades).to(E)),
            torch.where(read | fades, E * alpha[0] + (1 - E) * view.mask, view.mask),
            torch.where(read, E * confidence[0] + (1 - E), view.mask),
            torch.where(read, depth[0] * (alpha[0] > 0.5), view.depth),
        )


def finer(
    values: Float[Tensor, "cell channel"], swept: Swept, pixels: Int[Tensor, "pixel 2"]
) -> Float[Tensor, "pixel channel"]:
    """The cells' values at pixels, bilinearly; nothing comes from cells that were not read."""
    whole = F.pad(F.pad(values, (0, 1), value=1.0), (0, 0, 0, 1))  # last, a cell of nothing
    own = pixels // CELL_PX
    beside = own + 2 * (pixels % CELL_PX) - 1  # a pixel's middle is a quarter of a cell from its cell's
    last = torch.tensor(swept.cell_index.shape, device=own.device) - 1
    near = ((3 / 4, own), (1 / 4, torch.minimum(beside.clamp(min=0), last)))
    parts = [a * b * whole[swept.cell_index[rows[:, 0], columns[:, 1]]] for a, rows in near for b, columns in near]
    at = torch.stack(parts).sum(0)
    return at[:, :-1] / at[:, -1:].clamp_min(1e-6)


def uncovered(colour: Float[Tensor, "pixel 3"], mask: Float[Tensor, "pixel 1"]) -> Float[Tensor, "pixel 3"]:
    """Colours upon black as they are without it."""
    return (colour / mask.clamp_min(LEAST_MASK)).clamp(0, 1)
