"""What the cameras show along the rays of missing pixels. Ours.

A hole is where no chosen camera sees the proxy. The true surface is at or behind the proxy's, and what it looks like is
in the images: where a ray passes it, cameras that see it agree. So the ray is followed from the proxy inwards, and each
of its points looked up in each camera (as in IBRNet, Wang et al., CVPR 2021, which renders whole views so).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import project, unproject
from viewmend.inpainting.coarse_fill import pull_push
from viewmend.views import ContextViews, IncompleteView, Silhouettes

OFFSETS = (-0.015, 0.0, 0.008, 0.016, 0.03, 0.055, 0.09, 0.15, 0.24, 0.36, 0.55)
"""Where a ray is looked at: z-depth behind the proxy, in subject sizes."""
RAY_CHANNELS = 14
"""Features of one point in one camera."""
NEAR, FAR = 0.03, 0.2
"""Subject sizes over which the fine and the coarse distance behind the proxy saturate."""
OUTLINE = 0.06
"""Side, in subject sizes, of the squares over which masks are averaged to tell how near their outline is,"""
PATCH = 0.08
"""of those over which colours are: single pixels agree by chance more easily,"""
CELLS = (0.03, 0.06)
"""and of those in which a view's pixel is told of its farther surroundings."""
CELL_CHANNELS = 6
"""RGB of the smoothly filled view, M, E and depth."""
CELLS_AROUND = 5
"""So many cells to each side."""


@dataclass(frozen=True)
class RaySamples:
    """Points along the rays of some pixels, as each camera shows them."""

    features: Float[Tensor, "pixel point view 14"]
    """RGB (background black), mask, how far behind the proxy as that camera sees it (fine and coarse, -1 to 1), cosine
    between its ray and the pixel's, 1 for a camera that coloured the view, 1 where the camera has the point in view,
    and means around: of the mask (where the outlines of two cameras meet, a hull is fattest), of the colours, and of
    what the proxy covers (more than the mask where it is fat). All 0 for a point out of view."""
    occupancy: Float[Tensor, "pixel point 4"]
    """Least and second least mask of all cameras of the rig that have the point in view: 0 where one sees background
    there, and where another does, too; 1 where there is no such camera. The same of the mask's means around."""


def subject_size_m(view: IncompleteView) -> Float[Tensor, ""]:
    """Root of the subject's area at its median depth, metres: the unit along rays, so that any rig fits.

    A pixel, where M is empty.
    """
    f = (view.camera.K[0, 0, 0] * view.camera.K[0, 1, 1]).sqrt()
    return (view.mask > 0).sum().clamp_min(1).sqrt() * view.depth[view.depth > 0].median() / f


def sample_along_rays(view: IncompleteView, pixels: Int[Tensor, "pixel 2"], nearby: ContextViews) -> RaySamples:
    """Looks up the rays of these pixels (row, column) in every camera.

    The view needs a depth somewhere; a pixel without takes it from around.
    """
    cameras, frame = nearby.frame.cameras, nearby.frame
    size_m = subject_size_m(view)
    index = tuple(pixels.unbind(1))
    depth = view.depth[index]
    if not bool((depth > 0).all()):
        depth = pull_push(view.depth[None], view.depth > 0)[0][index]
    z = depth[:, None] + size_m * depth.new_tensor(OFFSETS)
    uv = (pixels.flip(1) + 0.5).to(z)[:, None].expand(-1, len(OFFSETS), -1)
    points = unproject(uv.reshape(1, -1, 2), z.reshape(1, -1), view.camera)[0]

    at, z = project(points, cameras)
    inside = (z > 0) & (at >= 0).all(-1) & (at < cameras.size_px[:, None]).all(-1)
    seen = _seen(nearby, at) * inside[..., None]
    coverage, surface_m = seen[..., 4], seen[..., 5] / seen[..., 4].clamp_min(0.05)
    behind = torch.where(coverage > 0.3, (z - surface_m) / size_m, 0.0)
    to_viewer = F.normalize(view.camera.centers[0] - points, dim=-1)
    cosine = (F.normalize(cameras.centers[:, None] - points, dim=-1) * to_viewer).sum(-1)
    chosen = z.new_tensor([name in view.source_views for name in cameras.names])[:, None].expand_as(z)
    mask = frame.mask if frame.mask is not None else 255 * (nearby.depth > 0).to(torch.uint8)
    place = torch.stack([(behind / NEAR).tanh(), (behind / FAR).tanh(), cosine, chosen, torch.ones_like(z)], -1)
    around = _around(frame.rgb, mask, nearby.depth > 0, at)
    features = torch.cat([seen[..., :4], torch.cat([place, around], -1) * inside[..., None]], -1).movedim(0, 1)
    silhouettes = view.silhouettes or Silhouettes(mask, cameras)
    occupancy = _silhouette_consistency(points, silhouettes)
    shape = (len(pixels), len(OFFSETS))
    return RaySamples(features.unflatten(0, shape), occupancy.unflatten(0, shape))


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


