"""Rays looked up in torch, for any device; `_ray_sampling_numba` is the twin for the CPU."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, project, unproject
from viewmend.geometry.sampling import bilinear_taps, in_view, sample_bilinear
from viewmend.inpainting.ray_sampling import (
    COVERED,
    FAR,
    NEAR,
    OUTLINE,
    PATCH,
    RayFeatures,
    RaySamples,
    Seen,
    SilhouetteConsistency,
    padded,
    side_px,
    subject_px,
)
from viewmend.views import Silhouettes


def sample_torch(
    camera: Cameras,
    uv_px: Float[Tensor, "pixel 2"],
    z_m: Float[Tensor, "pixel point"],
    seen: Seen,
    is_source: Sequence[float],
    size_m: float,
) -> RaySamples:
    """`ray_sampling.sample_along_rays`, at these z-depths along the rays of a camera's pixels."""
    cameras, shape = seen.frame.cameras, z_m.shape
    uv = uv_px.to(z_m)[:, None].expand(-1, shape[1], -1)
    points = unproject(uv.reshape(1, -1, 2), z_m.reshape(1, -1), camera)[0]

    at, z = project(points, cameras)
    inside = in_view(at, z, cameras)[..., None].to(z)
    to_viewer = F.normalize(camera.centers[0] - points, dim=-1)
    cosine = (F.normalize(cameras.centers[:, None] - points, dim=-1) * to_viewer).sum(-1, keepdim=True)

    colour, own_mask, coverage, depth = _at_points(seen, at).split((3, 1, 1, 1), -1)
    behind = torch.where(coverage > COVERED, (z[..., None] - depth / coverage.clamp_min(COVERED)) / size_m, 0.0)
    mean_mask, mean_colour, mean_coverage = _means_at_points(seen.frame.rgb, seen.mask, seen.depth > 0, at)
    features = RayFeatures(
        colour=colour,
        mask=own_mask,
        depth_difference=(behind / NEAR).tanh(),
        coarse_depth_difference=(behind / FAR).tanh(),
        viewing_cosine=cosine,
        is_source=z.new_tensor(is_source)[:, None, None].expand_as(cosine),
        in_view=inside,
        mean_mask=mean_mask,
        mean_colour=mean_colour,
        mean_coverage=mean_coverage,
    )
    consistency = _silhouette_consistency(points, seen.silhouettes)
    return RaySamples(
        RayFeatures(*((values * inside).movedim(0, 1).unflatten(0, shape) for values in features)),
        SilhouetteConsistency(*consistency.unflatten(0, shape).split(1, -1)),
    )


def _at_points(seen: Seen, at: Float[Tensor, "view point 2"]) -> Float[Tensor, "view point 6"]:
    """RGB before black, mask, whether the proxy is there and its depth, bilinearly; zeros beyond the image."""
    height, width = seen.depth.shape[1:]
    view = torch.arange(len(seen.depth), device=at.device)[:, None]
    total = at.new_zeros(*at.shape[:2], 6)
    for tap in bilinear_taps(at, width, height):
        depth = seen.depth[view, tap.row, tap.column]
        covered = (depth > 0).to(at)
        mask = seen.mask[view, tap.row, tap.column].to(at) / 255
        rgb = seen.frame.rgb[view, :, tap.row, tap.column].to(at) / 255 * mask[..., None]
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
    side = side_px(OUTLINE, subject_px(mask))
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
    subject = subject_px(mask)
    side, half = side_px(OUTLINE, subject), side_px(PATCH / 2, subject)
    shapes = _means(torch.stack([mask, covered.to(torch.uint8) * 255], 1), side)
    # Of colours every other row and column will do.
    colours = F.avg_pool2d(padded(rgb[..., ::2, ::2].to(at) * mask[:, None, ::2, ::2], half), half) / 255**2
    mean_mask, mean_coverage = sample_bilinear(shapes, at / side).split(1, -1)
    return mean_mask, sample_bilinear(colours, at / (2 * half)), mean_coverage


def _means(shapes: UInt8[Tensor, "view shape height width"], side: int) -> Float[Tensor, "view shape rows columns"]:
    """Means of squares of this side, 255 as 1. Whole numbers: pooling is slower."""
    squares = padded(shapes, side).unflatten(3, (-1, side)).unflatten(2, (-1, side))
    return squares.sum(3, dtype=torch.int32).sum(4).float() / (255 * side**2)
