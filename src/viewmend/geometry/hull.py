"""The visual hull: soft occupancy on a grid, carved by the masks of all cameras."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import conv2d, pad

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.sampling import in_view, sample_bilinear
from viewmend.geometry.threads import parallel_for

FOREGROUND = 127
"""A mask's pixel is foreground if its value, from 0 to 255, is above this."""
TILES = 32
"""The search for the subject's box divides a mask's shorter side into this many tiles."""
BLOCK = 4
"""The kernels judge blocks of this many voxels, and tiles of this many pooled pixels, whole."""
NEAR_M = 1e-6
"""A camera does not see what is nearer than this, in metres."""


@dataclass(frozen=True, kw_only=True)
class HullConfig:
    """How the visual hull is carved.

    Examples:
        >>> from viewmend import HullConfig, StreamConfig
        >>> StreamConfig(hull=HullConfig(resolution=192)).hull.resolution
        192
    """

    resolution: int = 128
    """Voxels along the longest side of the box that is carved."""
    coarse_resolution: int = 24
    """Blocks along the longest side of the bounds, in each pass of the search for the subject's box."""
    coarse_passes: int = 3
    """Passes of that search; with 0, carving begins with the whole bounds."""
    pixels_per_voxel: float = 2.0
    """Masks are pooled until a voxel spans about this many pixels, then smoothed, to avoid staircase artefacts."""
    min_views: int = 2
    """Points seen by fewer cameras count as empty."""
    min_fraction: float = 0.5
    """Points seen by a smaller share of the cameras count as empty."""


@dataclass(frozen=True)
class OccupancyGrid:
    """Soft occupancy of cubic voxels: 1 inside, 0 outside, the surface where it is one half."""

    values: Float[Tensor, "x y z"]
    """values[i, j, k] is at low + (i + 0.5, j + 0.5, k + 0.5) * voxel_m."""
    low: Float[Tensor, "3"]
    voxel_m: float


@dataclass(frozen=True)
class Cubes:
    """Equal cubes, of voxels or blocks, that cover a box."""

    low: Float[Tensor, "3"]
    side_m: float
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, bounds: Bounds, resolution: int) -> "Cubes":
        """Cubes of which the box's longest side has `resolution`."""
        sides = bounds.size_m.tolist()
        side_m = max(sides) / resolution
        x, y, z = (max(1, math.ceil(side / side_m - 1e-3)) for side in sides)
        return cls(bounds.low, side_m, (x, y, z))

    @property
    def centers(self) -> Float[Tensor, "cube 3"]:
        """The cubes' middles, the last axis first."""
        axes = [
            self.low[a] + (torch.arange(self.shape[a], device=self.low.device) + 0.5) * self.side_m for a in range(3)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).view(-1, 3)


def visual_hull(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds, config: HullConfig
) -> OccupancyGrid:
    """Occupancy of `bounds`: the smallest (softened) mask value over the cameras that see a point.

    Points outside a camera's image or behind it are not constrained by it; space that too few cameras see is empty. The
    minimum, unlike RIFTCast's product, does not thin the subject as cameras are added.

    Raises:
        ValueError: there is one camera only.
    """
    check_views(cameras)
    voxels = Cubes.of(bounds, config.resolution)
    needed = needed_views(len(cameras), config)
    pool = max(1, int(_footprint_px(cameras, bounds, voxels.side_m) / config.pixels_per_voxel))
    if _has_kernels(mask):
        values = _carve_cpu(mask, pool, cameras, voxels, needed)
    else:
        values = carve(soften(mask, cameras.size_px, pool), pool, cameras, voxels, needed)
    return OccupancyGrid(values, bounds.low, voxels.side_m)


