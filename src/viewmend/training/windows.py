"""Windows of samples: what is around something that is missing, and the parts of the context that it reprojects to.

A whole sample is 22 images, of which a hole needs little. A window keeps every patch that a query may look at, with
the encoder's receptive radius around it: its tokens are those of the whole images, and what lies beyond does not
matter.
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
from viewmend.inpainting.coordinates import reference_depth
from viewmend.inpainting.correspondences import Correspondences
from viewmend.inpainting.patches import MARGIN_STEPS, PATCH_PX, STEP_PX
from viewmend.rendering.crop import Crop
from viewmend.training.plan import DataPlan
from viewmend.training.samples import Sample
from viewmend.training.scenes import SceneSource
from viewmend.views import ContextViews, IncompleteView, MultiViewFrame, WindowPart

STEPS_ACROSS = (5, 10)
"""Fewest and most patch steps of a window beyond its first patch: 108 to 188 pixels."""
MARGIN_PX = MARGIN_STEPS * STEP_PX
"""What the encoder sees around a patch."""
NEAR_M = 1e-3


class WindowScenes:
    """Windows of the samples of other scenes, `DataPlan.windows` of each."""

    def __init__(self, scenes: SceneSource[Sample], plan: DataPlan, seed: str) -> None:
        self.scenes = scenes
        self.plan = plan
        self.seed = seed

    def scene(self, number: int) -> list[Sample]:
        """The windows of scene `number`, each around a missing pixel that chance takes."""
        random = Random(f"{self.seed}/windows/{number}")
        found = []
        for sample in self.scenes.scene(number):
            missing = torch.nonzero(sample.view.error > 0)
            for _ in range(self.plan.windows):
                row, column = missing[random.randrange(len(missing))].tolist()
                side_px = PATCH_PX + STEP_PX * random.randint(*STEPS_ACROSS)
                found.append(window(sample, (row, column), side_px, self.plan.search_px))
        return found


def window(sample: Sample, middle: tuple[int, int], side_px: int, search_px: int) -> Sample:
    """The part of a sample around a pixel, as a sample of its own; of a clip, the last view alone.

    Args:
        sample: of whole views.
        middle: row and column.
        side_px: of the square whose patches are filled; some patch steps and a patch.
        search_px: how far around where it reprojects to attention may look for a pixel.
    """
    view = sample.view
    height, width = view.mask.shape
    top, left = (_start(m, side_px, size) for m, size in zip(middle, (height, width), strict=True))
    inner = Crop(left, top, min(left + side_px, width), min(top + side_px, height))
    outer = _around(inner, width, height)
    points = _surface(view, inner)
    context = [part for views in sample.context if (part := _context_part(views, points, search_px)) is not None]
    images = {name: outer.of_image(getattr(view, name)).contiguous() for name in ("rgb", "mask", "error", "weights")}
    part = WindowPart(
        (width, height),
        reference_depth(view.depth[None]),
        outer.of_image(_inside(inner, height, width)[None]).contiguous(),
    )
    cut = replace(
        view,
        camera=outer.of_camera(view.camera),
        depth=outer.of_image(_short(view.depth)).contiguous(),
        silhouettes=None,
        part=part,
        **images,
    )
    truth, alpha = outer.of_image(sample.truth).contiguous(), sample.alpha
    alpha = None if alpha is None else outer.of_image(alpha).contiguous()
    matches = None if sample.matches is None else _matches_part(sample.matches, sample.context, context, inner, outer)
    return Sample(cut, tuple(context), None, truth, alpha=alpha, matches=matches)


def _matches_part(
    matches: Correspondences, whole: Sequence[ContextViews], parts: Sequence[ContextViews], inner: Crop, outer: Crop
) -> Correspondences:
    """The correspondences of the part of a view, in the parts of its context that show them."""
    row, column = matches.pixels.unbind(1)
    within = (row >= inner.top) & (row < inner.bottom) & (column >= inner.left) & (column < inner.right)
    shown, uv = torch.zeros_like(within), matches.uv_px.clone()
    cameras_then = {views.frame.time: views.frame.cameras for views in whole}
    for part in parts:
        before = cameras_then[part.frame.time]
        for camera in part.frame.cameras:
            own = before.select(camera.names)
            at = (matches.time == part.frame.time) & (matches.camera == matches.names.index(camera.names[0]))
            uv[at] -= (own.K - camera.K)[0, :2, 2]
            shown |= at & ((uv >= 0) & (uv < camera.size_px[0])).all(1)
    moved = replace(matches, pixels=matches.pixels - torch.tensor([outer.top, outer.left]), uv_px=uv)
    return moved.select(within & shown)


def _start(middle: int, side_px: int, size_px: int) -> int:
    """Where a window about this pixel begins: on the grid of patches, and within the image."""
    last = max(0, -(-(size_px - side_px) // STEP_PX))
    return min(max(0, (middle - side_px // 2) // STEP_PX), last) * STEP_PX


def _around(inner: Crop, width: int, height: int) -> Crop:
    """A part with what the encoder sees around it, as far as there is image."""
    left, top = max(0, inner.left - MARGIN_PX), max(0, inner.top - MARGIN_PX)
    return Crop(left, top, min(width, inner.right + MARGIN_PX), min(height, inner.bottom + MARGIN_PX))


def _inside(inner: Crop, height: int, width: int) -> Tensor:
    """True in the part."""
    inside = torch.zeros(height, width, dtype=torch.bool)
    inside[inner.top : inner.bottom, inner.left : inner.right] = True
    return inside


def _surface(view: IncompleteView, inner: Crop) -> Float[Tensor, "point 3"]:
    """The proxy's points that a part shows: of what is missing, or of all if nothing that is missing has a depth."""
    inside = _inside(inner, *view.mask.shape).to(view.mask.device) & (view.depth > 0)
    missing = inside & (view.error > 0)
    pixels = torch.nonzero(missing if bool(missing.any()) else inside)
    index = tuple(pixels.unbind(1))
    return unproject((pixels.flip(1) + 0.5).to(view.depth)[None], view.depth[index][None], view.camera)[0]


