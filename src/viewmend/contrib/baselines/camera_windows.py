"""What cameras see of a window of a novel view: the temporal input of the variant that also shows them (mul).

The paper says only that frames of the other cameras are interleaved. Here each camera gives the part of its image
around the place where the window's centre is on the proxy, at the scale of the view, without its background.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.contrib.baselines.framing import Window
from viewmend.geometry.cameras import pixel_centers, project, unproject
from viewmend.geometry.sampling import sample_bilinear
from viewmend.types import ContextViews, IncompleteView


@dataclass(frozen=True)
class Aim:
    """The point of space that a window looks at, and the size of its pixels there."""

    point: Float[Tensor, "1 3"]
    """World coordinates, metres."""
    pixel_m: Float[Tensor, ""]


def aim(view: IncompleteView, window: Window, size: tuple[int, int]) -> Aim | None:
    """Where the window's centre is, at the median depth of the proxy in it, or else in the view; None without any."""
    for depth in (window.of(view.depth, size), view.depth):
        seen = depth[depth > 0]
        if len(seen):
            z = seen.median()
            centre = torch.tensor([[[window.left + size[1] / 2, window.top + size[0] / 2]]]).to(z)
            point = unproject(centre, z[None, None], view.camera)[0]
            return Aim(point, z / view.camera.K[0, 0, 0])
    return None


def foreground(views: ContextViews) -> Float[Tensor, "view 3 height width"]:
    """The cameras' images in [0, 1], black where there is no subject; without masks, where the proxy is not."""
    mask = (views.depth > 0).float() if views.frame.mask is None else views.frame.mask.float() / 255
    return views.frame.rgb.float() / 255 * mask[:, None]


def camera_windows(
    images: Float[Tensor, "view 3 height width"], views: ContextViews, at: Aim | None, size: tuple[int, int]
) -> Float[Tensor, "view 3 windowheight windowwidth"]:
    """The cameras' images around the aim, in [-1, 1]; black beyond the image.

    A camera that has no such place (behind it, or no aim) gives its whole image, resized.

    Args:
        images: `foreground(views)`.
        views: whose cameras they are.
        at: where the window looks.
        size: height and width of a window.
    """
    height, width = size
    cameras = views.frame.cameras
    extent = cameras.size_px.to(images)
    scale, centre = extent / extent.new_tensor([width, height]), extent / 2
    if at is not None:
        uv, z = project(at.point, cameras)
        near = (cameras.K[:, 0, 0] / z[:, 0] * at.pixel_m)[:, None].expand(-1, 2)
        before = z > 0
        scale, centre = torch.where(before, near, scale), torch.where(before, uv[:, 0], centre)
    offsets = pixel_centers(width, height, images.device) - extent.new_tensor([width / 2, height / 2])
    places = centre[:, None, None] + scale[:, None, None] * offsets
    shown = sample_bilinear(images, places.flatten(1, 2)).movedim(-1, 1).unflatten(2, size)
    return 2 * shown - 1
