"""The visual hull: soft occupancy on a grid, carved by the masks of all cameras."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import conv2d, normalize, pad

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.sampling import in_view, sample_bilinear
from viewmend.geometry.threads import parallel_for

FOREGROUND = 127
"""A mask's pixel is foreground if its value, from 0 to 255, is above this."""
CUT_OFF = 0.02
"""A mask is cut off if a larger share of one border of its image is foreground."""

TILES = 32
"""The search for the subject's box divides a mask's shorter side into this many tiles."""
BLOCK = 4
"""The kernels judge blocks of this many voxels, and tiles of this many pooled pixels, whole."""
PART_BLOCK = 2
"""The blocks by which a hull's parts are labelled have this many voxels along each side; parts less
than a block apart count as one."""
ISO = 0.5
"""A voxel is inside if its occupancy is at least this; the surface is where the occupancy equals it."""
FAINT = 0.1
"""A voxel is surely empty if its occupancy is not above this."""
MOST_POOLING = 2.0
"""A mask is pooled at most this many times as much as its own camera's resolution requires."""
NEAR_M = 1e-6
"""A camera does not see what is nearer than this, in metres."""
SAMPLES = 1 << 24
"""A device carves groups of cameras at once, with at most this many projected points, which bounds
the memory."""
Box = tuple[slice, slice, slice]
"""The first cell along x, y and z, and the one after the last."""


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
    """Masks are pooled until a voxel spans about this many pixels, in the median camera and at least
    half as many in every other, then smoothed, to avoid staircase artefacts."""
    min_views: int = 2
    """Points seen by fewer cameras count as empty."""
    min_fraction: float = 0.5
    """Points seen by a smaller share of the cameras count as empty. If fewer cameras show the subject
    whole, because image borders cut it off, a point must be seen by as many cameras as these."""
    least_fraction: float = 0.25
    """Image borders do not lower the required share of the cameras below this."""


@dataclass(frozen=True)
class GridSummary:
    """What code on the CPU needs to know of an occupancy grid."""

    blocks: Bool[Tensor, "x_block y_block z_block"]
    """Blocks of `PART_BLOCK` voxels with any inside."""
    faint_blocks: Bool[Tensor, "x_block y_block z_block"]
    """Blocks with any voxel above `FAINT`."""
    inside: Box | None
    """The box of the voxels above `ISO`."""
    filled: Box | None
    """The box of the voxels above `FAINT`."""


@dataclass(frozen=True)
class OccupancyGrid:
    """Soft occupancy of cubic voxels: 1 inside, 0 outside, the surface where it is one half."""

    values: Float[Tensor, "x y z"]
    """values[i, j, k] is at low + (i + 0.5, j + 0.5, k + 0.5) * voxel_m."""
    low: Float[Tensor, "3"]
    """The corner of the grid, metres; it stays on the CPU, wherever the values are."""
    voxel_m: float

    @cached_property
    def summary(self) -> GridSummary:
        """The summary of the values, on the CPU; a device is read once."""
        if _has_kernels(self.values):
            blocks, faint_blocks, inside, filled = _summarise_cpu(self.values)
        else:
            in_blocks = any_in_blocks(torch.stack([self.values >= ISO, self.values > FAINT]))
            lines = sum(self.values.shape)
            parts = [in_blocks.flatten(), _lines(self.values > ISO), _lines(self.values > FAINT)]
            flat, inside, filled = torch.cat(parts).cpu().split([in_blocks.numel(), lines, lines])
            blocks, faint_blocks = flat.view(in_blocks.shape)
        shape = self.values.shape
        return GridSummary(blocks, faint_blocks, _box_of_lines(inside, shape), _box_of_lines(filled, shape))

    @property
    def cubes(self) -> "Cubes":
        """The voxels without their values."""
        x, y, z = self.values.shape
        return Cubes(self.low, self.voxel_m, (x, y, z))


