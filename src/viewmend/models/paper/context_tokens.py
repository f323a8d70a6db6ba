"""The context of a view: encoded camera images (sections 2 and 9)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.geometry.cameras import Cameras, unproject
from viewmend.models.paper.config import PaperConfig


@dataclass(frozen=True)
class ContextFrame:
    """One camera image, encoded and lifted. It is independent of the novel view, so all viewers share it."""

    camera: Cameras
    """The camera (one view) at that frame."""
    time: int
    """Frame number."""
    places: Int[Tensor, "patch 2"]
    """Row and column of each kept patch."""
    uv_px: Float[Tensor, "patch 2"]
    """Patch centres in the camera's image, in pixels."""
    points_world: Float[Tensor, "patch 3"]
    """Patch centres lifted by the geometry of this frame, in metres."""
    valid: Bool[Tensor, "patch"]
    """Whether that geometry gives the patch a depth."""
    depths: Float[Tensor, "rows cols"]
    """z-depth of every patch of the grid, kept or not, in metres; 0 without depth. Older frames are lifted by it."""
    tokens: Float[Tensor, "patch dim"]
    """R of section 6."""
    keys_values: Float[Tensor, "block 2 patch dim"]
    """K and V of every block, before rotation."""

    @property
    def name(self) -> str:
        """The camera's name."""
        return self.camera.names[0]

    def lifted_by(self, other: "ContextFrame") -> tuple[Float[Tensor, "patch 3"], Bool[Tensor, "patch"]]:
        """This frame's patch centres at the depths of the same camera in `other`, and validity (section 5)."""
        rows, cols = other.depths.shape
        row, col = self.places.unbind(1)
        inside = (row < rows) & (col < cols)
        z = torch.where(inside, other.depths[row.clamp_max(rows - 1), col.clamp_max(cols - 1)], 0.0)
        return unproject(self.uv_px[None], z[None], self.camera)[0], z > 0


def window_times(time: int, config: PaperConfig) -> tuple[int, ...]:
    """Frame numbers of the context of a view at `time`, latest first; none below 0 (section 2).

    `time` itself, the n_c frames before it, and t - k_w j for j from 1 to n_w.
    """
    near = range(time, time - config.n_c - 1, -1)
    far = (time - config.k_w * j for j in range(1, config.n_w + 1))
    return tuple(sorted({t for t in (*near, *far) if t >= 0}, reverse=True))
