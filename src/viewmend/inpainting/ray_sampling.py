"""What the cameras show along the rays of missing pixels. Ours.

A hole is where no source view sees the proxy. The true surface is at or behind the proxy's, and what it looks like is
in the images: where a ray passes it, cameras that see it agree. So the ray is followed from the proxy inwards, and each
of its points looked up in each camera (as in IBRNet, Wang et al., CVPR 2021, which renders whole views so).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import project, unproject
from viewmend.geometry.sampling import bilinear_taps, in_view, sample_bilinear
from viewmend.inpainting.coarse_fill import pull_push
from viewmend.views import ContextViews, IncompleteView, Silhouettes

OFFSETS = (-0.015, 0.0, 0.008, 0.016, 0.03, 0.055, 0.09, 0.15, 0.24, 0.36, 0.55)
"""Where a ray is looked at: z-depth behind the proxy, in subject sizes."""
NEAR, FAR = 0.03, 0.2
"""Subject sizes over which the fine and the coarse distance behind the proxy saturate."""
OUTLINE = 0.06
"""Side, in subject sizes, of the squares over which masks are averaged: this tells how near their outline is."""
PATCH = 0.08
"""Side, in subject sizes, of the squares over which colours are averaged: single pixels agree by chance more easily."""
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
    cameras, shape = ray_views.frame.cameras, (len(pixels), len(offsets))
    size_m = subject_size_m(view)
    index = tuple(pixels.unbind(1))
    depth = view.depth[index]
    if not bool((depth > 0).all()):
        depth = pull_push(view.depth[None], view.depth > 0)[0][index]
    z = depth[:, None] + size_m * depth.new_tensor(offsets)
    uv = (pixels.flip(1) + 0.5).to(z)[:, None].expand(-1, len(offsets), -1)
    points = unproject(uv.reshape(1, -1, 2), z.reshape(1, -1), view.camera)[0]

    at, z = project(points, cameras)
    inside = in_view(at, z, cameras)[..., None].to(z)
    to_viewer = F.normalize(view.camera.centers[0] - points, dim=-1)
    cosine = (F.normalize(cameras.centers[:, None] - points, dim=-1) * to_viewer).sum(-1, keepdim=True)
    is_source = z.new_tensor([name in view.source_views for name in cameras.names])[:, None, None].expand_as(cosine)
    mask = ray_views.frame.mask if ray_views.frame.mask is not None else 255 * (ray_views.depth > 0).to(torch.uint8)

    colour, own_mask, coverage, depth = _at_points(ray_views, at).split((3, 1, 1, 1), -1)
    behind = torch.where(coverage > 0.3, (z[..., None] - depth / coverage.clamp_min(0.05)) / size_m, 0.0)
    mean_mask, mean_colour, mean_coverage = _means_at_points(ray_views.frame.rgb, mask, ray_views.depth > 0, at)
    features = RayFeatures(
        colour=colour,
        mask=own_mask,
        depth_difference=(behind / NEAR).tanh(),
        coarse_depth_difference=(behind / FAR).tanh(),
        viewing_cosine=cosine,
        is_source=is_source,
        in_view=inside,
        mean_mask=mean_mask,
        mean_colour=mean_colour,
        mean_coverage=mean_coverage,
    )
    consistency = _silhouette_consistency(points, view.silhouettes or Silhouettes(mask, cameras))
    return RaySamples(
        RayFeatures(*((values * inside).movedim(0, 1).unflatten(0, shape) for values in features)),
        SilhouetteConsistency(*consistency.unflatten(0, shape).split(1, -1)),
    )


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
        means = F.avg_pool2d(_padded(F.pad(shown, (left, 0, above, 0)), side), side)[0]
        told.append(windows(means, at, CELLS_AROUND))
    return torch.cat(told, 1), place


def windows(
    image: Float[Tensor, "channel height width"], pixels: Int[Tensor, "pixel 2"], radius: int
) -> Float[Tensor, "pixel channel window window"]:
    """The square around each pixel, zeros beyond the image."""
    padded = F.pad(image, (radius,) * 4)
    reach = torch.arange(2 * radius + 1, device=image.device)
    rows, cols = (pixels[:, i, None] + reach for i in (0, 1))
    return padded[:, rows[:, :, None], cols[:, None, :]].movedim(0, 1)


def _at_points(ray_views: ContextViews, at: Float[Tensor, "view point 2"]) -> Float[Tensor, "view point 6"]:
    """RGB before black, mask, whether the proxy is there and its depth, bilinearly; zeros beyond the image."""
    frame, (height, width) = ray_views.frame, ray_views.depth.shape[1:]
    view = torch.arange(len(frame.cameras), device=at.device)[:, None]
    total = at.new_zeros(*at.shape[:2], 6)
    for tap in bilinear_taps(at, width, height):
        depth = ray_views.depth[view, tap.row, tap.column]
        covered = (depth > 0).to(at)
        mask = covered if frame.mask is None else frame.mask[view, tap.row, tap.column].to(at) / 255
        rgb = frame.rgb[view, :, tap.row, tap.column].to(at) / 255 * mask[..., None]
        values = torch.cat([rgb, torch.stack([mask, covered, depth], -1)], -1)
        total += (tap.weight * tap.inside)[..., None] * values
    return total


def _silhouette_consistency(points: Float[Tensor, "point 3"], silhouettes: Silhouettes) -> Float[Tensor, "point 4"]:
    """The two smallest mask values at each point, and means around; a camera that has it not in view says 1."""
    cameras, mask = silhouettes.cameras, silhouettes.mask
    at, z = project(points, cameras)
    view = torch.arange(len(cameras), device=mask.device)[:, None]
    value = torch.zeros_like(z)
    for tap in bilinear_taps(at, mask.shape[2], mask.shape[1]):
        value += tap.weight * tap.inside * mask[view, tap.row, tap.column]
    side = max(1, round(OUTLINE * _subject_px(mask)))
    mean = sample_bilinear(_means(mask[:, None], side), at / side)[..., 0]
    values = torch.where(in_view(at, z, cameras), torch.stack([value / 255, mean]), 1.0)
    values = F.pad(values, (0, 0, 0, 2), value=1.0)  # two cameras more, that see nothing
    return values.topk(2, dim=1, largest=False).values.flatten(0, 1).T


def _means_at_points(
    rgb: UInt8[Tensor, "view 3 height width"],
    mask: UInt8[Tensor, "view height width"],
    covered: Bool[Tensor, "view height width"],
    at: Float[Tensor, "view point 2"],
) -> tuple[Float[Tensor, "view point 1"], Float[Tensor, "view point 3"], Float[Tensor, "view point 1"]]:
    """Means around each point of the mask, of RGB before black, and of what the proxy covers."""
    subject_px = _subject_px(mask)
    side, half = (max(1, round(size * subject_px)) for size in (OUTLINE, PATCH / 2))
    shapes = _means(torch.stack([mask, covered.to(torch.uint8) * 255], 1), side)
    # Of colours every other row and column will do.
    colours = F.avg_pool2d(_padded(rgb[..., ::2, ::2].to(at) * mask[:, None, ::2, ::2], half), half) / 255**2
    mean_mask, mean_coverage = sample_bilinear(shapes, at / side).split(1, -1)
    return mean_mask, sample_bilinear(colours, at / (2 * half)), mean_coverage


def _subject_px(mask: UInt8[Tensor, "view height width"]) -> float:
    """Root of the subject's area, a mean over cameras."""
    return float((mask.sum((1, 2)) / 255).mean().sqrt())


def _means(shapes: UInt8[Tensor, "view shape height width"], side: int) -> Float[Tensor, "view shape rows columns"]:
    """Means of squares of this side, 255 as 1. Whole numbers: pooling is slower."""
    squares = _padded(shapes, side).unflatten(3, (-1, side)).unflatten(2, (-1, side))
    return squares.sum(3, dtype=torch.int32).sum(4).float() / (255 * side**2)


def _padded(
    images: Shaped[Tensor, "view channel height width"], side: int
) -> Shaped[Tensor, "view channel whole_height whole_width"]:
    """The images with zeros right and below, so that squares of this side cover them."""
    return F.pad(images, (0, -images.shape[3] % side, 0, -images.shape[2] % side))