@dataclass(frozen=True)
class Cubes:
    """Equal cubes, of voxels or blocks, that cover a box. `low` is on the CPU."""

    low: Float[Tensor, "3"]
    side_m: float
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, bounds: Bounds, resolution: int) -> "Cubes":
        """Fill a box with cubes, `resolution` of them along its longest side."""
        sides = bounds.on_host.size_m.tolist()
        side_m = max(sides) / resolution
        x, y, z = (max(1, math.ceil(side / side_m - 1e-3)) for side in sides)
        return cls(bounds.on_host.low, side_m, (x, y, z))

    def centers(self, device: torch.device) -> Float[Tensor, "cube 3"]:
        """The cubes' centres on a device; the index along z changes fastest."""
        axes = [self.low[a] + (torch.arange(self.shape[a]) + 0.5) * self.side_m for a in range(3)]
        on_device = torch.cat(axes).to(device).split(self.shape)
        return torch.stack(torch.meshgrid(*on_device, indexing="ij"), -1).view(-1, 3)


def visual_hull(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds, config: HullConfig
) -> OccupancyGrid:
    """Occupancy of `bounds`: the smallest (softened) mask value over the cameras that see a point.

    Points outside a camera's image or behind it are not constrained by it; space that too few
    cameras see is empty. The minimum, unlike RIFTCast's product, does not thin the subject as
    cameras are added.

    Raises:
        ValueError: there is one camera only.
    """
    check_views(cameras)
    voxels = Cubes.of(bounds, config.resolution)
    needed = needed_views(len(cameras), config, count_cut_off(mask, cameras))
    pools = choose_pools(cameras, bounds, voxels.side_m, config.pixels_per_voxel)
    if _has_kernels(mask):
        values = _carve_cpu(mask, pools, cameras, voxels, needed)
    else:
        values = carve(soften(mask, cameras.size_px, pools), pools, cameras, voxels, needed)
    return OccupancyGrid(values, voxels.low, voxels.side_m)


