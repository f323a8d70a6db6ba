"""How a view of any size is given to a network of one size, and what cameras see of a window of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d, pad

from viewmend.geometry.cameras import pixel_centers, project, unproject
from viewmend.geometry.sampling import sample_bilinear
from viewmend.types import ContextViews, IncompleteView

Image = Float[Tensor, "3 height width"]
DILATION_PX = 4
"""Number of dilations of the holes by a 3 x 3 cross before a frame is input."""


@dataclass(frozen=True)
class Canvas:
    """A view as input to a network: in [-1, 1], 0 in the holes, which are dilated."""

    image: Image
    holes: Bool[Tensor, "height width"]
    """What must be filled, before dilation."""


@dataclass(frozen=True)
class Window:
    """The top left corner of a part of a canvas; its size is the network's."""

    top: int
    left: int

    def of(self, picture: Shaped[Tensor, "*stack height width"], size: tuple[int, int]) -> Tensor:
        """That part of an image."""
        return picture[..., self.top : self.top + size[0], self.left : self.left + size[1]]


def resized_canvas(
    rgb: Image, missing: Bool[Tensor, "height width"], size: tuple[int, int], dilation_px: int
) -> Canvas:
    """The whole view at this (height, width): colours bicubic, holes by the nearest pixel, as the authors do."""
    small = interpolate(missing[None, None].float(), size=size, mode="nearest-exact")[0, 0] > 0
    return _canvas(resized(rgb, size), small, dilation_px)


def window_canvas(
    rgb: Image, missing: Bool[Tensor, "height width"], size: tuple[int, int], dilation_px: int
) -> Canvas:
    """The view in its own resolution; one smaller than `size` gets black pixels at the right and bottom."""
    below, right = (max(0, least - side) for least, side in zip(size, rgb.shape[1:], strict=True))
    return _canvas(pad(rgb, (0, right, 0, below)), pad(missing, (0, right, 0, below)), dilation_px)


def windows_over(
    holes: Bool[Tensor, "height width"], size: tuple[int, int], overlap_px: int
) -> tuple[Window, ...]:
    """The windows of a grid that are needed for the holes.

    The grid has the fewest evenly spaced windows that cover the canvas with at least this overlap.
    It depends on sizes alone, so a stream has the same windows at each time. The middles of
    overlaps divide the canvas among the windows; a window is needed if its part has a hole.
    """
    rows, cols = (_grid(length, side, overlap_px) for length, side in zip(holes.shape, size, strict=True))
    return tuple(
        Window(top, left)
        for top, above, below in rows
        for left, before, behind in cols
        if bool(holes[above:below, before:behind].any())
    )


def stitch(
    pieces: Sequence[Image], windows: Sequence[Window], canvas: tuple[int, int], overlap_px: int
) -> Float[Tensor, "3 canvasheight canvaswidth"]:
    """The windows' images in one; in overlaps, weights fall towards each window's edge. Elsewhere 0."""
    total = pieces[0].new_zeros(3, *canvas)
    weights = pieces[0].new_zeros(canvas)
    size = (pieces[0].shape[1], pieces[0].shape[2])
    rows, cols = (_ramp(side, overlap_px).to(total) for side in size)
    weight = rows[:, None] * cols
    for piece, window in zip(pieces, windows, strict=True):
        window.of(total, size).add_(weight * piece)
        window.of(weights, size).add_(weight)
    return total / weights.clamp_min(1e-9)


def resized(image: Image, size: tuple[int, int]) -> Float[Tensor, "3 newheight newwidth"]:
    """Bicubic, anti-aliased, in [0, 1]."""
    return interpolate(image[None], size=size, mode="bicubic", antialias=True)[0].clamp(0, 1)


def dilated(holes: Bool[Tensor, "height width"], by_px: int) -> Bool[Tensor, "height width"]:
    """Holes dilated by a 3 x 3 cross, this many times."""
    grown = holes[None].float()
    for _ in range(by_px):
        up_down = max_pool2d(grown, (3, 1), 1, (1, 0))
        left_right = max_pool2d(grown, (1, 3), 1, (0, 1))
        grown = torch.maximum(up_down, left_right)
    return grown[0] > 0


def _canvas(rgb: Image, missing: Bool[Tensor, "height width"], dilation_px: int) -> Canvas:
    return Canvas((2 * rgb - 1) * ~dilated(missing, dilation_px), missing)


def _grid(length: int, side: int, overlap_px: int) -> list[tuple[int, int, int]]:
    """Start of each window along an axis of the canvas, and start and end of its part of the canvas."""
    count = 1 + math.ceil((length - side) / (side - overlap_px))
    starts = [round(i * (length - side) / max(count - 1, 1)) for i in range(count)]
    ends = [0, *((first + second + side) // 2 for first, second in pairwise(starts)), length]
    return list(zip(starts, ends[:-1], ends[1:], strict=True))


def _ramp(side: int, overlap_px: int) -> Float[Tensor, " side"]:
    place = torch.arange(side) + 0.5
    return (torch.minimum(place, side - place) / max(overlap_px, 1)).clamp(max=1)


@dataclass(frozen=True)
class Aim:
    """The point in space at a window's centre, and the size of the view's pixels there."""

    point: Float[Tensor, "1 3"]
    """World coordinates, metres."""
    pixel_m: Float[Tensor, ""]


def aim(view: IncompleteView, window: Window, size: tuple[int, int]) -> Aim | None:
    """The point at the window's centre and the median depth of the proxy in it, or in the view; None without any."""
    for depth in (window.of(view.depth, size), view.depth):
        seen = depth[depth > 0]
        if len(seen):
            z = seen.median()
            centre = torch.tensor([[[window.left + size[1] / 2, window.top + size[0] / 2]]]).to(z)
            point = unproject(centre, z[None, None], view.camera)[0]
            return Aim(point, z / view.camera.K[0, 0, 0])
    return None


def foreground(views: ContextViews) -> Float[Tensor, "view 3 height width"]:
    """The cameras' images in [0, 1], black outside of the masks, or of the proxy if there are none."""
    mask = (views.depth > 0).float() if views.frame.mask is None else views.frame.mask.float() / 255
    return views.frame.rgb.float() / 255 * mask[:, None]


def camera_windows(
    images: Float[Tensor, "view 3 height width"], views: ContextViews, at: Aim | None, size: tuple[int, int]
) -> Float[Tensor, "view 3 windowheight windowwidth"]:
    """The cameras' images around the aim, in [-1, 1]; black beyond the image.

    Without an aim, or with one behind a camera, its whole image is resized instead.
    """
    height, width = size
    cameras = views.frame.cameras
    extent = cameras.size_px.to(images)
    scale = extent / extent.new_tensor([width, height])
    centre = extent / 2
    if at is not None:
        uv, z = project(at.point, cameras)
        near = (cameras.K[:, 0, 0] / z[:, 0] * at.pixel_m)[:, None].expand(-1, 2)
        before = z > 0
        scale = torch.where(before, near, scale)
        centre = torch.where(before, uv[:, 0], centre)
    offsets = pixel_centers(width, height, images.device) - extent.new_tensor([width / 2, height / 2])
    places = centre[:, None, None] + scale[:, None, None] * offsets
    shown = sample_bilinear(images, places.flatten(1, 2)).movedim(-1, 1).unflatten(2, size)
    return 2 * shown - 1
