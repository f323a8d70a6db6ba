"""The part of a view that shows the subject. Only that part is rendered and inpainted; the rest is black."""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, project
from viewmend.types import CompletedView, IncompleteView

BORDER_PX = 2
"""A rendered crop extends this many pixels beyond the subject's vertices."""
PATCH_STEP_PX = 16
"""A crop that begins at a multiple of this many pixels has the same patches as the whole view."""
NEAR_M = 1e-3
"""A view whose camera has a vertex nearer than this, in metres, or behind it, is not cropped."""


@dataclass(frozen=True)
class Crop:
    """A rectangle of a view, pixels; `right` and `bottom` are one past its last column and row."""

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def all_of(cls, camera: Cameras) -> "Crop":
        """The whole image of a camera."""
        return cls(0, 0, *camera.max_size_px)

    def of_camera(self, camera: Cameras) -> Cameras:
        """The camera whose image is this part of `camera`'s."""
        if self == Crop.all_of(camera):
            return camera
        return camera.cropped(self.left, self.top, self.right - self.left, self.bottom - self.top)

    def of_image(
        self, image: Shaped[Tensor, "*channel height width"]
    ) -> Shaped[Tensor, "*channel _rows _columns"]:
        """This part of an image, without copying."""
        return image[..., self.top : self.bottom, self.left : self.right]

    def of_view(self, view: IncompleteView) -> IncompleteView:
        """This part of a view."""
        if self == Crop.all_of(view.camera):
            return view
        images: dict[str, Any] = {
            name: self.of_image(image).contiguous() for name, image in _images(view).items()
        }
        return replace(view, camera=self.of_camera(view.camera), **images)

    def uncropped(self, part: IncompleteView, camera: Cameras) -> IncompleteView:
        """The whole view of `camera`: black, and without subject, around this part."""
        if self == Crop.all_of(camera):
            return part
        whole: dict[str, Any] = {
            name: self.uncropped_image(image, camera) for name, image in _images(part).items()
        }
        return replace(part, camera=camera, **whole)

    def pasted(self, part: CompletedView, view: IncompleteView) -> CompletedView:
        """`view` completed by this part of it, whose error mask becomes the view's. Other pixels keep their colour."""
        if self == Crop.all_of(view.camera):
            return part
        images = {
            name: self.uncropped_image(image, view.camera)
            for name, image in part.images.items()
            if name != "rgb"
        }
        error = self.uncropped_image(part.view.error, view.camera)
        fade = None if part.view.fade is None else self.uncropped_image(part.view.fade, view.camera)
        rgb = view.cut_rgb
        if part.rgb is not part.view.rgb:
            rgb = rgb.clone()
            self.of_image(rgb).copy_(part.rgb)
        return CompletedView(replace(view, error=error, fade=fade), rgb, **images)

    def uncropped_image(
        self, part: Shaped[Tensor, "*channel _rows _columns"], camera: Cameras
    ) -> Shaped[Tensor, "*channel _height _width"]:
        """The whole image of `camera`: 0 around this part."""
        width, height = camera.max_size_px
        return F.pad(part, (self.left, width - self.right, self.top, height - self.bottom))


def _images(view: IncompleteView) -> dict[str, Tensor]:
    """The image fields of a view that are not None."""
    fields = ("rgb", "mask", "error", "depth", "weights", "fade", "target_mask")
    images = {name: getattr(view, name) for name in fields}
    return {name: image for name, image in images.items() if image is not None}


def mesh_crop(
    vertices: Float[Tensor, "vertex 3"], camera: Cameras, margin_px: int = BORDER_PX, grid_px: int = 1
) -> Crop:
    """The part of the camera's image that a mesh of these vertices (metres, world axes) may cover, and a margin.

    The whole image if there are no vertices, or some are not in front of the camera.
    """
    if not len(vertices):
        return Crop.all_of(camera)
    uv, z = project(vertices, camera)
    found = torch.cat([z.amin(1), uv[0].amin(0), uv[0].amax(0)])  # a device is read only once
    nearest_m, first_u, first_v, last_u, last_v = found.tolist()
    if nearest_m < NEAR_M:
        return Crop.all_of(camera)
    width, height = camera.max_size_px
    left, right = _side(first_u - margin_px, last_u + margin_px, width, grid_px)
    top, bottom = _side(first_v - margin_px, last_v + margin_px, height, grid_px)
    return Crop(left, top, right, bottom)


def subject_crop(view: IncompleteView, margin_px: int) -> Crop:
    """The part of a view with M or E above 0, and at least this margin; the whole view if there is no such pixel."""
    height, width = view.mask.shape
    subject = (view.mask > 0) | (view.error > 0)
    rows = torch.nonzero(subject.any(1))[:, 0]
    columns = torch.nonzero(subject.any(0))[:, 0]
    if not len(rows):
        return Crop.all_of(view.camera)
    grid = grid_px(margin_px)
    left, right = _side(float(columns[0]) - margin_px, float(columns[-1]) + 1 + margin_px, width, grid)
    top, bottom = _side(float(rows[0]) - margin_px, float(rows[-1]) + 1 + margin_px, height, grid)
    return Crop(left, top, right, bottom)


def grid_px(margin_px: int) -> int:
    """Crops that are inpainted begin and end at multiples of this.

    It is the smallest power of two that is at least the margin and `PATCH_STEP_PX`. Smooth fills
    halve the resolution several times; on this grid, they mostly average the same pixels as in the
    whole view.
    """
    return max(PATCH_STEP_PX, 1 << (margin_px - 1).bit_length())


def _side(first: float, end: float, size: int, grid: int) -> tuple[int, int]:
    """First pixel and the one after the last, on the grid and within the image; at least one pixel."""
    start = max(0, min(size - 1, math.floor(first))) // grid * grid
    return start, max(start + 1, min(size, -(-math.ceil(end) // grid) * grid))
