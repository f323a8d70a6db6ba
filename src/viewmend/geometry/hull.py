"""The visual hull: soft occupancy on a grid, carved by the masks of all cameras."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.threads import parallel_for
from viewmend.utils.tensors import OnDevice

FOREGROUND = 127
"""Threshold for binary foreground."""

TILES = 32
"""Tiles across a mask's shorter side, by which the search for the subject's box judges blocks of space."""

BLOCK = 4
"""Side in voxels of the blocks, and in (pooled) pixels of the mask tiles, that are judged whole."""


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
    """Passes of that search; 0 carves the bounds as they are."""
    pixels_per_voxel: float = 2.0
    """Masks are pooled until a voxel spans about this many pixels, then smoothed, to avoid staircase artefacts."""
    min_views: int = 2
    """Space that fewer cameras see is empty."""
    min_fraction: float = 0.5
    """Space that a smaller share of the cameras sees is empty."""


@dataclass(frozen=True)
class OccupancyGrid(OnDevice):
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


def visual_hull(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds, config: HullConfig
) -> OccupancyGrid:
    """Occupancy of `bounds`: the smallest (softened) mask value over the cameras that see a point.

    Points outside a camera's image or behind it are not constrained by it; space that too few cameras see is empty. The
    minimum, unlike RIFTCast's product, does not thin the subject as cameras are added.

    Raises:
        ValueError: there is one camera only, or no mask has any foreground.
    """
    check_masks(mask, cameras)
    device, mask, cameras, bounds = mask.device, mask.cpu(), cameras.to("cpu"), bounds.to("cpu")
    voxels, needed = Cubes.of(bounds, config.resolution), needed_views(len(cameras), config)
    pool = max(1, int(_footprint_px(cameras, bounds, voxels.side_m) / config.pixels_per_voxel))
    return OccupancyGrid(_carve(mask, pool, cameras, voxels, needed), bounds.low, voxels.side_m).to(device)


def occupied_bounds(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds, config: HullConfig
) -> Bounds | None:
    """The part of `bounds` that the hull can fill, None where it is empty; nothing of the hull is outside it."""
    device, mask, cameras, bounds = mask.device, mask.cpu(), cameras.to("cpu"), bounds.to("cpu")
    needed = needed_views(len(cameras), config)
    tile = max(1, min(mask.shape[1:]) // TILES)
    tiles = _count_tiles(mask, tile)
    for _ in range(config.coarse_passes):
        blocks = Cubes.of(bounds, config.coarse_resolution)
        index = _occupied(tiles, tile, cameras, blocks, needed).nonzero()
        if not len(index):
            return None
        low = bounds.low + index.amin(0) * blocks.side_m
        bounds = Bounds(low, torch.minimum(bounds.low + (index.amax(0) + 1) * blocks.side_m, bounds.high))
    return bounds.to(device)


def needed_views(views: int, config: HullConfig) -> int:
    """How many of `views` cameras must see a point for it to count."""
    return max(min(config.min_views, views), math.ceil(config.min_fraction * views))


def _footprint_px(cameras: Cameras, bounds: Bounds, length_m: float) -> float:
    """The image size of `length_m` at the middle of the bounds, in the median camera that has it in front."""
    z = project(bounds.center[None], cameras)[1][:, 0]
    size = (cameras.K[:, 0, 0] * length_m / z)[z > length_m]
    return float(size.median()) if len(size) else 1.0


def _kernel_arrays(cameras: Cameras, cubes: Cubes) -> tuple[np.ndarray, ...]:
    """What the kernels take: P = K [R t], the lenses, the images' sizes, and the corner of the cubes."""
    K = cameras.K.double()
    lens = torch.stack([K[:, 0, 0] ** 2 + K[:, 0, 1] ** 2, K[:, 0, 2], K[:, 1, 1] ** 2, K[:, 1, 2]], -1)
    P = K @ cameras.camera_from_world[:, :3].double()
    return P.numpy(), lens.numpy(), cameras.size_px.numpy(), cubes.low.double().numpy()


def _tile_sums(views: int, height: int, width: int, tile: int) -> Int[Tensor, "view row column 2"]:
    return torch.empty(views, -(-height // tile) + 1, -(-width // tile) + 1, 2, dtype=torch.int32)


def _carve(
    mask: UInt8[Tensor, "view height width"], pool: int, cameras: Cameras, voxels: Cubes, needed: int
) -> Float[Tensor, "x y z"]:
    """The smallest mask value over the cameras that see each voxel's middle; 0 where fewer than `needed` do."""
    from viewmend.geometry import _hull_numba as kernels

    views, height, width = mask.shape
    soft_rows, soft_columns = -(-height // pool), -(-width // pool)
    soft = torch.empty(views, soft_rows + 1, soft_columns + 1, dtype=torch.uint8)
    sums = _tile_sums(views, soft_rows, soft_columns, BLOCK).numpy()
    values = torch.empty(voxels.shape)
    masks, images, out = mask.numpy(), soft.numpy(), values.numpy()
    P, lens, size, low = _kernel_arrays(cameras, voxels)

    def prepare(view: int) -> None:
        columns, rows = size[view]
        kernels.soften(masks[view], rows, columns, pool, images[view])
        kernels.count_tiles(images[view], soft_rows, soft_columns, BLOCK, sums[view])

    def carve(slab: int) -> None:
        kernels.carve_blocks(
            P, lens, size, images, pool, BLOCK, sums, low, voxels.side_m, needed, BLOCK, slab * BLOCK, out
        )

    parallel_for(prepare, views)
    parallel_for(carve, -(-voxels.shape[0] // BLOCK))
    return values


def _count_tiles(mask: UInt8[Tensor, "view height width"], tile: int) -> Int[Tensor, "view row column 2"]:
    from viewmend.geometry import _hull_numba as kernels

    views, height, width = mask.shape
    sums = _tile_sums(views, height, width, tile)
    masks, out = mask.numpy(), sums.numpy()
    parallel_for(lambda view: kernels.count_tiles(masks[view], height, width, tile, out[view]), views)
    return sums


def _occupied(
    tiles: Int[Tensor, "view row column 2"], tile: int, cameras: Cameras, blocks: Cubes, needed: int
) -> Bool[Tensor, "x y z"]:
    """Blocks that project to some foreground in all cameras and are visible to enough cameras."""
    from viewmend.geometry import _hull_numba as kernels

    occupied = torch.empty(blocks.shape, dtype=torch.bool)
    sums, out = tiles.numpy(), occupied.numpy()
    P, lens, size, low = _kernel_arrays(cameras, blocks)

    def judge(slab: int) -> None:
        kernels.occupied_blocks(P, lens, size, tile, sums, low, blocks.side_m, needed, slab, slab + 1, out)

    parallel_for(judge, blocks.shape[0])
    return occupied


def check_masks(mask: UInt8[Tensor, "view height width"], cameras: Cameras) -> None:
    """Raise ValueError if no hull can be carved from these masks."""
    if len(cameras) < 2:
        raise ValueError(f"expected masks of at least two cameras, got {len(cameras)}; a hull needs several views")
    if not bool(mask.any()):
        raise ValueError(
            f"expected foreground in the masks, got none in any of {len(cameras)} cameras; check the masks' "
            "files and that 255 means foreground"
        )


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

    Raises:
        ValueError: there is one camera only, no mask has any foreground, or the cameras look away from each other.
    """
    check_masks(mask, cameras)
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
    columns, rows = mask.any(0).nonzero()[:, 0], mask.any(1).nonzero()[:, 0]
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