def occupied_bounds(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds, config: HullConfig
) -> Bounds | None:
    """A box inside `bounds` that contains the whole hull; None if the hull is empty.

    The box stays on the CPU, where its numbers decide how many voxels there are.
    """
    needed = needed_views(len(cameras), config, count_cut_off(mask, cameras))
    tile = max(1, min(mask.shape[1:]) // TILES)
    if _has_kernels(mask):
        if not bool(mask.any()):
            return None
        sizes = [(mask.shape[1], mask.shape[2])] * len(mask)
        find = partial(_occupied_cpu, _count_tiles(mask.numpy(), sizes, tile), tile, cameras)
    else:
        find = partial(occupied_blocks, count_tiles(mask, tile), tile, cameras)
    box = bounds.on_host
    for _ in range(config.coarse_passes):
        blocks = Cubes.of(box, config.coarse_resolution)
        sides = filled_sides(find(blocks, needed))
        if sides is None:
            return None
        first = torch.tensor([side.start for side in sides])
        end = torch.tensor([side.stop for side in sides])
        low = box.low + first * blocks.side_m
        box = Bounds(low, torch.minimum(box.low + end * blocks.side_m, box.high))
    return box


def filled_sides(grid: Bool[Tensor, "x y z"]) -> Box | None:
    """The box of a grid's true cells, None where there are none; reads a device once."""
    return _box_of_lines(_lines(grid).cpu(), grid.shape)


def _lines(grid: Bool[Tensor, "x y z"]) -> Bool[Tensor, "line"]:
    """Whether any cell is true in each plane across x, then across y, then across z."""
    over_x = grid.any(0)
    return torch.cat([grid.flatten(1).any(1), over_x.any(1), over_x.any(0)])


def _box_of_lines(lines: Bool[Tensor, "line"], shape: Sequence[int]) -> Box | None:
    """The box of the planes that are true, in the order of `_lines`; None where there are none."""
    x, y, z = (line.nonzero()[:, 0].tolist() for line in lines.split(tuple(shape)))
    if not x:
        return None
    return slice(x[0], x[-1] + 1), slice(y[0], y[-1] + 1), slice(z[0], z[-1] + 1)


def any_in_blocks(voxels: Bool[Tensor, "*grid x y z"]) -> Bool[Tensor, "*grid x_block y_block z_block"]:
    """Whether any voxel of each block of `PART_BLOCK` along each side is true."""
    padded = pad(voxels, [end for side in reversed(voxels.shape[-3:]) for end in (0, -side % PART_BLOCK)])
    for axis in (-3, -2, -1):
        padded = padded.unflatten(axis, (-1, PART_BLOCK)).any(axis)
    return padded


def _summarise_cpu(
    values: Float[Tensor, "x y z"],
) -> tuple[
    Bool[Tensor, "x_block y_block z_block"],
    Bool[Tensor, "x_block y_block z_block"],
    Bool[Tensor, "line"],
    Bool[Tensor, "line"],
]:
    """The blocks with any voxel inside, with any above `FAINT`, and the planes with any above `ISO`, `FAINT`.

    Planes are in the order of `_lines`.
    """
    from viewmend.geometry._hull_numba import summarise

    blocks = torch.zeros([-(-side // PART_BLOCK) for side in values.shape], dtype=torch.bool)
    faint_blocks = torch.zeros_like(blocks)
    inside = torch.zeros(sum(values.shape), dtype=torch.bool)
    filled = torch.zeros_like(inside)
    limits = (np.float32(FAINT), np.float32(ISO))  # torch, too, compares in single precision
    grid = values.detach().contiguous().numpy()
    found = (blocks.numpy(), faint_blocks.numpy(), inside.numpy(), filled.numpy())
    summarise(grid, *limits, PART_BLOCK, *found)
    return blocks, faint_blocks, inside, filled


def needed_views(views: int, config: HullConfig, cut_off: int = 0) -> int:
    """How many of `views` cameras must see a point for it to count; `cut_off` of them see the subject in part."""
    usual = math.ceil(config.min_fraction * views)
    whole = views - cut_off
    if whole >= 2:
        least = math.ceil(config.least_fraction * views)
        usual = min(usual, max(whole, least))
    return max(min(config.min_views, views), usual)


def count_cut_off(mask: UInt8[Tensor, "view height width"], cameras: Cameras) -> int:
    """The number of images in which the subject is cut off at the border; reads a device once."""
    return int(are_cut_off(mask, cameras).sum())


def are_cut_off(mask: UInt8[Tensor, "view height width"], cameras: Cameras) -> Bool[Tensor, "view"]:
    """Whether each mask has foreground along more than `CUT_OFF` of one border of its image, without padding."""
    width, height = cameras.size_px.to(mask.device).unbind(-1)
    view = torch.arange(len(mask), device=mask.device)
    inside = mask > FOREGROUND
    rows = torch.stack([inside[:, 0], inside[view, height - 1]], 1).sum(-1)
    columns = torch.stack([inside[:, :, 0], inside[view, :, width - 1]], 1).sum(-1)
    return ((rows > CUT_OFF * width[:, None]) | (columns > CUT_OFF * height[:, None])).any(-1)


def choose_pools(
    cameras: Cameras, bounds: Bounds, voxel_m: float, pixels_per_voxel: float
) -> tuple[int, ...]:
    """How many pixels, along each side, of each camera's mask become one.

    As many for all as suit the median camera that has the middle of the bounds in front; fewer for a camera
    of much lower resolution there, whose mask would lose its thin parts (`MOST_POOLING`).
    """
    rig = cameras.on_host
    z = project(bounds.on_host.center[None], rig)[1][:, 0]
    suited = (rig.K[:, 0, 0] * voxel_m / z / pixels_per_voxel).where(z > voxel_m, torch.nan)
    median = float(suited.nanmedian())
    usual = max(1, int(1 / pixels_per_voxel if math.isnan(median) else median))
    return tuple(
        usual if math.isnan(own) else max(1, min(usual, int(MOST_POOLING * own))) for own in suited.tolist()
    )


def _has_kernels(data: Tensor) -> bool:
    return data.device.type == "cpu"


def kernel_arrays(cameras: Cameras, cubes: Cubes) -> tuple[np.ndarray, ...]:
    """What the kernels take: P = K [R t], the lenses, the images' sizes, and the corner of the cubes."""
    K = cameras.K.double()
    lens = torch.stack([K[:, 0, 0] ** 2 + K[:, 0, 1] ** 2, K[:, 0, 2], K[:, 1, 1] ** 2, K[:, 1, 2]], -1)
    P = K @ cameras.camera_from_world[:, :3].double()
    return P.numpy(), lens.numpy(), cameras.size_px.numpy(), cubes.low.double().numpy()


def _carve_cpu(
    mask: UInt8[Tensor, "view height width"],
    pools: Sequence[int],
    cameras: Cameras,
    voxels: Cubes,
    needed: int,
) -> Float[Tensor, "x y z"]:
    from viewmend.geometry import _hull_numba as kernels

    views, height, width = mask.shape
    pooled = [(-(-height // pool), -(-width // pool)) for pool in pools]
    rows, columns = max(pooled)
    P, lens, size, low = kernel_arrays(cameras, voxels)
    masks = mask.numpy()
    soft = np.empty((views, rows + 1, columns + 1), np.uint8)
    parallel_for(lambda view: kernels.soften(masks[view], *size[view, ::-1], pools[view], soft[view]), views)
    sums = _count_tiles(soft, pooled, BLOCK)

    values = torch.empty(voxels.shape)
    out = values.numpy()
    given = (P, lens, size, soft, np.array(pools), BLOCK, sums, low, voxels.side_m, needed, BLOCK)
    parallel_for(lambda slab: kernels.carve_blocks(*given, slab * BLOCK, out), -(-voxels.shape[0] // BLOCK))
    return values


def _count_tiles(
    images: np.ndarray, sizes: Sequence[tuple[int, int]], tile: int
) -> Int[np.ndarray, "view row column 2"]:
    """Summed-area tables of the first rows and columns of each image, as many as `sizes` says."""
    from viewmend.geometry._hull_numba import count_tiles

    height, width = max(sizes)
    sums = np.empty((len(images), -(-height // tile) + 1, -(-width // tile) + 1, 2), np.int32)
    parallel_for(lambda view: count_tiles(images[view], *sizes[view], tile, sums[view]), len(images))
    return sums


def _occupied_cpu(
    sums: Int[np.ndarray, "view row column 2"], tile: int, cameras: Cameras, blocks: Cubes, needed: int
) -> Bool[Tensor, "x y z"]:
    from viewmend.geometry._hull_numba import occupied_blocks

    P, lens, size, low = kernel_arrays(cameras, blocks)
    occupied = torch.empty(blocks.shape, dtype=torch.bool)
    out = occupied.numpy()
    given = (P, lens, size, tile, sums, low, blocks.side_m, needed)
    parallel_for(lambda slab: occupied_blocks(*given, slab, out), blocks.shape[0])
    return occupied


def check_views(cameras: Cameras) -> None:
    """Raise ValueError if there are too few cameras to carve a hull."""
    if len(cameras) < 2:
        raise ValueError(
            f"expected masks of at least two cameras, got {len(cameras)}; a hull needs several views"
        )


def bounds_from_cameras(cameras: Cameras) -> Bounds:
    """A cube that holds what all cameras look at, for rigs of any size and shape.

    Its centre is the point nearest to all optical axes; it is as large as the median camera sees at
    that distance.

    Raises:
        ValueError: the cameras look away from each other.
    """
    focal = torch.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], -1)
    half_view = (cameras.size_px / 2 / focal).amin(-1)  # half of the narrower field of view, at distance 1
    return _cube_around(cameras, cameras.world_from_camera[:, :3, 2], half_view)


def bounds_from_masks(mask: UInt8[Tensor, "view height width"], cameras: Cameras) -> Bounds:
    """A cube that holds the masks' subject: centred where the rays through the masks' middles come closest.

    The cube of `bounds_from_cameras` if the rays meet behind all cameras, as with masks of different things.
    If fewer than two masks have foreground, there is no hull to find: then it is that cube or, where there
    is none, one in front of the cameras.

    Raises:
        ValueError: there is one camera only; or two masks have foreground, and the cameras look away from
            each other.
    """
    check_views(cameras)
    rig = cameras.on_host
    boxes = _mask_boxes(mask)
    some = [view for view in range(len(rig)) if boxes[view] is not None]
    if len(some) < 2:
        return _bounds_without_subject(rig)
    seeing = rig[some]
    box = torch.tensor([boxes[view] for view in some]).to(rig.K)
    middle = (box[:, :2] + box[:, 2:]) / 2
    pixels = torch.cat([middle, torch.ones_like(middle[:, :1])], -1)
    rays = torch.linalg.solve(seeing.K, pixels[..., None])
    directions = normalize((seeing.world_from_camera[:, :3, :3] @ rays)[..., 0], dim=-1)
    focal = torch.stack([seeing.K[:, 0, 0], seeing.K[:, 1, 1]], -1)
    # The subject may be nearer to a camera than its middle and is round: take half as much again.
    half = 1.5 * ((box[:, 2:] - box[:, :2]) / 2 / focal).amax(-1)
    try:
        return _cube_around(seeing, directions, half, largest=True)
    except ValueError:
        return bounds_from_cameras(rig)


def _bounds_without_subject(cameras: Cameras) -> Bounds:
    """The cube of `bounds_from_cameras`; one in front of the rig, twice its extent, if axes are parallel or diverge."""
    try:
        return bounds_from_cameras(cameras)
    except ValueError:
        centers = cameras.centers
        extent_m = (centers.amax(0) - centers.amin(0)).amax().clamp_min(NEAR_M)
        ahead = normalize(cameras.world_from_camera[:, :3, 2].mean(0), dim=0)
        middle = centers.mean(0) + 2 * extent_m * ahead
        return Bounds(middle - extent_m, middle + extent_m)


def _mask_boxes(mask: UInt8[Tensor, "view height width"]) -> list[tuple[int, int, int, int] | None]:
    """First column and row of each mask's foreground, and the column and row after the last; None without any."""
    lines = torch.cat([mask.any(1), mask.any(2)], 1).cpu()
    boxes = []
    for view in range(len(mask)):
        columns = lines[view, : mask.shape[2]].nonzero()[:, 0].tolist()
        rows = lines[view, mask.shape[2] :].nonzero()[:, 0].tolist()
        boxes.append((columns[0], rows[0], columns[-1] + 1, rows[-1] + 1) if columns else None)
    return boxes


def _cube_around(
    cameras: Cameras,
    directions: Float[Tensor, "view 3"],
    half_at_1: Float[Tensor, "view"],
    largest: bool = False,
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
    mask: UInt8[Tensor, "view height width"], size_px: Int[Tensor, "view 2"], pools: Sequence[int]
) -> UInt8[Tensor, "view row column"]:
    """Average squares of pool x pool pixels and smooth the averages by (1 2 1)/4 along both axes, rounded to 8 bits.

    Beyond each image's own size its border continues.

    Args:
        mask: the masks.
        size_px: width and height of each mask without its padding.
        pools: the pool of each mask.
    """
    if len(set(pools)) == 1:
        return _soften_alike(mask, size_px, pools[0])
    views, height, width = mask.shape
    row = torch.arange(-(-height // min(pools)), device=mask.device)
    column = torch.arange(-(-width // min(pools)), device=mask.device)
    soft = mask.new_empty(views, len(row), len(column))
    for pool in set(pools):
        some = [view for view in range(views) if pools[view] == pool]
        own = _soften_alike(mask[some], size_px[some], pool)
        rows, columns = own.shape[1:]
        soft[some] = own[:, row.clamp(max=rows - 1)][:, :, column.clamp(max=columns - 1)]
    return soft


def _soften_alike(
    mask: UInt8[Tensor, "view height width"], size_px: Int[Tensor, "view 2"], pool: int
) -> UInt8[Tensor, "view row column"]:
    """Masks that are all pooled alike, pooled and smoothed."""
    views, height, width = mask.shape
    rows = -(-height // pool)
    columns = -(-width // pool)
    y = torch.arange(rows * pool, device=mask.device).clamp(max=height - 1)
    x = torch.arange(columns * pool, device=mask.device).clamp(max=width - 1)
    own_y = y.minimum(size_px[:, 1:] - 1)
    own_x = x.minimum(size_px[:, :1] - 1)
    view = torch.arange(views, device=mask.device)[:, None, None]
    full = mask[view, own_y[:, :, None], own_x[:, None, :]].float()
    sums = full.view(views, rows, pool, columns, pool).sum((2, 4))
    kernel = torch.tensor([1.0, 2.0, 1.0], device=mask.device)
    border = pad(sums[:, None], (1, 1, 1, 1), mode="replicate")
    smooth = conv2d(border, (kernel[:, None] * kernel)[None, None])[:, 0]
    return (smooth * (1.0 / (16 * pool * pool)) + 0.5).floor().to(torch.uint8)


def carve(
    soft: UInt8[Tensor, "view row column"],
    pools: Sequence[int],
    cameras: Cameras,
    voxels: Cubes,
    needed: int,
) -> Float[Tensor, "x y z"]:
    """The smallest mask value over the cameras that see each voxel's middle; 0 where fewer than `needed` do."""
    points = voxels.centers(soft.device)
    values = torch.ones_like(points[:, 0])
    seen = torch.zeros_like(values, dtype=torch.int32)
    step = max(1, SAMPLES // len(points))
    alike = len(set(pools)) == 1
    scale = None if alike else torch.tensor(pools, device=soft.device)[:, None, None]
    for first in range(0, len(cameras), step):
        some = cameras[first : first + step]
        uv, z = project(points, some)
        sees = in_view(uv, z, some)
        images = soft[first : first + step, None].float() / 255
        pool = pools[0] if scale is None else scale[first : first + step]
        value = sample_bilinear(images, uv / pool, "border")[..., 0]
        values = values.minimum(torch.where(sees, value, 1.0).amin(0))
        seen += sees.sum(0, dtype=torch.int32)
    return torch.where(seen >= needed, values, 0.0).view(voxels.shape)


def occupied_blocks(
    sums: Int[Tensor, "view row column"], tile: int, cameras: Cameras, blocks: Cubes, needed: int
) -> Bool[Tensor, "x y z"]:
    """Blocks that project to some foreground in all cameras and are visible to enough cameras."""
    radius = blocks.side_m * 3**0.5 / 2
    P = cameras.K @ cameras.camera_from_world[:, :3]
    uv, z = project(blocks.centers(sums.device), cameras)
    # How far from its centre's image the image of the ball around a block can reach.
    slope = (P[:, None, :2, :3] - uv[..., None] * P[:, None, 2:, :3]).norm(dim=-1)
    reach = slope * (radius / (z - radius).clamp(min=NEAR_M))[..., None]
    first = uv - reach
    last = uv + reach

    size = cameras.size_px[:, None]
    in_front = z - radius > NEAR_M
    outside = ((last < 0) | (first >= size)).any(-1)
    inside = ((first >= 0) & (last < size)).all(-1)
    empty = in_front & inside & (_foreground_tiles(sums, tile, first, last) == 0)
    seen = (z + radius > NEAR_M) & ~(in_front & outside)
    # Without any foreground, blocks that no image shows whole are empty, too
    some = sums[:, -1, -1].any()
    return (~empty.any(0) & (seen.sum(0) >= needed) & some).view(blocks.shape)


def count_tiles(mask: UInt8[Tensor, "view height width"], tile: int) -> Int[Tensor, "view row column"]:
    """Summed-area tables: how many tiles have any foreground."""
    height, width = mask.shape[1:]
    padded = pad(mask, (0, -width % tile, 0, -height % tile))
    some = padded.unflatten(2, (-1, tile)).unflatten(1, (-1, tile)).amax((2, 4)) > 0
    return pad(some.int().cumsum(1).cumsum(2), (1, 0, 1, 0))


def _foreground_tiles(
    sums: Int[Tensor, "view row column"],
    tile: int,
    first: Float[Tensor, "view block 2"],
    last: Float[Tensor, "view block 2"],
) -> Int[Tensor, "view block"]:
    """How many tiles with any foreground each window of pixels, and one and a half pixels around it, touches."""
    rows, columns = sums.shape[1:]
    largest = tile * max(rows, columns)  # beyond the image
    from_tile = ((first - 1.5).clamp(0, largest) / tile).long()
    to_tile = ((last + 1.5).clamp(0, largest) / tile).long()
    left = from_tile[..., 0].clamp(max=columns - 2)
    top = from_tile[..., 1].clamp(max=rows - 2)
    right = to_tile[..., 0].clamp(max=columns - 2) + 1
    bottom = to_tile[..., 1].clamp(max=rows - 2) + 1
    view = torch.arange(len(sums), device=sums.device)[:, None]
    return (
        sums[view, bottom, right] - sums[view, top, right] - sums[view, bottom, left] + sums[view, top, left]
    )
