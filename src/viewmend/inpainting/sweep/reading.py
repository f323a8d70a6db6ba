"""What a reader of whole views finds, cell by cell and pixel by pixel."""

from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from viewmend.inpainting.sweep.place_net import Weighed


class Swept(NamedTuple):
    """What was decided for the cells of a view."""

    cells: Int[Tensor, "cell 2"]
    """Row and column."""
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
