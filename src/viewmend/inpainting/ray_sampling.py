"""What the cameras show along the rays of missing pixels. Ours.

A hole is where no source view sees the proxy. The true surface is at or behind the proxy's, and what it looks like is
in the images: where a ray passes it, cameras that see it agree. So the ray is followed from the proxy inwards, and each
of its points looked up in each camera (as in IBRNet, Wang et al., CVPR 2021, which renders whole views so).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.inpainting.coarse_fill import pull_push
from viewmend.views import ContextViews, IncompleteView, MultiViewFrame, Silhouettes

OFFSETS = (-0.015, 0.0, 0.008, 0.016, 0.03, 0.055, 0.09, 0.15, 0.24, 0.36, 0.55)
"""Where a ray is looked at: z-depth behind the proxy, in subject sizes."""
NEAR, FAR = 0.03, 0.2
"""Subject sizes over which the fine and the coarse distance behind the proxy saturate."""
OUTLINE = 0.06
"""Side, in subject sizes, of the squares over which masks are averaged: this tells how near their outline is."""
PATCH = 0.08
"""Side, in subject sizes, of the squares over which colours are averaged: single pixels agree by chance more easily."""
COVERED = 0.3
"""Beside the proxy's edge, depths count from so much of it in view."""
CELLS = (0.03, 0.06)
"""Sides, in subject sizes, of the squares by which `multi_scale_context` shows a pixel its farther surroundings."""
CELL_CHANNELS = 6
"""RGB of the smoothly filled view, M, E and depth."""
CELLS_AROUND = 5
"""So many cells to each side."""


class RayFeatures(NamedTuple):
    """What each camera shows at the points along some rays: all 0 where a camera has the point not in view."""

    colour: Float[Tensor, "pixel point view 3"]
    """RGB in [0, 1] before black."""
    mask: Float[Tensor, "pixel point view 1"]
    """The camera's mask, in [0, 1]."""
    depth_difference: Float[Tensor, "pixel point view 1"]
    """How far the point is behind the proxy as that camera sees it, -1 to 1; `NEAR` saturates it."""
    coarse_depth_difference: Float[Tensor, "pixel point view 1"]
    """The same, saturated by `FAR`."""
    viewing_cosine: Float[Tensor, "pixel point view 1"]
    """Cosine of the angle between the camera's ray and the pixel's."""
    is_source: Float[Tensor, "pixel point view 1"]
    """1 for a camera that coloured the view."""
    in_view: Float[Tensor, "pixel point view 1"]
    """1 where the camera has the point in view."""
    mean_mask: Float[Tensor, "pixel point view 1"]
    """The mask's mean around. A hull is fattest where the outlines of two cameras meet."""
    mean_colour: Float[Tensor, "pixel point view 3"]
    """The colours' mean around, before black."""
    mean_coverage: Float[Tensor, "pixel point view 1"]
    """The mean around of what the proxy covers: more than the mask where the proxy is fat."""

    def stack(self) -> Float[Tensor, "pixel point view 14"]:
        """All features, in the order of the fields: the networks' input."""
        return torch.cat(self, -1)

    @classmethod
    def unstack(cls, stacked: Float[Tensor, "pixel point view 14"]) -> "RayFeatures":
        """The fields as views of what `stack` gave; no value is copied."""
        return cls(*stacked.split(FEATURE_CHANNELS, -1))


FEATURE_CHANNELS = (3, 1, 1, 1, 1, 1, 1, 1, 3, 1)
"""Channels of each field of `RayFeatures`."""
RAY_CHANNELS = sum(FEATURE_CHANNELS)


class SilhouetteConsistency(NamedTuple):
    """What the masks of all cameras of the rig that have a point in view say of it; 1 where there is no such camera."""

    least: Float[Tensor, "pixel point 1"]
    """The smallest mask: 0 where one camera sees background."""
    second: Float[Tensor, "pixel point 1"]
    """The second smallest: 0 where another sees background, too."""
    least_mean: Float[Tensor, "pixel point 1"]
    """The smallest of the masks' means around."""
    second_mean: Float[Tensor, "pixel point 1"]
    """The second smallest of them."""

    def stack(self) -> Float[Tensor, "pixel point 4"]:
        """All four, in the order of the fields: the networks' input."""
        return torch.cat(self, -1)

    @classmethod
    def unstack(cls, stacked: Float[Tensor, "pixel point 4"]) -> "SilhouetteConsistency":
        """The fields as views of what `stack` gave; no value is copied."""
        return cls(*stacked.split(1, -1))


class RaySamples(NamedTuple):
    """Points along the rays of some pixels."""

    features: RayFeatures
    """What each camera near the view shows of the points."""
    consistency: SilhouetteConsistency
    """What all silhouettes of the rig say of the points."""


