"""Sums over boxes of images, whose sides may be tensors."""

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

    def boxes(
        self, row: Int[Tensor, "*box image row_corner"], column: Int[Tensor, "*box image column_corner"]
    ) -> Float[Tensor, "*box image row column channel"]:
        """Sums between neighbouring corners; corners outside an image are moved to its border."""
        image = torch.arange(self.values.shape[0], device=row.device)[:, None, None]
        rows, columns = self.values.shape[1:3]
        inside_row = row.clamp(0).clamp_max(rows - 1)[..., :, None]
        inside_column = column.clamp(0).clamp_max(columns - 1)[..., None, :]
        corners = self.values.flatten(0, 2)[(image * rows + inside_row) * columns + inside_column]
        return corners.diff(dim=-3).diff(dim=-2)

    def means(
        self,
        u_px: Float[Tensor, "ray sample image"],
        v_px: Float[Tensor, "ray sample image"],
        side: Int[Tensor, ""],
    ) -> Float[Tensor, "ray sample image channel"]:
        """Means over boxes of `side` pixels, bilinear between box centres, 255 as 1; zeros outside an image."""
        x = u_px * (1 / side.double()) - 0.5
        y = v_px * (1 / side.double()) - 0.5
        left = x.floor()
        top = y.floor()
        three_corners = torch.arange(3, device=x.device)
        row = (top.long()[..., None] + three_corners) * side
        column = (left.long()[..., None] + three_corners) * side
        across = torch.stack([1 - (x - left), x - left], -1)
        down = torch.stack([1 - (y - top), y - top], -1)
        weights = (down[..., :, None] * across[..., None, :])[..., None]
        return ((self.boxes(row, column) * weights).sum((-3, -2)) / (255 * side.double() ** 2)).float()
