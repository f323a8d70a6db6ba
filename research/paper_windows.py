"""Windows of samples: a square around a hole, and the parts of the context that it reprojects to.

A sample of the paper's model has up to 22 images, of which a hole needs little. A window keeps every patch that its
queries may attend to, with the encoder's receptive field around it, so their tokens equal those of the whole images.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from random import Random

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, concatenate_cameras, project, unproject
from viewmend.models.paper.patches import PATCH_PX, STEP_PX
from viewmend.models.paper.tokenizer import MARGIN_STEPS, reference_depth
from viewmend.rendering.crop import Crop
from viewmend.training.config import SceneSource
from viewmend.training.samples import Sample
from viewmend.types import ContextViews, IncompleteView, MultiViewFrame, WindowPart

WINDOWS_PER_SAMPLE = 8
STEPS_ACROSS = (5, 10)
"""Smallest and largest number of patch steps of a window beyond its first patch: 108 to 188 pixels."""
MARGIN_PX = MARGIN_STEPS * STEP_PX
"""Receptive field of the encoder around a patch."""
SEARCH_PX = 16
"""Distance around the reprojected hole up to which context is kept, in addition to the receptive field."""
NEAR_M = 1e-3


class WindowScenes:
    """Windows of the samples of other scenes."""

    def __init__(self, scenes: SceneSource[Sample], seed: str, per_sample: int = WINDOWS_PER_SAMPLE) -> None:
        self.scenes = scenes
        self.seed = seed
        self.per_sample = per_sample

    def scene(self, number: int) -> list[Sample]:
        """The windows of scene `number`, each around a random hole pixel."""
        random = Random(f"{self.seed}/windows/{number}")
        found = []
        for sample in self.scenes.scene(number):
            holes = torch.nonzero(sample.view.error > 0)
            for _ in range(self.per_sample):
                row, column = holes[random.randrange(len(holes))].tolist()
                side_px = PATCH_PX + STEP_PX * random.randint(*STEPS_ACROSS)
                found.append(window(sample, (row, column), side_px))
        return found


def window(sample: Sample, middle: tuple[int, int], side_px: int) -> Sample:
    """The part of a sample around a pixel, as a sample of its own; of a clip, only the last view.

    Args:
        sample: whole views.
        middle: row and column of the pixel.
        side_px: side of the square whose patches are completed: a patch plus a multiple of the patch step.
    """
    view = sample.view
    height, width = view.mask.shape
    top, left = (_start(m, side_px, size) for m, size in zip(middle, (height, width), strict=True))
    inner = Crop(left, top, min(left + side_px, width), min(top + side_px, height))
    outer = _with_margin(inner, width, height)
    points = _surface(view, inner)
    context = [part for views in sample.context if (part := _context_part(views, points)) is not None]
    images = {name: outer.of_image(getattr(view, name)).contiguous() for name in ("rgb", "mask", "error", "weights")}
    part = WindowPart(
        (width, height),
        reference_depth(view.depth[None]),
        outer.of_image(_inside(inner, height, width)[None]).contiguous(),
    )
    cut = replace(
        view,
        camera=outer.of_camera(view.camera),
        depth=outer.of_image(_rounded(view.depth)).contiguous(),
        silhouettes=None,
        part=part,
        **images,
    )
    truth, alpha = outer.of_image(sample.truth).contiguous(), sample.alpha
    alpha = None if alpha is None else outer.of_image(alpha).contiguous()
    return Sample(cut, tuple(context), None, truth, alpha=alpha)


def _start(middle: int, side_px: int, size_px: int) -> int:
    """First pixel of a window around this one: on the grid of patches, and within the image."""
    last = max(0, -(-(size_px - side_px) // STEP_PX))
    return min(max(0, (middle - side_px // 2) // STEP_PX), last) * STEP_PX


def _with_margin(inner: Crop, width: int, height: int) -> Crop:
    """A crop with the receptive field around it, as far as the image reaches."""
    left, top = max(0, inner.left - MARGIN_PX), max(0, inner.top - MARGIN_PX)
    return Crop(left, top, min(width, inner.right + MARGIN_PX), min(height, inner.bottom + MARGIN_PX))


def _inside(inner: Crop, height: int, width: int) -> Tensor:
    """True in the crop."""
    inside = torch.zeros(height, width, dtype=torch.bool)
    inside[inner.top : inner.bottom, inner.left : inner.right] = True
    return inside


def _surface(view: IncompleteView, inner: Crop) -> Float[Tensor, "point 3"]:
    """Points of the proxy in the crop: those of hole pixels, or all of them if no hole pixel has a depth."""
    inside = _inside(inner, *view.mask.shape).to(view.mask.device) & (view.depth > 0)
    holes = inside & (view.error > 0)
    pixels = torch.nonzero(holes if bool(holes.any()) else inside)
    index = tuple(pixels.unbind(1))
    return unproject((pixels.flip(1) + 0.5).to(view.depth)[None], view.depth[index][None], view.camera)[0]


def _context_part(views: ContextViews, points: Float[Tensor, "point 3"]) -> ContextViews | None:
    """Each camera's window around the projected points; None if no camera sees them."""
    frame, parts = views.frame, []
    for number in range(len(frame.cameras)):
        box = _box(points, frame.cameras[number])
        if box is not None:
            parts.append(_camera_part(views, number, box))
    if not parts:
        return None
    size = [max(part.depth.shape[axis] for part in parts) for axis in (1, 2)]

    def joined(images: Sequence[Tensor], padding: float = 0.0) -> Tensor:
        spare = [(0, size[1] - image.shape[-1], 0, size[0] - image.shape[-2]) for image in images]
        return torch.cat([F.pad(image, pad, value=padding) for image, pad in zip(images, spare, strict=True)])

    frames = [part.frame for part in parts]
    masks = [f.mask for f in frames if f.mask is not None]
    whole = MultiViewFrame(
        concatenate_cameras([f.cameras for f in frames]),
        joined([f.rgb for f in frames]),
        joined(masks) if masks else None,
        frame.time,
    )
    own = [part.part for part in parts if part.part is not None]
    # Padding has no foreground, so it must not exclude the patches that reach beyond an image.
    inner = joined([p.inner for p in own], 1.0)
    part = WindowPart(own[0].whole_size_px, torch.cat([p.reference_m for p in own]), inner)
    return ContextViews(whole, joined([part.depth for part in parts]), part)