def _seen(nearby: ContextViews, at: Float[Tensor, "view point 2"]) -> Float[Tensor, "view point 6"]:
    """RGB before black, mask, whether the proxy is there and its depth, between pixel centres; zeros beyond.

    Only four pixels a point are looked at: whole images would take longer to convert than to read.
    """
    frame = nearby.frame
    view = torch.arange(len(frame.cameras), device=at.device)[:, None]
    seen = at.new_zeros(*at.shape[:2], 6)
    for row, column, share in _corners(at, nearby.depth.shape[1:]):
        depth = nearby.depth[view, row, column]
        covered = (depth > 0).to(at)
        mask = covered if frame.mask is None else frame.mask[view, row, column].to(at) / 255
        rgb = frame.rgb[view, :, row, column].to(at) / 255 * mask[..., None]
        seen += share[..., None] * torch.cat([rgb, torch.stack([mask, covered, depth], -1)], -1)
    return seen


def _corners(
    at: Float[Tensor, "view point 2"], size: Sequence[int]
) -> Iterator[tuple[Int[Tensor, "view point"], Int[Tensor, "view point"], Float[Tensor, "view point"]]]:
    """Row, column and bilinear share of the four pixels around each place; a share of 0 for those beyond the image."""
    height, width = size
    at = at.clamp(-4, 4 * max(size)) - 0.5
    first = at.floor()
    right, below = (at - first).unbind(-1)
    for down, across in product((0, 1), (0, 1)):
        column, row = (first[..., 0] + across).long(), (first[..., 1] + down).long()
        there = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        share = (right if across else 1 - right) * (below if down else 1 - below) * there
        yield row.clamp(0, height - 1), column.clamp(0, width - 1), share


def _silhouette_consistency(points: Float[Tensor, "point 3"], silhouettes: Silhouettes) -> Float[Tensor, "point 4"]:
    """The two smallest mask values at each point, and means around; a camera that has it not in view says 1."""
    cameras, mask = silhouettes.cameras, silhouettes.mask
    at, z = project(points, cameras)
    inside = (z > 0) & (at >= 0).all(-1) & (at < cameras.size_px[:, None]).all(-1)
    view = torch.arange(len(cameras), device=mask.device)[:, None]
    corners = _corners(at, mask.shape[1:])
    value = sum((share * mask[view, row, column] for row, column, share in corners), torch.zeros_like(z)) / 255
    side = max(1, round(OUTLINE * _subject_px(mask)))
    around = _between(_means(mask[:, None], side), at / side)[..., 0]
    values = torch.where(inside, torch.stack([value, around]), 1.0)
    values = F.pad(values, (0, 0, 0, 2), value=1.0)  # two cameras more, that see nothing
    return values.topk(2, dim=1, largest=False).values.flatten(0, 1).T


def _around(
    rgb: UInt8[Tensor, "view 3 height width"],
    mask: UInt8[Tensor, "view height width"],
    covered: Bool[Tensor, "view height width"],
    at: Float[Tensor, "view point 2"],
) -> Float[Tensor, "view point 5"]:
    """Means around each place: of the mask, of RGB before black, and of what the proxy covers."""
    subject_px = _subject_px(mask)
    side, half = (max(1, round(share * subject_px)) for share in (OUTLINE, PATCH / 2))
    shapes = _means(torch.stack([mask, covered.to(torch.uint8) * 255], 1), side)
    # Of colours every other row and column will do.
    colours = F.avg_pool2d(_padded(rgb[..., ::2, ::2].to(at) * mask[:, None, ::2, ::2], half), half) / 255**2
    masked, proxy = _between(shapes, at / side).split(1, -1)
    return torch.cat([masked, _between(colours, at / (2 * half)), proxy], -1)


def _subject_px(mask: UInt8[Tensor, "view height width"]) -> float:
    """Root of the subject's area, a mean over cameras."""
    return float((mask.sum((1, 2)) / 255).mean().sqrt())


def _means(shapes: UInt8[Tensor, "view shape height width"], side: int) -> Float[Tensor, "view shape rows columns"]:
    """Of squares of this side, 255 as 1. Whole numbers: pooling is slower."""
    squares = _padded(shapes, side).unflatten(3, (-1, side)).unflatten(2, (-1, side))
    return squares.sum(3, dtype=torch.int32).sum(4).float() / (255 * side**2)


def _padded(
    images: Shaped[Tensor, "view channel height width"], side: int
) -> Shaped[Tensor, "view channel whole_height whole_width"]:
    """With zeros right and below, so that squares of this side cover the images."""
    return F.pad(images, (0, -images.shape[3] % side, 0, -images.shape[2] % side))


def _between(
    images: Float[Tensor, "view channel height width"], at: Float[Tensor, "view point 2"]
) -> Float[Tensor, "view point channel"]:
    """The images between pixel centres, zeros beyond."""
    height, width = images.shape[2:]
    grid = at.clamp(-4, 4 * max(height, width)) * 2 / at.new_tensor([width, height]) - 1
    return F.grid_sample(images, grid[:, None], align_corners=False)[:, :, 0].movedim(1, -1)
