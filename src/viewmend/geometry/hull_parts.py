"""Floating parts of a hull that no mask needs: where rays through different things cross by chance."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool3d, pad

from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.hull import OccupancyGrid
from viewmend.geometry.sampling import in_view

BLOCK = 2
"""Side in voxels of the blocks that are labelled: parts less than a block apart count as one."""
CELL = 1.25
"""Side of the cells in which images are compared, relative to the nearest voxel's image: no cell inside is missed."""


def without_floating_parts(grid: OccupancyGrid, cameras: Cameras) -> OccupancyGrid:
    """The hull without the parts whose image other parts cover in every camera, the smallest first.

    What a camera sees on its own, such as a second person or a ball in the air, stays.
    """
    occupied = _any_in_blocks(grid.values >= 0.5)
    labels, count = _labels(occupied)
    if count < 2:
        return grid
    part = torch.from_numpy(labels).to(occupied.device)
    index = _surface(grid.values >= 0.5).nonzero()
    points = grid.low + (index + 0.5) * grid.voxel_m
    dropped = _unneeded(part[tuple((index // BLOCK).T)], points, cameras, grid.voxel_m)
    if not len(dropped):
        return grid
    blocks = torch.isin(part, dropped)
    # Around a part, soft values fade out.
    faint = max_pool3d(blocks[None, None].float(), 3, 1, 1)[0, 0] > 0
    kept = occupied & ~blocks
    x, y, z = grid.values.shape
    remove = _to_voxels(blocks)[:x, :y, :z] | (_to_voxels(faint & ~kept)[:x, :y, :z] & (grid.values < 0.5))
    return replace(grid, values=grid.values.masked_fill(remove, 0.0))


def _any_in_blocks(voxels: Bool[Tensor, "x y z"]) -> Bool[Tensor, "x_block y_block z_block"]:
    sides = [end for side in reversed(voxels.shape) for end in (0, -side % BLOCK)]
    return max_pool3d(pad(voxels, sides)[None, None].float(), BLOCK)[0, 0] > 0


def _surface(inside: Bool[Tensor, "x y z"]) -> Bool[Tensor, "x y z"]:
    """The voxels with a neighbour that is outside."""
    outside = pad(~inside, [1] * 6, value=True)[None, None].float()
    return inside & (max_pool3d(outside, 3, 1)[0, 0] > 0)


def _to_voxels(blocks: Bool[Tensor, "x_block y_block z_block"]) -> Bool[Tensor, "x y z"]:
    for axis in range(3):
        blocks = blocks.repeat_interleave(BLOCK, axis)
    return blocks


def _labels(occupied: Bool[Tensor, "x y z"]) -> tuple[Int[np.ndarray, "x y z"], int]:
    """The number of each block's part, from 1, and how many there are; blocks that share a corner are connected."""
    from scipy.ndimage import label

    labels, count = label(occupied.cpu().numpy(), np.ones((3, 3, 3)))  # pyright: ignore[reportGeneralTypeIssues]
    return labels, count


def _unneeded(
    part: Int[Tensor, "voxel"], points: Float[Tensor, "voxel 3"], cameras: Cameras, voxel_m: float
) -> Int[Tensor, "dropped"]:
    """The parts that can go, one after another, while every cell of every image stays covered, or next to one that is.

    A part that nothing demands has edges where others have theirs, as the same masks have carved both.
    """
    sizes = torch.bincount(part)
    uv, z = project(points, cameras)
    sees = in_view(uv, z, cameras)
    cells = []  # of each camera: cells and parts there, once each; cells and parts there or next to it; parts of a cell
    around = torch.tensor([-1, 0, 1], device=part.device)
    for view in range(len(cameras)):
        if bool(sees[view].any()):
            own = sees[view]
            cell_px = CELL * cameras.K[view, 0, 0] * voxel_m / z[view, own].min()
            x, y = (uv[view, own] / cell_px).long().unbind(-1)
            row = int(x.max()) + 3
            pairs = (((y + 1) * row + x + 1) * len(sizes) + part[own]).unique()
            place, parts = pairs // len(sizes), pairs % len(sizes)
            near = place[:, None, None] + around[:, None] * row + around
            near = (near.flatten() * len(sizes) + parts.repeat_interleave(9)).unique()
            near, near_parts = near // len(sizes), near % len(sizes)
            cells.append((place, parts, near, near_parts, torch.bincount(near)))
    dropped = []
    for candidate in sizes.argsort()[(sizes == 0).sum() :].tolist():
        if all(bool((count[place[parts == candidate]] > 1).all()) for place, parts, _, _, count in cells):
            dropped.append(candidate)
            for _, _, near, near_parts, count in cells:
                count[near[near_parts == candidate]] -= 1
    return torch.tensor(dropped, dtype=part.dtype, device=part.device)
