"""What one frame of one method scores against the camera that was left out (section 10)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.evaluation.temporal import change, warp_error
from viewmend.metrics.image_quality import psnr, ssim
from viewmend.metrics.view_scores import ENOUGH_HOLE_PX
from viewmend.views import CompletedView, MultiViewFrame

FOREGROUND = 128
"""A true mask from here on (of 255) is subject."""
WINDOW_PX = 11
"""The Gaussian SSIM's window: pixels that are equal within it count as 1."""


@dataclass(frozen=True)
class FrameScores:
    """One frame. PSNR in dB, SSIM in [-1, 1], differences in [0, 1]; None where there is nothing to score."""

    time: int
    image_px: int
    hull_px: int
    """Pixels that the geometry proxy covers."""
    hole_px: int
    """Pixels of E (E > 0)."""
    hole_fg_px: int
    """Of these, inside the true mask."""
    psnr_holes: float | None
    """Over the pixels of E alone: reading (a)."""
    psnr_holes_fg: float | None
    """Over those of them inside the true mask."""
    psnr_masked: float | None
    """Both images blackened outside E, over all pixels of the image: reading (b)."""
    ssim_masked: float | None
    """SSIM of these images, as a whole."""
    psnr_whole: float
    """Over all pixels."""
    ssim_whole: float | None
    warp_error: float | None
    """From the frame before, along the surface's true motion, over E (`warp_error`)."""
    warp_error_truth: float | None
    """The truth's own."""
    change: float | None
    """From the frame before, in place, over the pixels of E now or then (`change`)."""
    change_truth: float | None
    """The truth's own."""
    step_ms: float
    """What the inpainter's step took."""


@dataclass(frozen=True)
class TrueView:
    """What the completed view should look like."""

    rgb: Float[Tensor, "3 height width"]
    """In [0, 1], black where there is no subject."""
    mask: Bool[Tensor, "height width"]
    came_from_px: Float[Tensor, "height width 2"] | None
    """See `temporal.came_from`."""


@dataclass(frozen=True)
class Before:
    """The frame before of the same stream."""

    completed: Float[Tensor, "3 height width"]
    truth: Float[Tensor, "3 height width"]
    error: Float[Tensor, "height width"]


def true_view(frame: MultiViewFrame, came_from_px: Float[Tensor, "height width 2"] | None) -> TrueView:
    """The truth of a frame of one view with a mask."""
    assert frame.mask is not None, "a held camera comes with its mask"
    mask = frame.mask[0]
    return TrueView(frame.rgb[0].float() / 255 * (mask.float() / 255), mask >= FOREGROUND, came_from_px)


def score_frame(completed: CompletedView, truth: TrueView, before: Before | None, step_ms: float) -> FrameScores:
    """All scores of one completed view. Holes are the pixels with E > 0, the same for every method."""
    view, rgb = completed.view, completed.rgb
    holes = view.error > 0
    holes_fg = holes & truth.mask
    any_hole = bool(holes.any())
    whole = psnr(rgb, truth.rgb)
    assert whole is not None, "images have pixels"
    warped, changed = _temporal(completed, truth, before)
    return FrameScores(
        time=view.time,
        image_px=holes.numel(),
        hull_px=int((view.mask > 0.5).sum()),
        hole_px=int(holes.sum()),
        hole_fg_px=int(holes_fg.sum()),
        psnr_holes=psnr(rgb, truth.rgb, holes),
        psnr_holes_fg=psnr(rgb, truth.rgb, holes_fg),
        psnr_masked=psnr(rgb * holes, truth.rgb * holes) if any_hole else None,
        ssim_masked=_ssim(rgb * holes, truth.rgb * holes) if any_hole else None,
        psnr_whole=whole,
        ssim_whole=_ssim(rgb, truth.rgb),
        warp_error=warped[0],
        warp_error_truth=warped[1],
        change=changed[0],
        change_truth=changed[1],
        step_ms=step_ms,
    )


Pair = tuple[float | None, float | None]
"""Of the method, and of the truth."""


def _temporal(completed: CompletedView, truth: TrueView, before: Before | None) -> tuple[Pair, Pair]:
    if before is None:
        return (None, None), (None, None)
    holes = completed.view.error > 0
    pairs = (completed.rgb, before.completed), (truth.rgb, before.truth)
    changed = [change(now, then, holes | (before.error > 0), ENOUGH_HOLE_PX) for now, then in pairs]
    warped: list[float | None] = [None, None]
    if truth.came_from_px is not None:
        warped = [warp_error(now, then, truth.came_from_px, holes, ENOUGH_HOLE_PX) for now, then in pairs]
    return (warped[0], warped[1]), (changed[0], changed[1])


def _ssim(image: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"]) -> float | None:
    """`ssim` of whole images, computed only where they differ: windows in which they are equal have exactly 1."""
    height, width = image.shape[1:]
    differ = (image != truth).any(0)
    if min(height, width) < WINDOW_PX or not bool(differ.any()):
        return ssim(image, truth)
    rows, columns = (_reach(torch.nonzero(differ.any(axis)), size) for axis, size in ((1, height), (0, width)))
    part = ssim(image[:, rows, columns], truth[:, rows, columns])
    assert part is not None, "the part is at least a window wide"
    inner = WINDOW_PX - 1
    windows = (rows.stop - rows.start - inner) * (columns.stop - columns.start - inner)
    return 1 - (1 - part) * windows / ((height - inner) * (width - inner))


def _reach(at: Tensor, size: int) -> slice:
    """From the first to the last of these places, with all windows that hold one of them."""
    reach = WINDOW_PX - 1
    return slice(max(0, int(at.min()) - reach), min(size, int(at.max()) + reach + 1))
