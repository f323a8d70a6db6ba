"""Images looked up at pixel positions. Pixel centres are at half-integers, (0.5, 0.5) at the top left."""

from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras


def in_view(
    uv_px: Float[Tensor, "view point 2"], z_m: Float[Tensor, "view point"], cameras: Cameras
) -> Bool[Tensor, "view point"]:
    """Which points, projected to `uv_px` at z-depth `z_m`, lie in front of each camera and inside its image."""
    return (z_m > 0) & (uv_px >= 0).all(-1) & (uv_px < cameras.size_px[:, None]).all(-1)


def sample_bilinear(
    images: Float[Tensor, "view channel height width"],
    uv_px: Float[Tensor, "view point 2"],
    padding: Literal["zeros", "border"] = "zeros",
) -> Float[Tensor, "view point channel"]:
    """Images at pixel positions, each at its own. What lies outside is 0, or the nearest pixel of the border."""
    height, width = images.shape[2:]
    uv_px = uv_px.clamp(-4, 4 * max(width, height))  # no position overflows, and one outside stays outside
    grid = 2 * uv_px / uv_px.new_tensor([width, height]) - 1
    return F.grid_sample(images, grid[:, None], padding_mode=padding, align_corners=False)[:, :, 0].movedim(1, -1)
