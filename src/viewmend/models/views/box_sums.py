"""Sums over boxes in images; the sides of the boxes may be tensors."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn import functional as F


class BoxSums(NamedTuple):
    """Sums over all pixels above and left of each pixel corner (summed-area tables, Crow, SIGGRAPH 1984)."""

    values: Float[Tensor, "image corner_row corner_column channel"]

    @classmethod
    def of(cls, images: Shaped[Tensor, "image channel height width"]) -> "BoxSums":
        """The sums of these images."""
        return cls(F.pad(images.movedim(1, 3).double(), (0, 0, 1, 0, 1, 0)).cumsum(1).cumsum(2))

    def means(
        self, uv_px: Float[Tensor, "ray sample image 2"], side: Int[Tensor, ""]
    ) -> Float[Tensor, "ray sample image channel"]:
        """Means over boxes of `side` pixels, divided by 255, and interpolated bilinearly between box centres.

        Images are 0 beyond their borders. The four boxes around a position have nine corners, with a
        weight each.
        """
        position = uv_px * (1 / side.double()) - 0.5
        first = position.floor()
        share = position - first
        corner = (first.long()[..., None] + torch.arange(3, device=uv_px.device)) * side
        column, row = corner.unbind(-2)
        across, down = torch.stack([share - 1, 1 - 2 * share, share], -1).unbind(-2)
        weight = down[..., :, None] * across[..., None, :]
        sums = (weight[..., None] * self._at(row, column)).sum((-3, -2))
        return (sums / (255 * side.double() ** 2)).float()

    def boxes(
        self, row: Int[Tensor, "*box image row_corner"], column: Int[Tensor, "*box image column_corner"]
    ) -> Float[Tensor, "*box image row column channel"]:
        """Sums between neighbouring corners; corners outside an image are moved to its border."""
        return self._at(row, column).diff(dim=-3).diff(dim=-2)

    def _at(
        self, row: Int[Tensor, "*box image row_corner"], column: Int[Tensor, "*box image column_corner"]
    ) -> Float[Tensor, "*box image row_corner column_corner channel"]:
        """Sums above and left of corners; corners outside an image are moved to its border."""
        image = torch.arange(self.values.shape[0], device=row.device)[:, None]
        rows, columns = self.values.shape[1:3]
        inside_row = row.clamp(0, rows - 1)
        inside_column = column.clamp(0, columns - 1)
        first = (image * rows + inside_row) * columns
        return self.values.flatten(0, 2)[first[..., :, None] + inside_column[..., None, :]]
