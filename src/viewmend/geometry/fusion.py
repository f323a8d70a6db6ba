"""The visual hull, tightened by depth maps that a model predicted.

A hull cannot be concave, and with few cameras it is too large. Depth maps are fused as in Curless
and Levoy (SIGGRAPH 1996): every voxel takes the weighted mean of its signed distances to the
surfaces that the views see. The hull counts as an additional view. So the surface stays on the hull
where no view near it has depth, and moves less where depth is uncertain. Where all depth is uncertain,
distances are also averaged over neighbouring voxels; otherwise the surface would be rough. Where images
do not change from frame to frame, the surface is averaged over time (`geometry/last_surface.py`).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.hull import HullConfig, OccupancyGrid, kernel_arrays, visual_hull
from viewmend.geometry.hull_parts import without_floating_parts
from viewmend.geometry.last_surface import LastSurface, continued, steadied
from viewmend.geometry.mesh import vertex_normals
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.sampling import in_view, nearest_pixels
from viewmend.geometry.surface import extract_surface
from viewmend.geometry.threads import one_thread, parallel_for
from viewmend.utils.tensors import OnDevice

LEAST_CONFIDENCE = 1e-3
"""Lower confidences are raised to this one, so that weights are never 0."""

VOXELS_AT_ONCE = 2**18
"""The number of voxels that are fused together on a device other than the CPU."""


@dataclass(frozen=True, kw_only=True)
class FusionConfig:
    """How predicted depths are fused with the hull.

    Examples:
        >>> from viewmend import FusionConfig, StreamConfig
        >>> StreamConfig(geometry="fused", fusion=FusionConfig(max_views=8)).fusion.max_views
        8
    """

    resolution: int = 224
    """Voxels along the longest side of the subject's box."""
    max_views: int = 16
    """Largest number of views whose depth is predicted. The rig's cameras come first, then virtual
    cameras in the gaps between them."""
    min_angle_deg: float = 8.0
    """Smallest angle between two of these views, as seen from the subject, in degrees."""
    view_px: int = 480
    """Pixels that the longest side of the subject's box spans in the views whose depth is predicted."""
    truncation_voxels: float = 3.0
    """Largest signed distance, in voxels: voxels that are farther in front of a surface count as this
    far from it. A view says nothing about voxels that are farther behind the surface that it sees."""
    hull_weight: float = 1.0
    """The hull counts as a view with this confidence. Other views have up to 1."""
    smooth_below: float = 0.2
    """Where the views' mean confidence is lower, the surface is smoothed."""
    sharp_above: float = 0.35
    """Where the views' mean confidence is higher, the surface is not smoothed."""
    last_share: float = 0.8
    """The share of the last frame's occupancy where no image has changed. With 0, every frame is fused on
    its own."""

    def __post_init__(self) -> None:
        if not self.hull_weight > 0:
            raise ValueError(f"expected a hull_weight above 0, got {self.hull_weight}")
        if not self.smooth_below < self.sharp_above:
            raise ValueError(
                f"expected smooth_below to be less than sharp_above, got {self.smooth_below} and {self.sharp_above}"
            )
        if not 0 <= self.last_share < 1:
            raise ValueError(f"expected a last_share from 0 to below 1, got {self.last_share}")


@dataclass(frozen=True)
class DepthViews(OnDevice):
    """The subject's depth in some views, as a model predicts it. Images are padded to the largest."""

    cameras: Cameras
    depth: Float[Tensor, "view height width"]
    """z-depth of the surface, metres; 0 where a view says nothing."""
    confidence: Float[Tensor, "view height width"]
    """How certain the depth is, in [0, 1]."""


@dataclass(frozen=True)
class FusedSurface:
    """A frame's fused surface, as a mesh and as voxels."""

    proxy: GeometryProxy
    occupancy: OccupancyGrid


@one_thread()
def fuse_depth(
    proxy: GeometryProxy,
    mask: UInt8[Tensor, "view height width"],
    cameras: Cameras,
    views: DepthViews,
    config: FusionConfig | None = None,
    hull_config: HullConfig | None = None,
    last: LastSurface | None = None,
) -> FusedSurface:
    """The hull of these masks, tightened by depth views, within the box of its proxy.

    Args:
        proxy: the hull's surface; only its box is used.
        mask: the masks that carve the hull.
        cameras: the masks' cameras.
        views: depth in real or virtual views.
        config: parameters of the fusion.
        hull_config: parameters of the hull, except its resolution, which is that of the fusion.
        last: the last frame's surface; None without one.

    Raises:
        ValueError: there are masks of one camera only.
    """
    config = config or FusionConfig()
    box = proxy.bounds
    resolution = config.resolution
    if last is not None:
        box, resolution = continued(box, resolution, last.occupancy)
    hull = visual_hull(mask, cameras, box, replace(hull_config or HullConfig(), resolution=resolution))
    fused = fuse_occupancy(hull, views, config)
    if last is not None:
        fused = steadied(fused, hull, last, config.last_share)
    fused = without_floating_parts(fused, cameras)
    mesh = extract_surface(fused)
    return FusedSurface(GeometryProxy(mesh, vertex_normals(mesh), proxy.bounds), fused)


