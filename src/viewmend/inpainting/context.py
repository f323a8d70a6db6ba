"""What an inpainter remembers of the input cameras (sections 2 and 9)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.geometry.cameras import Cameras, unproject
from viewmend.inpainting.config import InpainterConfig


@dataclass(frozen=True)
class ContextFrame:
    """One camera at one time: its patches, encoded and lifted. It depends on no novel view."""

    camera: Cameras
    """The camera (one view) as it was then."""
    time: int
    places: Int[Tensor, "patch 2"]
    """Row and column of each kept patch."""
    uv_px: Float[Tensor, "patch 2"]
    """Centres of the patches in the camera's image, pixels."""
    points_world: Float[Tensor, "patch 3"]
    """The centres lifted by the geometry of this frame's own time, metres."""
    valid: Bool[Tensor, "patch"]
    """Whether that geometry gave the patch a depth."""
    depths: Float[Tensor, "rows cols"]
    """z-depth of every patch of the grid, kept or not (0: none): carries older frames in the paper's variant."""
    tokens: Float[Tensor, "patch dim"]
    keys_values: Float[Tensor, "block 2 patch dim"]
    """K and V of every block, before rotation."""

    @property
    def name(self) -> str:
        """The camera's name."""
        return self.camera.names[0]

    def lifted_by(self, other: "ContextFrame") -> tuple[Float[Tensor, "patch 3"], Bool[Tensor, "patch"]]:
        """This frame's centres at the depths that the same camera has in `other`: the paper's variant of C_G."""
        rows, cols = other.depths.shape
        row, col = self.places.unbind(1)
        inside = (row < rows) & (col < cols)
        z = torch.where(inside, other.depths[row.clamp_max(rows - 1), col.clamp_max(cols - 1)], 0.0)
        return unproject(self.uv_px[None], z[None], self.camera)[0], z > 0


def window_times(time: int, config: InpainterConfig) -> tuple[int, ...]:
    """The times whose frames are the context of a view at `time`, latest first; none before 0 (section 2).

    `time` itself, the n_c before it, and t - k_w j for j from 1 to n_w.
    """
    near = range(time, time - config.n_c - 1, -1)
    far = (time - config.k_w * j for j in range(1, config.n_w + 1))
    return tuple(sorted({t for t in (*near, *far) if t >= 0}, reverse=True))
