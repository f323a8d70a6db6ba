"""The part of a view that can show the subject: only there is anything to render and to fill, the rest is black."""

import math
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, project
from viewmend.views import CompletedView

MARGIN_PX = 8
"""More than a fill looks around itself: so a window's border does to it what the black of the view would."""
GRID_PX = 16
"""A window begins at a multiple of this: smooth fills halve the resolution, and then halve the same pixels."""
NEAR_M = 1e-3


@dataclass(frozen=True)
class Window:
    """Columns left to right - 1 and rows top to bottom - 1 of a view, pixels."""

    left: int
    top: int
    right: int
    bottom: int

    def of(self, camera: Cameras) -> Cameras:
        """The camera whose image is this part of `camera`'s."""
        return camera.cropped(self.left, self.top, self.right - self.left, self.bottom - self.top)

    def widened(self, part: CompletedView, camera: Cameras) -> CompletedView:
        """The whole view of `camera` again: black, and without subject, around the window."""
        width, height = camera.max_size_px
        around = (self.left, width - self.right, self.top, height - self.bottom)
        own = part.view
        rgb, mask, error, depth, weights = (
            F.pad(image, around) for image in (own.rgb, own.mask, own.error, own.depth, own.weights)
        )
        view = replace(own, camera=camera, rgb=rgb, mask=mask, error=error, depth=depth, weights=weights)
        return CompletedView(view, rgb if part.rgb is own.rgb else F.pad(part.rgb, around))


def window_of(vertices: Float[Tensor, "vertex 3"], camera: Cameras) -> Window | None:
    """The window that holds a surface of these vertices; None where it is the whole view, or some are not before it."""
    width, height = camera.max_size_px
    if not len(vertices):
        return None
    uv, z = project(vertices, camera)
    if bool((z < NEAR_M).any()):
        return None
    (u0, v0), (u1, v1) = (corner[0].tolist() for corner in (uv.amin(1), uv.amax(1)))
    left, right = _side(u0, u1, width)
    top, bottom = _side(v0, v1, height)
    window = Window(left, top, right, bottom)
    return None if window == Window(0, 0, width, height) else window


def _side(first: float, last: float, size: int) -> tuple[int, int]:
    """First pixel and the one after the last, within the image; at least one pixel."""
    start = max(0, min(size - 1, math.floor(first) - MARGIN_PX)) // GRID_PX * GRID_PX
    return start, max(start + 1, min(size, math.ceil(last) + MARGIN_PX))