class Seen(NamedTuple):
    """What is looked up."""

    frame: MultiViewFrame
    """The cameras near the view."""
    mask: UInt8[Tensor, "view height width"]
    """The foreground in each, 0 to 255."""
    depth: Float[Tensor, "view height width"]
    """The proxy's z-depth in each, metres; 0 where there is none."""
    silhouettes: Silhouettes
    """The masks of all cameras of the rig."""


def subject_size_m(view: IncompleteView) -> Float[Tensor, ""]:
    """Root of the subject's area at its median depth, metres: the unit along rays, so that any rig fits.

    A pixel, where M is empty.
    """
    f = (view.camera.K[0, 0, 0] * view.camera.K[0, 1, 1]).sqrt()
    return (view.mask > 0).sum().clamp_min(1).sqrt() * view.depth[view.depth > 0].median() / f


def sample_along_rays(
    view: IncompleteView, pixels: Int[Tensor, "pixel 2"], ray_views: ContextViews, offsets: Sequence[float] = OFFSETS
) -> RaySamples:
    """Looks up the rays of these pixels (row, column) in every camera.

    The view needs a depth somewhere; a pixel without takes it from around. `offsets` are z-depths behind the proxy, in
    subject sizes.
    """
    if view.depth.device.type == "cpu":
        from viewmend.inpainting._ray_sampling_numba import sample_numba as implementation
    else:
        from viewmend.inpainting._ray_sampling_torch import sample_torch as implementation
    size_m = subject_size_m(view)
    index = tuple(pixels.unbind(1))
    depth = view.depth[index]
    if not bool((depth > 0).all()):
        depth = pull_push(view.depth[None], view.depth > 0)[0][index]
    mask = ray_views.frame.mask
    if mask is None:
        mask = 255 * (ray_views.depth > 0).to(torch.uint8)
    seen = Seen(ray_views.frame, mask, ray_views.depth, view.silhouettes or Silhouettes(mask, ray_views.frame.cameras))
    is_source = [float(name in view.source_views) for name in ray_views.frame.cameras.names]
    z_m = depth[:, None] + size_m * depth.new_tensor(offsets)
    return implementation(view.camera, pixels.flip(1) + 0.5, z_m, seen, is_source, float(size_m))


def multi_scale_context(
    view: IncompleteView, guess: Float[Tensor, "3 height width"], pixels: Int[Tensor, "pixel 2"]
) -> tuple[Float[Tensor, "place 12 11 11"], Int[Tensor, "pixel"]]:
    """What shape the subject has around each pixel (row, column): means over cells of both sizes, the finer first.

    Pixels of the same cells share them: the second of the pair says which is whose. Channels: RGB of `guess`, the view
    filled smoothly; M; E; and depth, 0.5 at the subject's median and growing with distance. Cells meet at the principal
    point, so that a window of a view has the same.
    """
    subject_px = float((view.mask > 0).sum().sqrt())
    covered = view.depth > 0
    beyond = torch.zeros_like(view.depth)
    if bool(covered.any()):
        beyond = 0.5 + 0.5 * ((view.depth - view.depth[covered].median()) / subject_size_m(view)).tanh()
    shown = torch.cat([guess, view.mask[None], view.error[None], (beyond * covered)[None]])[None]
    sides = [max(1, round(size * subject_px)) for size in CELLS]
    column, row = view.camera.K[0, :2, 2].floor().long().tolist()
    before = [(-row % side, -column % side) for side in sides]
    shifted = [(pixels + pixels.new_tensor(shift)) // side for side, shift in zip(sides, before, strict=True)]
    cells, place = torch.unique(torch.cat(shifted, 1), dim=0, return_inverse=True)
    told = []
    for side, (above, left), at in zip(sides, before, cells.split(2, 1), strict=True):
        means = F.avg_pool2d(padded(F.pad(shown, (left, 0, above, 0)), side), side)[0]
        told.append(windows(means, at, CELLS_AROUND))
    return torch.cat(told, 1), place


def windows(
    image: Float[Tensor, "channel height width"], pixels: Int[Tensor, "pixel 2"], radius: int
) -> Float[Tensor, "pixel channel window window"]:
    """The square around each pixel, zeros beyond the image."""
    framed = F.pad(image, (radius,) * 4)
    reach = torch.arange(2 * radius + 1, device=image.device)
    rows, cols = (pixels[:, i, None] + reach for i in (0, 1))
    return framed[:, rows[:, :, None], cols[:, None, :]].movedim(0, 1)


def subject_px(masks: UInt8[Tensor, "view height width"]) -> float:
    """Root of the subject's area, a mean over cameras."""
    return float((masks.sum((1, 2)) / 255).mean().sqrt())


def side_px(size: float, subject: float) -> int:
    """A length in sizes of a subject of `subject_px`: whole pixels, 1 at least."""
    return max(1, round(size * subject))


def padded(
    images: Shaped[Tensor, "view channel height width"], side: int
) -> Shaped[Tensor, "view channel whole_height whole_width"]:
    """The images with zeros right and below, so that squares of this side cover them."""
    return F.pad(images, (0, -images.shape[3] % side, 0, -images.shape[2] % side))
