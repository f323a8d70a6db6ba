"""Whether the cameras' images show the same surface: one that shows another picture, or another sharpness, is named."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.capture.finding import Finding
from viewmend.capture.reduction import reduced
from viewmend.capture.surface_colours import Surface, SurfaceColours, agreement, nearest_agreement, surface_of
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import FOREGROUND, HullConfig
from viewmend.geometry.proxy import reconstruct
from viewmend.geometry.sampling import sample_bilinear
from viewmend.views import MultiViewFrame

LONGEST_PX = 256
HULL = HullConfig(resolution=64)
FAR = 2.5
"""A camera shows something else if its colours are so many times as far from all others' as is usual."""
FARTHER, LESS_ALIKE = 1.55, 0.72
"""So many times as far is enough where the correlation with any other is lower than usual by this factor."""
SUSPECT, FITS = 1.25, 0.65
"""Who is so many times as far as is usual may have another image, and has if with it the distance is so much less."""
PALE, COLOURFUL = 0.4, 0.05
"""An image is grey whose saturation is lower than the usual one by this factor, where that is so much at least."""
BLURRED, NOISY = 0.45, 2.0
"""Differences of neighbouring pixels, beside the usual ones, below which an image is blurred, above which noisy."""


def odd_colours(frame: MultiViewFrame, bounds: Bounds | None) -> tuple[Finding, ...]:
    """The cameras whose images do not fit the others', as findings; () where they all do, or nobody can tell."""
    small = reduced(frame, LONGEST_PX)
    if small.mask is None or len(small.cameras) < 3:
        return ()
    try:
        surface = surface_of(small, reconstruct(small.mask, small.cameras, bounds, HULL))
    except ValueError:
        return ()
    found, colours = [], surface.colours(small.rgb)
    distance, correlation = nearest_agreement(colours, colours)
    typical, alike = distance.nanmedian(), correlation.nanmedian()
    suspects = [view for view, far in enumerate(distance.tolist()) if far > SUSPECT * typical]
    others = _fitting_better(small, surface, colours, distance, suspects)
    detail = _detail(small)
    usual, saturation = detail.nanmedian(), _saturation(small)
    grey = (saturation < PALE * saturation.nanmedian()) & (saturation.nanmedian() > COLOURFUL)
    for view, name in enumerate(small.cameras.names):
        if bool(grey[view]):
            found.append(
                Finding(f"camera '{name}': its images are grey, the others' are not; check what it was set to")
            )
        elif view in others:
            text = f"camera '{name}': its images do not show what the others see, and fit much better {others[view]}"
            found.append(Finding(f"{text}; exchange or turn its files"))
        elif bool(distance[view] > FAR * typical) or (
            bool(distance[view] > FARTHER * typical) and bool(correlation[view] < LESS_ALIKE * alike)
        ):
            text = (
                f"camera '{name}': its images do not show what the others see (colours are off by "
                f"{100 * distance[view]:.0f} %, usually by {100 * typical:.0f} %); check whether they are "
                "another camera's or another time's, turned, mirrored, BGR or of another exposure"
            )
            found.append(Finding(text))
        elif bool(detail[view] < BLURRED * usual) or bool(detail[view] > NOISY * usual):
            what = "blurred" if bool(detail[view] < usual) else "noisy"
            found.append(Finding(f"camera '{name}': its images are {what} beside the others'; check focus and gain"))
    return tuple(found)


def _fitting_better(
    frame: MultiViewFrame,
    surface: Surface,
    colours: SurfaceColours,
    distance: Float[Tensor, "view"],
    suspects: Sequence[int],
) -> dict[int, str]:
    """The cameras whose images fit the others' much better mirrored, turned or as another camera's; and how."""
    found, names = {}, frame.cameras.names
    for view in suspects:
        width, height = (int(side) for side in frame.cameras.size_px[view])
        own = frame.rgb[view, :, :height, :width]
        tried = {"mirrored": own.flip(2), "upside down": own.flip(1), "turned by 180 degrees": own.flip(1, 2)}
        tried |= {
            f"as that of '{names[other]}'": frame.rgb[other, :, :height, :width]
            for other, size in enumerate(frame.cameras.size_px.tolist())
            if other != view and size == [width, height]
        }
        shown = sample_bilinear(
            torch.stack(list(tried.values())).float() / 255, surface.uv_px[view].expand(len(tried), -1, -1), "border"
        )
        shared = surface.seen[view] & surface.seen
        nearest = {what: agreement(rgb, shared, colours, view)[0] for what, rgb in zip(tried, shown, strict=True)}
        what = min(nearest, key=nearest.__getitem__)
        if nearest[what] < FITS * float(distance[view]):
            found[view] = what
    return found


def _detail(frame: MultiViewFrame) -> Float[Tensor, "view"]:
    """Mean difference of neighbouring pixels of the subject, in each camera; NaN without foreground."""
    assert frame.mask is not None
    grey, inside = frame.rgb.float().mean(1), frame.mask > FOREGROUND
    both = inside[:, :, 1:] & inside[:, :, :-1]
    return ((grey[:, :, 1:] - grey[:, :, :-1]).abs() * both).sum((1, 2)) / both.sum((1, 2))


def _saturation(frame: MultiViewFrame) -> Float[Tensor, "view"]:
    """How far the subject's channels are apart, relative to its brightness, in each camera; NaN without foreground."""
    assert frame.mask is not None
    rgb, inside = frame.rgb.float(), frame.mask > FOREGROUND
    apart = ((rgb.amax(1) - rgb.amin(1)) * inside).sum((1, 2))
    return apart / (rgb.mean(1) * inside).sum((1, 2))
