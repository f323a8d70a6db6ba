"""Fused geometry that flickers less: where no image changes, the surface changes little.

Every frame's surface is fused from depth that a model predicts for this frame, so it differs a little
from the last frame's, also where nothing moves. What no camera has seen changing is most likely as it
was: there the occupancy is averaged over the frames, exponentially. Where a camera that saw the last
surface shows something else now, the frame keeps its own occupancy, so nothing lags behind.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.hull import OccupancyGrid
from viewmend.geometry.sampling import in_view, nearest_pixels

SIMILAR = 6.0
"""The stillness of a pixel falls to 1/e at this change, in 255ths."""
MEAN_PX = 5
"""Changes are means over squares of this side, in pixels, so that noise does not count."""
AROUND_PX = 5
"""A pixel has the largest change in a square of this side around it, in pixels."""
BEHIND_VOXELS = 4.0
"""A camera sees the voxels up to this far behind the last surface, in voxels."""
SLACK = 1e-3
"""A box may exceed its voxels by this share of a voxel, because of rounding."""
SIZE_CHANGE = 0.03
"""Voxels keep the last frame's size if their own would differ from it by at most this share."""
POINTS_AT_ONCE = 2**18
"""The number of voxels that are looked up in the cameras together."""


@dataclass(frozen=True)
class LastSurface:
    """The fused surface of an earlier frame, and how little its images have changed since."""

    occupancy: OccupancyGrid
    """Averaged with that of frames before it."""
    cameras: Cameras
    depth: Float[Tensor, "view height width"]
    """z-depth of its surface in each camera, metres; 0 where there is none."""
    stillness: Float[Tensor, "view height width"]
    """How little each pixel has changed, in [0, 1]; 1 where nothing has (`stillness`)."""


def stillness(
    now: UInt8[Tensor, "view channel height width"], then: UInt8[Tensor, "view channel height width"]
) -> Float[Tensor, "view height width"]:
    """How little each pixel of these images has changed, in [0, 1]: 1 where nothing has."""
    per_view = []
    for image, earlier in zip(now, then, strict=True):
        summed = _row_sums(image.float() - earlier.float())
        summed = _row_sums(summed.mT).mT
        mean = summed.abs().amax(0, keepdim=True) / MEAN_PX**2
        change = F.max_pool2d(mean, AROUND_PX, 1, AROUND_PX // 2)[0]
        per_view.append(torch.exp(-((change / SIMILAR) ** 2)))
    return torch.stack(per_view)


def _row_sums(values: Float[Tensor, "channel height width"]) -> Float[Tensor, "channel height width"]:
    """The sum of the `MEAN_PX` values around each in its row; beyond the ends they are 0."""
    total = F.pad(values, (MEAN_PX // 2 + 1, MEAN_PX // 2)).cumsum(-1)
    return total[..., MEAN_PX:] - total[..., :-MEAN_PX]


def continued(bounds: Bounds, resolution: int, last: OccupancyGrid) -> tuple[Bounds, int]:
    """A box around `bounds` and a resolution by which its voxels lie where the last frame's do.

    Otherwise the last occupancy would be interpolated again in each frame, which blurs it. If the subject's
    size has changed too much (`SIZE_CHANGE`), both are returned as they are.
    """
    box = bounds.on_host
    side_m = float(box.size_m.max()) / resolution
    if abs(last.voxel_m / side_m - 1) > SIZE_CHANGE:
        return bounds, resolution
    first = ((box.low - last.low) / last.voxel_m + SLACK).floor()
    end = ((box.high - last.low) / last.voxel_m - SLACK).ceil()
    low = last.low + first * last.voxel_m
    high = last.low + end * last.voxel_m
    return Bounds(low, high).to(bounds.low.device), int((end - first).max())


def steadied(fused: OccupancyGrid, hull: OccupancyGrid, last: LastSurface, share: float) -> OccupancyGrid:
    """The occupancy, averaged with the last surface's where the images are still; never above the hull's.

    Args:
        fused: the frame's own occupancy.
        hull: the occupancy of the frame's hull, on the same voxels.
        last: the surface of an earlier frame.
        share: the largest share of the last surface, in [0, 1].
    """
    values = fused.values.flatten()
    filled = (hull.values.flatten() > 0).nonzero()[:, 0]
    points = fused.cubes.centers(values.device)[filled]
    change = _occupancy_at(last.occupancy, points) - values[filled]
    differs = change != 0
    index = filled[differs]
    points = points[differs]
    voxel_m = fused.voxel_m
    still = [_stillness_at(part, last, voxel_m) for part in points.split(POINTS_AT_ONCE)]
    averaged = values.clone()
    if still:
        averaged[index] += share * torch.cat(still) * change[differs]
    return replace(fused, values=torch.minimum(averaged.view(fused.values.shape), hull.values))


def _occupancy_at(grid: OccupancyGrid, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point"]:
    """The occupancy at points, interpolated between voxels; 0 outside of the grid."""
    low = grid.low.to(points)
    size_m = grid.voxel_m * points.new_tensor(grid.values.shape)
    place = 2 * (points - low) / size_m - 1
    at = place.flip(1)[None, None, None]
    return F.grid_sample(grid.values[None, None], at, padding_mode="zeros", align_corners=False).flatten()


def _stillness_at(
    points: Float[Tensor, "point 3"], last: LastSurface, voxel_m: float
) -> Float[Tensor, "point"]:
    """The least stillness of the pixels that show each point, in the cameras that see it.

    If the last surface hides a point from all cameras, all of them count.
    """
    cameras = last.cameras
    uv, z = project(points, cameras)
    inside = in_view(uv, z, cameras)
    pixels = nearest_pixels(uv, cameras)
    surface = last.depth[pixels]
    still = torch.where(inside, last.stillness[pixels], 1.0)
    sees = inside & ((surface == 0) | (z < surface + BEHIND_VOXELS * voxel_m))
    return torch.where(sees.any(0), torch.where(sees, still, 1.0).amin(0), still.amin(0))
