"""What one frame of one method scores against the camera that was left out (section 10)."""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.backgrounds import Background, laid_upon
from viewmend.evaluation.scorers import SSIM_ONLY, ScoreMap, Scorers
from viewmend.evaluation.temporal import change, warp_error
from viewmend.geometry.hull import FOREGROUND
from viewmend.metrics.image_quality import SSIM_SIZE_PX, SsimWindow, mask_iou, psnr, ssim_map
from viewmend.metrics.view_scores import ENOUGH_HOLE_PX
from viewmend.views import CompletedView, IncompleteView, MultiViewFrame


@dataclass(frozen=True, kw_only=True)
class Scores:
    """PSNR in dB, SSIM in [-1, 1], differences in [0, 1]; None where there is nothing to score.

    Each of PSNR, SSIM and LPIPS comes as `whole`, over all pixels; `holes`, over `IncompleteView.holes` alone (reading
    a); `holes_fg`, over those of them inside the true mask; and `masked`, of both images blackened outside the holes,
    over all pixels of the image (reading b). SSIM and LPIPS over pixels are means of their maps there, seen unmasked.
    """

    psnr_holes: float | None
    psnr_holes_fg: float | None
    psnr_masked: float | None
    psnr_whole: float | None
    psnr_whole_rendered: float | None
    """`psnr_whole` of the view before anything was mended."""
    psnr_subject: float | None
    """PSNR over the pixels inside the true mask."""
    ssim_holes: float | None
    ssim_holes_fg: float | None
    ssim_masked: float | None
    ssim_whole: float | None
    lpips_alex_holes: float | None
    lpips_alex_holes_fg: float | None
    lpips_alex_masked: float | None
    lpips_alex_whole: float | None
    lpips_vgg_holes: float | None
    lpips_vgg_holes_fg: float | None
    lpips_vgg_masked: float | None
    lpips_vgg_whole: float | None
    alpha_iou: float | None
    """Overlap of alpha above one half, or of M where the method tells no alpha, with the true mask."""
    flicker: float | None
    """The error's change from the frame before along the surface's true motion, over holes; 0 for the truth."""
    flicker_whole: float | None
    """The same over all of the subject and the proxy: compare with the method `unfilled`, which shows the rendering."""
    change_still: float | None
    """The change from the frame before, in place, where the truth hardly changes (`STILL`): for captures."""
    warp_error: float | None
    """The view's own change from the frame before along the true motion, over holes (`warp_error`)."""
    warp_error_truth: float | None
    """The truth's."""
    change: float | None
    """The change from the frame before, in place, over the holes of now or then (`change`)."""
    change_truth: float | None
    """The truth's."""
    psnr_past: float | None = None
    """PSNR over the holes whose surface no source view sees now, and one saw at an earlier time of the window."""


@dataclass(frozen=True, kw_only=True)
class FrameScores(Scores):
    """The scores of one frame."""

    time: int
    width_px: int
    height_px: int
    hull_px: int
    """Pixels that the geometry proxy covers."""
    hole_px: int
    """Pixels of `IncompleteView.holes`."""
    hole_fg_px: int
    """Holes inside the true mask."""
    step_ms: float
    """What the inpainter's step took."""
    past_px: int = 0
    """Holes that only the past shows (`psnr_past`)."""

    @property
    def image_px(self) -> int:
        """Pixels of the image."""
        return self.width_px * self.height_px


@dataclass(frozen=True)
class TrueView:
    """What the completed view should look like."""

    rgb: Float[Tensor, "3 height width"]
    """Colours in [0, 1], upon the background of the `Scorers`."""
    mask: Bool[Tensor, "height width"]
    backward_flow_px: Float[Tensor, "height width 2"] | None
    """See `leave_one_out.true_motion.backward_flow`."""
    by_past_alone: Bool[Tensor, "height width"] | None = None
    """See `leave_one_out.true_visibility.SurfaceSeen`, of the cameras that colour the view; None where nobody knows."""


@dataclass(frozen=True)
class Before:
    """The frame before of the same stream."""

    completed: Float[Tensor, "3 height width"]
    truth: Float[Tensor, "3 height width"]
    holes: Bool[Tensor, "height width"]


def true_view(
    frame: MultiViewFrame,
    backward_flow_px: Float[Tensor, "height width 2"] | None,
    background: Background = "black",
) -> TrueView:
    """The truth of a frame of one view with a mask."""
    assert frame.mask is not None, "a held camera comes with its mask"
    mask = frame.mask[0]
    black = frame.rgb[0].float() / 255 * (mask.float() / 255)
    return TrueView(laid_upon(background, black, mask.float() / 255), mask > FOREGROUND, backward_flow_px)