def _box(points: Float[Tensor, "point 3"], camera: Cameras) -> Crop | None:
    """The patches whose centres are within `SEARCH_PX` of the projected points, at least one; None if none is seen."""
    if not len(points):
        return None
    uv, z = project(points, camera)
    uv = uv[0][z[0] > NEAR_M]
    width, height = (int(side) for side in camera.size_px[0])
    if not len(uv):
        return None
    (u0, v0), (u1, v1) = uv.amin(0).tolist(), uv.amax(0).tolist()
    sides = [(u0 - SEARCH_PX, u1 + SEARCH_PX, width), (v0 - SEARCH_PX, v1 + SEARCH_PX, height)]
    if any(last < 0 or first > size for first, last, size in sides):
        return None
    firsts, lasts = [], []
    for first, last, size in sides:
        begin = max(0, math.ceil((first - PATCH_PX / 2) / STEP_PX))
        end = max(begin, math.floor((last - PATCH_PX / 2) / STEP_PX))
        firsts.append(min(begin * STEP_PX, size - 1))
        lasts.append(min(end * STEP_PX + PATCH_PX, size))
    return Crop(firsts[0], firsts[1], lasts[0], lasts[1])


def _camera_part(views: ContextViews, number: int, inner: Crop) -> ContextViews:
    """One camera's window."""
    frame, camera = views.frame, views.frame.cameras[number]
    width, height = (int(side) for side in camera.size_px[0])
    outer, one = _with_margin(inner, width, height), slice(number, number + 1)
    mask = frame.mask[one] if frame.mask is not None else None
    rgb = frame.rgb[one] if mask is None else frame.rgb[one] * (mask > 0)[:, None]
    rgb = outer.of_image(rgb).contiguous()
    cut = MultiViewFrame(
        outer.of_camera(camera), rgb, None if mask is None else outer.of_image(mask).contiguous(), frame.time
    )
    inside = outer.of_image(_inside(inner, height, width)[None]).contiguous()
    part = WindowPart((width, height), reference_depth(views.depth[one, :height, :width]), inside)
    return ContextViews(cut, outer.of_image(_rounded(views.depth[one])).contiguous(), part)


def _rounded(depth: Float[Tensor, "*view height width"]) -> Float[Tensor, "*view height width"]:
    """Depths rounded to 1 part in 2000, so that they compress."""
    return depth.half().float()