def _context_part(views: ContextViews, points: Float[Tensor, "point 3"], search_px: int) -> ContextViews | None:
    """What cameras show around where the points are in them, each in a window of its own; None without any."""
    frame = views.frame
    parts = []
    for number in range(len(frame.cameras)):
        box = _box(points, frame.cameras[number], search_px)
        if box is not None:
            parts.append(_camera_part(views, number, box))
    if not parts:
        return None
    size = [max(part.depth.shape[axis] for part in parts) for axis in (1, 2)]

    def joined(images: Sequence[Tensor], beyond: float = 0.0) -> Tensor:
        spare = [(0, size[1] - image.shape[-1], 0, size[0] - image.shape[-2]) for image in images]
        return torch.cat([F.pad(image, pad, value=beyond) for image, pad in zip(images, spare, strict=True)])

    frames = [part.frame for part in parts]
    masks = [f.mask for f in frames if f.mask is not None]
    whole = MultiViewFrame(
        concatenate_cameras([f.cameras for f in frames]),
        joined([f.rgb for f in frames]),
        joined(masks) if masks else None,
        frame.time,
    )
    own = [part.part for part in parts if part.part is not None]
    # Beyond an image there is no foreground: a patch that passes its edge is not kept for that, nor dropped.
    inner = joined([p.inner for p in own], 1.0)
    part = WindowPart(own[0].whole_size_px, torch.cat([p.reference_m for p in own]), inner)
    return ContextViews(whole, joined([part.depth for part in parts]), part)


def _box(points: Float[Tensor, "point 3"], camera: Cameras, search_px: int) -> Crop | None:
    """Patches, on the grid, that the points or what is so far from them lie in; None where none is in the image."""
    if not len(points):
        return None
    uv, z = project(points, camera)
    uv = uv[0][z[0] > NEAR_M]
    width, height = (int(side) for side in camera.size_px[0])
    if not len(uv):
        return None
    (u0, v0), (u1, v1) = uv.amin(0).tolist(), uv.amax(0).tolist()
    sides = [(u0 - search_px, u1 + search_px, width), (v0 - search_px, v1 + search_px, height)]
    if any(last < 0 or first > size for first, last, size in sides):
        return None
    # The patches whose centres are within reach, one at least.
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
    outer, one = _around(inner, width, height), slice(number, number + 1)
    mask = frame.mask[one] if frame.mask is not None else None
    rgb = frame.rgb[one] if mask is None else frame.rgb[one] * (mask > 0)[:, None]
    rgb = outer.of_image(rgb).contiguous()
    cut = MultiViewFrame(
        outer.of_camera(camera), rgb, None if mask is None else outer.of_image(mask).contiguous(), frame.time
    )
    inside = outer.of_image(_inside(inner, height, width)[None]).contiguous()
    whole = (width, height)
    part = WindowPart(whole, reference_depth(views.depth[one, :height, :width]), inside)
    return ContextViews(cut, outer.of_image(_short(views.depth[one])).contiguous(), part)


def _short(depth: Float[Tensor, "*view height width"]) -> Float[Tensor, "*view height width"]:
    """Depths whose last bits are 0, so that they compress: 1 part in 2000."""
    return depth.half().float()
