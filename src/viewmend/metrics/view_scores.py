"""Scores of a mended view against the image of a camera that was left out (section 10)."""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.metrics.image_quality import mask_iou, psnr
from viewmend.views import IncompleteView

ENOUGH_HOLE_PX = 50
"""Frames with fewer hole pixels say little: their PSNR is left out of means where others have more."""


@dataclass(frozen=True)
class ViewScores:
    """PSNR in dB by kind of pixel, None where there is none of the kind."""

    psnr_whole: float
    """All pixels."""
    psnr_subject: float | None
    """Pixels inside the true mask."""
    psnr_valid: float | None
    """Hull pixels that the renderer coloured."""
    psnr_holes: float | None
    """Hull pixels that it did not: `IncompleteView.holes`, whatever the error rule."""
    psnr_holes_fg: float | None
    """Holes inside the true mask; the rest should have become background."""
    hull_px: int
    holes_px: int
    holes_fg_px: int
    hull_iou: float | None
    """The hull's silhouette against the true mask."""


def score_view(
    view: IncompleteView,
    rgb: Float[Tensor, "3 height width"],
    truth: Float[Tensor, "3 height width"],
    true_mask: Bool[Tensor, "height width"],
) -> ViewScores:
    """Compare `rgb`, a completion of `view`, with the true image; both lie upon the same background."""
    hull, holes = view.mask > 0.5, view.holes
    holes_fg = holes & true_mask
    whole = psnr(rgb, truth)
    assert whole is not None, "images have pixels"
    return ViewScores(
        psnr_whole=whole,
        psnr_subject=psnr(rgb, truth, true_mask),
        psnr_valid=psnr(rgb, truth, hull & ~holes),
        psnr_holes=psnr(rgb, truth, holes),
        psnr_holes_fg=psnr(rgb, truth, holes_fg),
        hull_px=int(hull.sum()),
        holes_px=int(holes.sum()),
        holes_fg_px=int(holes_fg.sum()),
        hull_iou=mask_iou(hull, true_mask),
    )


def mean_over_frames(values: Sequence[float | None], pixels: Sequence[int] | None = None) -> float | None:
    """Mean of the frames that have a value; None where none has.

    With `pixels`, how many each value is of, only the frames with at least `ENOUGH_HOLE_PX` count, unless none has.
    """
    there = [(v, n) for v, n in zip(values, pixels or [0] * len(values), strict=True) if v is not None]
    enough = [v for v, n in there if n >= ENOUGH_HOLE_PX] or [v for v, _ in there]
    return sum(enough) / len(enough) if enough else None
