"""Copying is learned first, from single camera images: what is blotted out stands in the same image on another grid.

A hole's patch must be put together from patches of the context that lie between its own grid's. That takes thousands
of windows of 22 images to learn; here a camera's own image is the truth, so one time of a rig is enough. Ours.
"""

import math

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from viewmend.inpainting.coordinates import reference_depth
from viewmend.inpainting.correspondences import Correspondences
from viewmend.inpainting.patches import STEP_PX
from viewmend.rendering.crop import Crop
from viewmend.training.objective import Objective, StepOutput
from viewmend.training.samples import Sample
from viewmend.views import ContextViews, IncompleteView, WindowPart

BLOTS = 3
"""So many at most, one at least."""
BLOT_RADIUS_PX = (6.0, 48.0)
"""Least and largest radius of a blot along each of its axes."""
MISPLACED_PX = 4.0
"""The calibration of what is blotted out is wrong by so much at most, along each axis: geometry is never exact."""


class CopyingObjective(Objective):
    """L without L_adv, of copies that are made of a batch's context; their truth is what cameras saw."""

    def forward(self, batch: list[Sample]) -> StepOutput:
        """All terms of a copy of each sample, of a time that chance takes.

        Raises:
            ValueError: no sample's context shows a subject.
        """
        views = [s.context[int(torch.randint(len(s.context), ()))] for s in batch if s.context]
        copies = [copy for one in views if (copy := copy_of(one)) is not None]
        if not copies:
            raise ValueError("expected images of a subject, got none that shows any; make the samples anew")
        return super().forward(copies)


def copy_of(views: ContextViews) -> Sample | None:
    """One of the cameras, which chance takes, as a view with blots; all of them, as they are, are its context.

    Its patches lie on a grid of their own, and its calibration is a little wrong. None where it shows no subject.
    """
    cameras = views.frame.cameras
    number = int(torch.randint(len(cameras), ()))
    own = views.select([cameras.names[number]])
    width, height = (int(side) for side in own.frame.cameras.size_px[0])
    left, top = (int(shift) for shift in torch.randint(STEP_PX, (2,)))
    if left >= width or top >= height:
        return None
    crop = Crop(left, top, width, height)
    rgb, depth = crop.of_image(own.frame.rgb[0]), crop.of_image(own.depth[0]).contiguous()
    mask = crop.of_image((own.depth[0] > 0).float() if own.frame.mask is None else own.frame.mask[0].float() / 255)
    part = own.part or WindowPart((width, height), reference_depth(own.depth), torch.ones_like(own.depth) > 0)
    inner = crop.of_image(part.inner)
    missing = _blots((mask > 0.5) & inner[0])
    if missing is None:
        return None
    error = missing.float()
    truth = (rgb * mask).round().to(torch.uint8)
    shift_px = (torch.rand(2) * 2 - 1) * MISPLACED_PX
    view = IncompleteView(
        camera=crop.of_camera(own.frame.cameras).moved(*shift_px.tolist()),
        rgb=truth.float() / 255 * (1 - error),
        mask=torch.maximum(mask, error),
        error=error,
        depth=depth,
        source_views=cameras.names,
        weights=((mask > 0) * (1 - error)).expand(len(cameras), -1, -1) / len(cameras),
        time=views.frame.time,
        part=WindowPart(part.whole_size_px, part.reference_m, inner.contiguous()),
    )
    alpha = (mask * 255).round().to(torch.uint8)
    return Sample(
        view, (views,), None, truth, alpha=alpha, matches=_matches(views, number, missing & (mask > 0.5), crop)
    )


def _matches(views: ContextViews, number: int, missing: Bool[Tensor, "height width"], crop: Crop) -> Correspondences:
    """Each missing pixel is where it was, in the same camera."""
    pixels = torch.nonzero(missing)
    where = torch.full_like(pixels[:, 0], number)
    uv_px = pixels.flip(1) + 0.5 + pixels.new_tensor([crop.left, crop.top])
    time = torch.full_like(where, views.frame.time)
    return Correspondences(views.frame.cameras.names, pixels, where, time, uv_px)


def _blots(subject: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"] | None:
    """Some ellipses about pixels of the subject; None without any."""
    middles = torch.nonzero(subject)
    if not len(middles):
        return None
    blots = torch.zeros_like(subject)
    for _ in range(int(torch.randint(1, BLOTS + 1, ()))):
        blots |= _ellipse(middles[int(torch.randint(len(middles), ()))], subject)
    return blots


def _ellipse(middle: Int[Tensor, "2"], like: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """One, turned and as large as chance will, about row and column."""
    least, largest = BLOT_RADIUS_PX
    radii = least * (largest / least) ** torch.rand(2)
    angle = math.pi * float(torch.rand(()))
    rows, columns = (torch.arange(size, device=like.device) - at for size, at in zip(like.shape, middle, strict=True))
    along = columns * math.cos(angle) + rows[:, None] * math.sin(angle)
    across = rows[:, None] * math.cos(angle) - columns * math.sin(angle)
    return (along / radii[0]) ** 2 + (across / radii[1]) ** 2 < 1
