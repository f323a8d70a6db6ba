"""The part of a view that shows the subject: only there is anything to render and to fill, the rest is black."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, project
from viewmend.views import CompletedView, IncompleteView

BORDER_PX = 2
"""What a rendered crop has around the subject's vertices."""
PATCH_STEP_PX = 16
"""Patches of a crop lie as in the whole view if it begins at a multiple of this."""
NEAR_M = 1e-3


@dataclass(frozen=True)
class Crop:
    """Columns left to right - 1 and rows top to bottom - 1 of a view, pixels."""

    left: int
    top: int
    right: int
    bottom: int

    def of_camera(self, camera: Cameras) -> Cameras:
        """The camera whose image is this part of `camera`'s."""
        return camera.cropped(self.left, self.top, self.right - self.left, self.bottom - self.top)

    def of_image(self, image: Shaped[Tensor, "*channel height width"]) -> Shaped[Tensor, "*channel _rows _columns"]:
        """This part of an image, a view of its memory."""
        return image[..., self.top : self.bottom, self.left : self.right]

    def of_view(self, view: IncompleteView) -> IncompleteView:
        """This part of a view."""
        parts = {name: self.of_image(image).contiguous() for name, image in _images(view).items()}
        return replace(view, camera=self.of_camera(view.camera), **parts)

    def uncropped(self, part: IncompleteView, camera: Cameras) -> IncompleteView:
        """The whole view of `camera` again: black, and without subject, around this part."""
        whole = {name: self._padded(image, camera) for name, image in _images(part).items()}
        return replace(part, camera=camera, **whole)

    def uncropped_completed(self, part: CompletedView, camera: Cameras) -> CompletedView:
        """The same of a completed part."""
        view = self.uncropped(part.view, camera)
        images = {name: self._padded(image, camera) for name, image in part.images.items()}
        return CompletedView(view, **images | ({"rgb": view.rgb} if part.rgb is part.view.rgb else {}))

    def pasted(self, part: CompletedView, view: IncompleteView) -> CompletedView:
        """`view` completed by this part of it; around it, colours stay, and there is no subject."""
        images = {name: self._padded(image, view.camera) for name, image in part.images.items()}
        rgb = view.rgb
        if part.rgb is not part.view.rgb:
            rgb = view.rgb.clone()
            self.of_image(rgb).copy_(part.rgb)
        return CompletedView(view, **images | {"rgb": rgb})

    def _padded(self, image: Tensor, camera: Cameras) -> Tensor:
        width, height = camera.max_size_px
        return F.pad(image, (self.left, width - self.right, self.top, height - self.bottom))


def _images(view: IncompleteView) -> dict[str, Tensor]:
    """The fields of a view that are images, as far as it has them."""
    fields = ("rgb", "mask", "error", "depth", "weights", "fade")
    return {name: image for name in fields if (image := getattr(view, name)) is not None}


def mesh_crop(
    vertices: Float[Tensor, "vertex 3"], camera: Cameras, margin_px: int = BORDER_PX, grid_px: int = 1
) -> Crop | None:
    """What a surface of these vertices (metres, world) may cover of the camera's image, and this margin around it.

    None where that is the whole image, or cannot be told: there are no vertices, or some are not in front.
    """
    if not len(vertices):
        return None
    uv, z = project(vertices, camera)
    if bool((z < NEAR_M).any()):
        return None
    width, height = camera.max_size_px
    (u0, v0), (u1, v1) = (corner[0].tolist() for corner in (uv.amin(1), uv.amax(1)))
    left, right = _side(u0 - margin_px, u1 + margin_px, width, grid_px)
    top, bottom = _side(v0 - margin_px, v1 + margin_px, height, grid_px)
    return _or_none(Crop(left, top, right, bottom), width, height)


def subject_crop(view: IncompleteView, margin_px: int) -> Crop | None:
    """What shows the subject or is missing, and at least this margin around it; None where that is the whole view."""
    height, width = view.mask.shape
    shown = (view.mask > 0) | (view.error > 0)
    rows, columns = (torch.nonzero(shown.any(axis))[:, 0] for axis in (1, 0))
    if not len(rows):
        return None
    grid = grid_px(margin_px)
    left, right = _side(float(columns[0]) - margin_px, float(columns[-1]) + 1 + margin_px, width, grid)
    top, bottom = _side(float(rows[0]) - margin_px, float(rows[-1]) + 1 + margin_px, height, grid)
    return _or_none(Crop(left, top, right, bottom), width, height)


def grid_px(margin_px: int) -> int:
    """What crops that are filled begin and end at multiples of.

    The first power of two, from a patch's step on, that holds the margin: smooth fills halve the resolution again and
    again, and then mostly halve the same pixels as in the whole view.
    """
    return max(PATCH_STEP_PX, 1 << (margin_px - 1).bit_length())


def _side(first: float, end: float, size: int, grid: int) -> tuple[int, int]:
    """First pixel and the one after the last, on the grid and within the image; at least one pixel."""
    start = max(0, min(size - 1, math.floor(first))) // grid * grid
    return start, max(start + 1, min(size, -(-math.ceil(end) // grid) * grid))


def _or_none(crop: Crop, width: int, height: int) -> Crop | None:
    return None if crop == Crop(0, 0, width, height) else crop
