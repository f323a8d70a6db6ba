"""Finds cameras whose images do not show the same surface as the others', or have another sharpness."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from viewmend.data.colour_matching import (
    BestAgreement,
    SurfaceColours,
    SurfacePoints,
    best_agreement,
    compare,
)
from viewmend.data.errors import Issue
from viewmend.data.source import limit_size
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import FOREGROUND, HullConfig
from viewmend.geometry.proxy import reconstruct
from viewmend.geometry.sampling import sample_bilinear
from viewmend.types import MultiViewFrame

LONGEST_PX = 256
"""Images are compared at no more than this many pixels along their longer side."""
BLANK_PX = 128
"""Blank images are looked for in every n-th pixel, so that at least this many remain along the
longer side."""
HULL = HullConfig(resolution=64)
"""Hulls have this resolution."""
SUSPECT = 1.25
"""A camera whose colours differ from the others' by more than this many times the median is compared with
changed images: mirrored, rotated, BGR, and those of other cameras."""
FITS = 0.65
"""A changed image explains the fault if its difference is below this share of the original's."""
PALE = 0.4
"""An image is grey if its saturation is below this share of the median."""
COLOURFUL = 0.05
"""Grey images are looked for if the median saturation is above this."""
FLAT = 0.05
"""An image shows nothing if its pixel differences are below this share of the median."""
DARK = 1.0
"""An image shows nothing if its mean is below this value of 255, unless the median is, too."""
BLURRED = 0.45
"""An image is blurred if its pixel differences are below this many times the median."""
NOISY = 2.0
"""An image is noisy if its pixel differences are above this many times the median."""


@dataclass(frozen=True)
class OtherSubjectRule:
    """The rule by which an image shows something other than the images of the other cameras.

    The distance is the difference in colour to the others. Where colours agree to 2 %, shadows and
    noise alone make it three times as large, hence `min_distance`.
    """

    min_distance: float = 0.09
    """The distance is larger than this."""
    ratio: float = 2.5
    """It is also larger than this many times the median; or the following three conditions hold."""
    lower_ratio: float = 1.55
    """The distance is larger than this many times the median."""
    max_correlation: float = 0.72
    """The best correlation with the others is below this share of the median."""
    min_cameras: int = 5
    """The rig has at least this many cameras: medians of fewer say little."""
    peer_ratio: float = 1.5
    """Either way, the distance is larger than this many times `BestAgreement.peer_distance`: where that is
    large, the surface that these cameras share explains it, which the hull may misplace."""

    def applies(self, found: BestAgreement) -> Bool[Tensor, "view"]:
        """Find the images to which the rule applies, by how well they agree with the others."""
        distance = found.distance
        typical = distance.nanmedian()
        farther = distance > self.lower_ratio * typical
        unlike = found.correlation < self.max_correlation * found.correlation.nanmedian()
        is_large = len(distance) >= self.min_cameras
        far = (distance > self.ratio * typical) | (farther & unlike & is_large)
        explained = distance <= self.peer_ratio * found.peer_distance
        return far & ~explained & (distance > self.min_distance)


def find_odd_images(frame: MultiViewFrame, bounds: Bounds | None) -> tuple[Issue, ...]:
    """Find cameras whose images do not match the others'; empty if they cannot be compared."""
    small = limit_size(frame, LONGEST_PX)
    if small.mask is None or len(small.cameras) < 3:
        return ()
    _, detail, saturation = _measures(small.rgb, small.mask)
    try:
        surface = SurfacePoints.from_proxy(small, reconstruct(small.mask, small.cameras, bounds, HULL))
    except ValueError:
        return ()
    colours = surface.colours(small.rgb)
    found = best_agreement(colours)
    distance = found.distance
    suspects = [view for view, far in enumerate(distance.tolist()) if far > SUSPECT * distance.nanmedian()]
    better = _find_better_fits(small, surface, colours, distance, suspects)
    grey = (saturation < PALE * saturation.nanmedian()) & (saturation.nanmedian() > COLOURFUL)
    other_subject = OtherSubjectRule().applies(found)
    blurred = detail < BLURRED * detail.nanmedian()
    noisy = detail > NOISY * detail.nanmedian()
    mismatch = "its images do not match those of the other cameras"
    texts = {}
    for view in range(len(small.cameras)):
        if bool(grey[view]):
            texts[view] = "its images are grey, but the others' are not; check its settings"
        elif view in better:
            texts[view] = f"{mismatch}, and fit much better {better[view]}; correct its files"
        elif bool(other_subject[view]):
            texts[view] = (
                f"{mismatch} (colours differ by {100 * distance[view]:.0f} %, "
                f"typically by {100 * distance.nanmedian():.0f} %); "
                "check whether they are from another camera or frame, rotated, mirrored, BGR or of another exposure"
            )
        elif bool(blurred[view] | noisy[view]):
            fault = "blurred" if bool(blurred[view]) else "noisy"
            texts[view] = f"its images are {fault} compared with the others'; check focus and gain"
    names = small.cameras.names
    return tuple(
        Issue(f"camera '{names[view]}': {text}", odd_image=names[view]) for view, text in texts.items()
    )