def fuse_occupancy(hull: OccupancyGrid, views: DepthViews, config: FusionConfig) -> OccupancyGrid:
    """Occupancy after fusion: 1 inside, 0 outside, one half on the surface, and never above the hull's.

    Each view that sees a voxel adds its signed distance to the surface along the axis of
    its camera, weighted by the confidence. `config.truncation_voxels` limits distances in
    front of the surface; a view says nothing about voxels that are farther behind it. Nor does it
    where its depth or its confidence is not finite.
    """
    is_finite = views.depth.isfinite() & views.confidence.isfinite()
    depth = torch.where(is_finite, views.depth, 0.0)
    views = DepthViews(views.cameras, depth, torch.where(is_finite, views.confidence, 0.0))
    on_cpu = hull.values.device.type == "cpu"
    add_up = _sums_numba if on_cpu else _sums_torch
    take_vote = _vote_numba if on_cpu else _vote_torch
    return OccupancyGrid(take_vote(hull.values, add_up(hull, views, config), config), hull.low, hull.voxel_m)


def _vote_numba(
    occupancy: Float[Tensor, "x y z"], sums: Float[Tensor, "3 x y z"], config: FusionConfig
) -> Float[Tensor, "x y z"]:
    """What `_vote_torch` returns, by compiled loops on all threads."""
    from viewmend.geometry._fusion_numba import vote

    hull = occupancy.contiguous().numpy()
    fused = np.zeros_like(hull)

    def work(slab: int) -> None:
        vote(slab, hull, sums.numpy(), config.hull_weight, config.smooth_below, config.sharp_above, fused)

    parallel_for(work, hull.shape[0])
    return torch.from_numpy(fused)


def _vote_torch(
    occupancy: Float[Tensor, "x y z"], sums: Float[Tensor, "3 x y z"], config: FusionConfig
) -> Float[Tensor, "x y z"]:
    """The fused occupancy, given the hull's occupancy and what the views say about each voxel."""
    _, weights, num_views = sums

    # smooth where confidence is low and, to leave no steps next to it, where no view sees the voxel
    mean_confidence = weights / num_views.clamp_min(1)
    sharp = (mean_confidence - config.smooth_below) / (config.sharp_above - config.smooth_below)
    weighted = sums[:2]
    smooth_distances, smooth_weights = F.avg_pool3d(weighted, 3, stride=1, padding=1).lerp(
        weighted, sharp.clamp(0, 1)
    )

    # add the hull as a view: an occupancy o stands for a signed distance of 1 - 2 o voxels
    total_distance = smooth_distances + config.hull_weight * (1 - 2 * occupancy)
    total_weight = smooth_weights + config.hull_weight
    return torch.minimum(occupancy, (0.5 - 0.5 * total_distance / total_weight).clamp_min(0))


def _sums_numba(hull: OccupancyGrid, views: DepthViews, config: FusionConfig) -> Float[Tensor, "3 x y z"]:
    """What the views say about each voxel of the hull, by compiled loops on all threads.

    The sum of the distances in voxels, weighted by the confidence; the sum of the confidence; and the number of views.
    """
    from viewmend.geometry._fusion_numba import sum_distances

    occupancy = hull.values.contiguous().numpy()
    sums = np.zeros((3, *occupancy.shape), occupancy.dtype)
    P, _, size_px, low = kernel_arrays(views.cameras, hull.cubes)
    depth = views.depth.float().contiguous().numpy()
    confidence = views.confidence.float().clamp_min(LEAST_CONFIDENCE).contiguous().numpy()

    def work(slab: int) -> None:
        sum_distances(
            slab, occupancy, P, size_px, low, depth, confidence, hull.voxel_m, config.truncation_voxels, sums
        )

    parallel_for(work, occupancy.shape[0])
    return torch.from_numpy(sums)


def _sums_torch(hull: OccupancyGrid, views: DepthViews, config: FusionConfig) -> Float[Tensor, "3 x y z"]:
    """What `_sums_numba` returns, on any device."""
    occupancy = hull.values.flatten()
    filled = (occupancy > 0).nonzero()[:, 0]
    centers = hull.cubes.centers(occupancy.device)[filled]
    parts = [_sums_at(points, hull.voxel_m, views, config) for points in centers.split(VOXELS_AT_ONCE)]
    sums = occupancy.new_zeros(3, len(occupancy))
    if parts:
        sums[:, filled] = torch.cat(parts, 1)
    return sums.view(3, *hull.values.shape)


def _sums_at(
    points: Float[Tensor, "point 3"], voxel_m: float, views: DepthViews, config: FusionConfig
) -> Float[Tensor, "3 point"]:
    """What the views say about points in the hull."""
    cameras = views.cameras
    uv, z = project(points, cameras)
    sees = in_view(uv, z, cameras)

    # The depth and the confidence of the pixel that shows each point
    pixels = nearest_pixels(uv, cameras)
    depth = views.depth[pixels]
    confidence = views.confidence[pixels]

    # The signed distances to the surfaces, in voxels
    distance = (depth - z) / voxel_m
    is_used = sees & (depth > 0) & (distance > -config.truncation_voxels)
    weight = confidence.clamp_min(LEAST_CONFIDENCE) * is_used
    summed = (weight * distance.clamp(max=config.truncation_voxels)).sum(0)
    return torch.stack([summed, weight.sum(0), is_used.sum(0).to(weight)])