def score_frame(
    completed: CompletedView,
    truth: TrueView,
    before: Before | None,
    step_ms: float,
    scorers: Scorers = SSIM_ONLY,
) -> FrameScores:
    """All scores of one completed view. Its holes are the same for every method and every error rule."""
    view, background = completed.view, scorers.background
    rgb = laid_upon(background, completed.rgb, completed.opacity)
    rendered = laid_upon(background, view.rgb, view.mask)
    holes = view.holes
    pixels = _Pixels(rgb, truth.rgb, holes, holes & truth.mask)
    past = torch.zeros_like(holes) if truth.by_past_alone is None else truth.by_past_alone & holes
    height, width = holes.shape
    return FrameScores(
        time=view.time,
        width_px=width,
        height_px=height,
        hull_px=int((view.mask > 0.5).sum()),
        hole_px=int(holes.sum()),
        hole_fg_px=int(pixels.holes_fg.sum()),
        psnr_holes=psnr(rgb, truth.rgb, holes),
        psnr_holes_fg=psnr(rgb, truth.rgb, pixels.holes_fg),
        psnr_masked=psnr(rgb * holes, truth.rgb * holes) if bool(holes.any()) else None,
        psnr_whole=psnr(rgb, truth.rgb),
        psnr_whole_rendered=psnr(rendered, truth.rgb),
        psnr_subject=psnr(rgb, truth.rgb, truth.mask),
        psnr_past=psnr(rgb, truth.rgb, past),
        past_px=int(past.sum()),
        alpha_iou=mask_iou(completed.opacity > 0.5, truth.mask),
        **_by_map("ssim", partial(similarity, window=scorers.ssim), pixels),
        **_by_map("lpips_alex", scorers.lpips_alex, pixels),
        **_by_map("lpips_vgg", scorers.lpips_vgg, pixels),
        **_temporal(rgb, view, truth, before),
        step_ms=step_ms,
    )


@dataclass(frozen=True)
class _Pixels:
    """Two images and what to compare them over."""

    rgb: Float[Tensor, "3 height width"]
    truth: Float[Tensor, "3 height width"]
    holes: Bool[Tensor, "height width"]
    holes_fg: Bool[Tensor, "height width"]


def _by_map(name: str, score: ScoreMap | None, pixels: _Pixels) -> dict[str, float | None]:
    """The four readings of a score that has a map; NaN in the map, where it has no value, counts nowhere."""
    holes, holes_fg = pixels.holes, pixels.holes_fg
    names = [f"{name}_{kind}" for kind in ("whole", "holes", "holes_fg", "masked")]
    seen = None if score is None else score(pixels.rgb, pixels.truth)
    if score is None or seen is None:
        return dict.fromkeys(names)
    masked = score(pixels.rgb * holes, pixels.truth * holes) if bool(holes.any()) else None
    maps = seen, seen[holes], seen[holes_fg], masked
    return dict(zip(names, (_mean(values) for values in maps), strict=True))


def _mean(values: Tensor | None) -> float | None:
    there = values if values is None else values[values.isfinite()]
    return None if there is None or not there.numel() else float(there.double().mean())


def _temporal(
    now: Float[Tensor, "3 height width"], view: IncompleteView, truth: TrueView, before: Before | None
) -> dict[str, float | None]:
    found: dict[str, float | None] = dict.fromkeys(TEMPORAL)
    if before is None:
        return found
    holes = view.holes
    now_or_then = holes | before.holes
    then, true_now, true_then = before.completed, truth.rgb, before.truth
    shown = (view.mask > 0) | truth.mask
    still = shown & ((true_now - true_then).abs().amax(0) < STILL)
    found["change_still"] = change(now, then, still, ENOUGH_HOLE_PX)
    found["change"] = change(now, then, now_or_then, ENOUGH_HOLE_PX)
    found["change_truth"] = change(true_now, true_then, now_or_then, ENOUGH_HOLE_PX)
    if (moved := truth.backward_flow_px) is not None:
        found["flicker_whole"] = warp_error(now - true_now, then - true_then, moved, shown)
        found["flicker"] = warp_error(now - true_now, then - true_then, moved, holes, ENOUGH_HOLE_PX)
        found["warp_error"] = warp_error(now, then, moved, holes, ENOUGH_HOLE_PX)
        found["warp_error_truth"] = warp_error(true_now, true_then, moved, holes, ENOUGH_HOLE_PX)
    return found


STILL = 0.02
"""The truth hardly changes where no channel does by more, in [0, 1]."""
TEMPORAL = ("flicker", "flicker_whole", "change_still", "warp_error", "warp_error_truth", "change", "change_truth")


def similarity(
    image: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"], window: SsimWindow
) -> Float[Tensor, "height width"] | None:
    """`ssim_map` with a value for each pixel, NaN where the window leaves the image.

    It is computed only where the images differ: windows in which they are equal have exactly 1.
    """
    size, (height, width) = SSIM_SIZE_PX[window], image.shape[1:]
    if min(height, width) < size:
        return None
    found = torch.full((height, width), torch.nan, dtype=torch.float64, device=image.device)
    half = size // 2
    inner = found[half : height - half, half : width - half]
    inner.fill_(1.0)
    differ = (image != truth).any(0)
    if bool(differ.any()):
        rows, columns = (_reach(torch.nonzero(differ.any(axis)), n, size) for axis, n in ((1, height), (0, width)))
        part = ssim_map(image[:, rows, columns], truth[:, rows, columns], window)
        assert part is not None, "the part is at least a window wide"
        inner[rows.start : rows.stop - 2 * half, columns.start : columns.stop - 2 * half] = part
    return found


def mean_similarity(
    image: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"], window: SsimWindow = "gaussian"
) -> float | None:
    """SSIM of whole images; None where they are smaller than the window."""
    return _mean(similarity(image, truth, window))


def _reach(at: Tensor, length: int, size: int) -> slice:
    """All windows that hold one of these places, first to last."""
    start, stop = max(0, int(at.min()) - size + 1), min(length, int(at.max()) + size)
    return slice(min(start, length - size), max(stop, size))