def find_blank_images(frame: MultiViewFrame) -> tuple[Issue, ...]:
    """Find cameras whose images show nothing on the subject: all black, or all of one colour, unlike the others'."""
    if frame.mask is None or len(frame.cameras) < 3:
        return ()
    step = max(1, max(frame.mask.shape[1:]) // BLANK_PX)
    brightness, detail, _ = _measures(frame.rgb[..., ::step, ::step], frame.mask[:, ::step, ::step])
    blank = (detail < FLAT * detail.nanmedian()) | ((brightness < DARK) & (brightness.nanmedian() > DARK))
    text = "camera '{}': its image is black or of one colour, so it is left out; check its exposure and its files"
    names = zip(frame.cameras.names, blank.tolist(), strict=True)
    return tuple(Issue(text.format(name), camera=name) for name, shows_nothing in names if shows_nothing)


def _find_better_fits(
    frame: MultiViewFrame,
    surface: SurfacePoints,
    colours: SurfaceColours,
    distance: Float[Tensor, "view"],
    suspects: Sequence[int],
) -> dict[int, str]:
    """The suspects whose images match the others much better when changed, or as another camera's; and how."""
    found = {}
    names = frame.cameras.names
    for view in suspects:
        width, height = (int(side) for side in frame.cameras.size_px[view])
        own = frame.rgb[view, :, :height, :width]
        candidates = {
            "mirrored": own.flip(2),
            "upside down": own.flip(1),
            "rotated by 180 degrees": own.flip(1, 2),
        }
        candidates |= {
            f"as that of '{names[other]}'": frame.rgb[other, :, :height, :width]
            for other, size in enumerate(frame.cameras.size_px.tolist())
            if other != view and size == [width, height]
        }
        candidates |= {"with red and blue exchanged": own.flip(0)}
        images = torch.stack(list(candidates.values())).float() / 255
        sampled = sample_bilinear(images, surface.uv_px[view].expand(len(candidates), -1, -1), "border")
        shared = surface.seen[view] & surface.seen
        each = torch.stack([compare(rgb, shared, colours, view)[0] for rgb in sampled])
        distances = dict(zip(candidates, each.nan_to_num(torch.inf).amin(1).tolist(), strict=True))
        best = min(distances, key=distances.__getitem__)
        if distances[best] < FITS * float(distance[view]):
            found[view] = best
    return found


def _measures(
    images: UInt8[Tensor, "view 3 height width"], masks: UInt8[Tensor, "view height width"]
) -> tuple[Float[Tensor, "view"], Float[Tensor, "view"], Float[Tensor, "view"]]:
    """The subject's mean brightness of 255, difference of neighbouring pixels, and saturation; NaN without foreground.

    Saturation is the difference of the colour channels, relative to brightness.
    """
    rgb = images.float()
    inside = masks > FOREGROUND
    grey = rgb.mean(1)
    both = inside[:, :, 1:] & inside[:, :, :-1]
    total = (grey * inside).sum((1, 2))
    detail = ((grey[:, :, 1:] - grey[:, :, :-1]).abs() * both).sum((1, 2)) / both.sum((1, 2))
    return total / inside.sum((1, 2)), detail, ((rgb.amax(1) - rgb.amin(1)) * inside).sum((1, 2)) / total