def occupied_bounds(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds, config: HullConfig
) -> Bounds | None:
    """The part of `bounds` that the hull can fill, None where it is empty; nothing of the hull is outside it."""
    needed = needed_views(len(cameras), config)
    tile = max(1, min(mask.shape[1:]) // TILES)
    if _has_kernels(mask):
        find = partial(_occupied_cpu, _count_tiles(mask.numpy(), mask.shape[1], mask.shape[2], tile), tile, cameras)
    else:
        find = partial(occupied_blocks, count_tiles(mask, tile), tile, cameras)
    for _ in range(config.coarse_passes):
        blocks = Cubes.of(bounds, config.coarse_resolution)
        index = find(blocks, needed).nonzero()
        if not len(index):
            return None
        low = bounds.low + index.amin(0) * blocks.side_m
        bounds = Bounds(low, torch.minimum(bounds.low + (index.amax(0) + 1) * blocks.side_m, bounds.high))
    return bounds


def needed_views(views: int, config: HullConfig) -> int:
    """How many of `views` cameras must see a point for it to count."""
    return max(min(config.min_views, views), math.ceil(config.min_fraction * views))


def _footprint_px(cameras: Cameras, bounds: Bounds, length_m: float) -> float:
    """The image size of `length_m` at the middle of the bounds, in the median camera that has it in front."""
    z = project(bounds.center[None], cameras)[1][:, 0]
    size = (cameras.K[:, 0, 0] * length_m / z)[z > length_m]
    return float(size.median()) if len(size) else 1.0


def _has_kernels(mask: Tensor) -> bool:
    return mask.device.type == "cpu"


def _kernel_arrays(cameras: Cameras, cubes: Cubes) -> tuple[np.ndarray, ...]:
    """What the kernels take: P = K [R t], the lenses, the images' sizes, and the corner of the cubes."""
    K = cameras.K.double()
    lens = torch.stack([K[:, 0, 0] ** 2 + K[:, 0, 1] ** 2, K[:, 0, 2], K[:, 1, 1] ** 2, K[:, 1, 2]], -1)
    P = K @ cameras.camera_from_world[:, :3].double()
    return P.numpy(), lens.numpy(), cameras.size_px.numpy(), cubes.low.double().numpy()


def _carve_cpu(
    mask: UInt8[Tensor, "view height width"], pool: int, cameras: Cameras, voxels: Cubes, needed: int
) -> Float[Tensor, "x y z"]:
    from viewmend.geometry import _hull_numba as kernels

    views, height, width = mask.shape
    rows, columns = -(-height // pool), -(-width // pool)
    P, lens, size, low = _kernel_arrays(cameras, voxels)
    masks = mask.numpy()
    soft = np.empty((views, rows + 1, columns + 1), np.uint8)
    parallel_for(lambda view: kernels.soften(masks[view], *size[view, ::-1], pool, soft[view]), views)
    sums = _count_tiles(soft, rows, columns, BLOCK)

    values = torch.empty(voxels.shape)
    out = values.numpy()
    given = (P, lens, size, soft, pool, BLOCK, sums, low, voxels.side_m, needed, BLOCK)
    parallel_for(lambda slab: kernels.carve_blocks(*given, slab * BLOCK, out), -(-voxels.shape[0] // BLOCK))
    return values


def _count_tiles(images: np.ndarray, height: int, width: int, tile: int) -> Int[np.ndarray, "view row column 2"]:
    """Summed-area tables of the first rows and columns of each image."""
    from viewmend.geometry._hull_numba import count_tiles

    sums = np.empty((len(images), -(-height // tile) + 1, -(-width // tile) + 1, 2), np.int32)
    parallel_for(lambda view: count_tiles(images[view], height, width, tile, sums[view]), len(images))
    return sums


def _occupied_cpu(
    sums: Int[np.ndarray, "view row column 2"], tile: int, cameras: Cameras, blocks: Cubes, needed: int
) -> Bool[Tensor, "x y z"]:
    from viewmend.geometry._hull_numba import occupied_blocks

    P, lens, size, low = _kernel_arrays(cameras, blocks)
    occupied = torch.empty(blocks.shape, dtype=torch.bool)
    out = occupied.numpy()
    given = (P, lens, size, tile, sums, low, blocks.side_m, needed)
    parallel_for(lambda slab: occupied_blocks(*given, slab, out), blocks.shape[0])
    return occupied


def check_views(cameras: Cameras) -> None:
    """Raise ValueError if there are too few cameras to carve a hull."""
    if len(cameras) < 2:
        raise ValueError(f"expected masks of at least two cameras, got {len(cameras)}; a hull needs several views")


def bounds_from_cameras(cameras: Cameras) -> Bounds:
    """A cube that holds what all cameras look at, for rigs of any size and shape.

    Its centre is the point nearest to all optical axes; it is as large as the median camera sees at that distance.

    Raises:
        ValueError: the cameras look away from each other.
    """
    focal = torch.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], -1)
    half_view = (cameras.size_px / 2 / focal).amin(-1)  # half of the narrower field of view, at distance 1
    return _cube_around(cameras, cameras.world_from_camera[:, :3, 2], half_view)


def bounds_from_masks(mask: UInt8[Tensor, "view height width"], cameras: Cameras) -> Bounds:
    """A cube that holds the masks' subject: centred where the rays through the masks' middles come closest.

    If fewer than two masks have any foreground, that of `bounds_from_cameras`.

    Raises:
        ValueError: there is one camera only, or the cameras look away from each other.
    """
    check_views(cameras)
    some = [v for v in range(len(cameras)) if bool(mask[v].any())]
    if len(some) < 2:
        return bounds_from_cameras(cameras)
    cameras = cameras[some]
    boxes = torch.stack([_mask_box(mask[v]) for v in some]).to(cameras.K)
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    pixels = torch.cat([middle, torch.ones_like(middle[:, :1])], -1)
    rays = torch.linalg.solve(cameras.K, pixels[..., None])
    directions = torch.nn.functional.normalize((cameras.world_from_camera[:, :3, :3] @ rays)[..., 0], dim=-1)
    focal = torch.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], -1)
    # The subject may be nearer to a camera than its middle and is round: take half as much again.
    half = 1.5 * ((boxes[:, 2:] - boxes[:, :2]) / 2 / focal).amax(-1)
    return _cube_around(cameras, directions, half, largest=True)


def _mask_box(mask: UInt8[Tensor, "height width"]) -> Float[Tensor, "4"]:
    columns = mask.any(0).nonzero()[:, 0]
    rows = mask.any(1).nonzero()[:, 0]
    return torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).float()


def _cube_around(
    cameras: Cameras, directions: Float[Tensor, "view 3"], half_at_1: Float[Tensor, "view"], largest: bool = False
) -> Bounds:
    """The cube about the point nearest to all rays; half its side is `half_at_1` times the distance from there."""
    centers = cameras.centers
    across = torch.eye(3, device=centers.device) - directions[:, :, None] * directions[:, None, :]
    # A little of every centre's pull keeps parallel rays solvable.
    pull = across + 1e-4 * torch.eye(3, device=centers.device)
    middle = torch.linalg.solve(pull.sum(0), (pull @ centers[..., None]).sum(0))[:, 0]
    distance = ((middle - centers) * directions).sum(-1)
    if not bool((distance > 0).any()):
        raise ValueError(
            "expected cameras that look at a common subject, got cameras whose axes meet behind them; check that R and "
            "t map world to camera (OpenCV axes), or give the capture bounds"
        )
    reach = (half_at_1 * distance)[distance > 0]
    half = reach.amax() if largest else reach.median()
    return Bounds(middle - half, middle + half)


def soften(
    mask: UInt8[Tensor, "view height width"], size_px: Int[Tensor, "view 2"], pool: int
) -> UInt8[Tensor, "view row column"]:
    """Average squares of pool x pool pixels and smooth the averages by (1 2 1)/4 along both axes, rounded to 8 bits.

    Beyond each image's own size its border continues.
    """
    views, height, width = mask.shape
    rows, columns = -(-height // pool), -(-width // pool)
    y = torch.arange(rows * pool, device=mask.device).clamp(max=height - 1)
    x = torch.arange(columns * pool, device=mask.device).clamp(max=width - 1)
    own_y, own_x = y.minimum(size_px[:, 1:] - 1), x.minimum(size_px[:, :1] - 1)
    view = torch.arange(views, device=mask.device)[:, None, None]
    full = mask[view, own_y[:, :, None], own_x[:, None, :]].float()
    sums = full.view(views, rows, pool, columns, pool).sum((2, 4))
    kernel = torch.tensor([1.0, 2.0, 1.0], device=mask.device)
    border = pad(sums[:, None], (1, 1, 1, 1), mode="replicate")
    smooth = conv2d(border, (kernel[:, None] * kernel)[None, None])[:, 0]
    return (smooth * (1.0 / (16 * pool * pool)) + 0.5).floor().to(torch.uint8)


def carve(
    soft: UInt8[Tensor, "view row column"], pool: int, cameras: Cameras, voxels: Cubes, needed: int
) -> Float[Tensor, "x y z"]:
    """The smallest mask value over the cameras that see each voxel's middle; 0 where fewer than `needed` do."""
    points = voxels.centers
    values = torch.ones_like(points[:, 0])
    seen = torch.zeros_like(values, dtype=torch.int32)
    for view in range(len(cameras)):
        uv, z = project(points, cameras[view])
        sees = in_view(uv, z, cameras[view])[0]
        value = sample_bilinear(soft[view].float()[None, None] / 255, uv / pool, "border")[0, :, 0]
        values = torch.where(sees, values.minimum(value), values)
        seen += sees
    return torch.where(seen >= needed, values, 0.0).view(voxels.shape)


def occupied_blocks(
    sums: Int[Tensor, "view row column"], tile: int, cameras: Cameras, blocks: Cubes, needed: int
) -> Bool[Tensor, "x y z"]:
    """Blocks that project to some foreground in all cameras and are visible to enough cameras."""
    centers, radius = blocks.centers, blocks.side_m * 3**0.5 / 2
    P = cameras.K @ cameras.camera_from_world[:, :3]
    empty = torch.zeros_like(centers[:, 0], dtype=torch.bool)
    seen = torch.zeros_like(centers[:, 0], dtype=torch.int32)
    for view in range(len(cameras)):
        uv, z = project(centers, cameras[view])
        uv, z, size = uv[0], z[0], cameras.size_px[view]
        # How far from its centre's image the image of the ball around a block can reach.
        slope = (P[view, None, :2, :3] - uv[:, :, None] * P[view, 2, :3]).norm(dim=-1)
        reach = slope * (radius / (z - radius).clamp(min=NEAR_M))[:, None]
        first, last = uv - reach, uv + reach
        in_front = z - radius > NEAR_M
        outside = ((last < 0) | (first >= size)).any(-1)
        inside = ((first >= 0) & (last < size)).all(-1)
        empty |= in_front & inside & (_foreground_tiles(sums[view], tile, first, last) == 0)
        seen += (z + radius > NEAR_M) & ~(in_front & outside)
    return (~empty & (seen >= needed)).view(blocks.shape)


def count_tiles(mask: UInt8[Tensor, "view height width"], tile: int) -> Int[Tensor, "view row column"]:
    """Summed-area tables: how many tiles have any foreground."""
    height, width = mask.shape[1:]
    padded = pad(mask, (0, -width % tile, 0, -height % tile))
    some = padded.unflatten(2, (-1, tile)).unflatten(1, (-1, tile)).amax((2, 4)) > 0
    return pad(some.int().cumsum(1).cumsum(2), (1, 0, 1, 0))


def _foreground_tiles(
    sums: Int[Tensor, "row column"], tile: int, first: Float[Tensor, "block 2"], last: Float[Tensor, "block 2"]
) -> Int[Tensor, "block"]:
    """How many tiles with any foreground each window of pixels, and one and a half pixels around it, touches."""
    end = torch.tensor([sums.shape[1], sums.shape[0]], device=sums.device) - 2
    largest = tile * max(sums.shape)  # beyond the image
    from_tile = ((first - 1.5).clamp(0, largest) / tile).long().minimum(end)
    to_tile = ((last + 1.5).clamp(0, largest) / tile).long().minimum(end) + 1
    (left, top), (right, bottom) = from_tile.unbind(-1), to_tile.unbind(-1)
    return sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
