"""Floating parts of a hull that no mask needs: where rays through different things cross by chance."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.hull import ISO, PART_BLOCK, Box, OccupancyGrid, filled_sides
from viewmend.geometry.sampling import in_view

CELL = 1.25
"""Images are compared in square cells, whose side is this many times the nearest voxel's image, so
that no cell inside a part is missed."""
COVERED = 0.75
"""A part is not needed if the others cover this fraction of its image in every camera. Masks of
real cameras disagree by strips at the outline, which a part can cover by chance."""
SPECK = 4
"""A part is not needed either if it covers at most this many cells of each image on its own, such
as a speck next to a hand. The largest part stays unless the others cover it."""
SHELL_BLOCKS = 2
"""Faint voxels within this many blocks of the voxels inside belong to them, without a search."""
MANY = 2000
"""Distinct numbers are found by marking them if there are at least this many, else by sorting."""


def without_floating_parts(grid: OccupancyGrid, cameras: Cameras) -> OccupancyGrid:
    """The hull without specks and without parts whose image others mostly cover in every camera, the smallest first.

    What a camera sees on its own, such as a second person or a ball in the air, stays unless it is
    a few voxels small.
    """
    from scipy.ndimage import label

    # The number of each block's part, from 1; blocks that share a corner are connected.
    occupied = grid.summary.blocks
    labels, count = label(occupied.numpy(), np.ones((3, 3, 3)))
    if count < 2:
        return grid

    # which parts no camera needs: a search over few cells, on the CPU
    index = _surface(grid.values >= ISO).cpu().nonzero()
    points = grid.low + (index + 0.5) * grid.voxel_m
    dropped = _unneeded(labels[tuple((index // PART_BLOCK).T.numpy())], points, cameras.on_host, grid.voxel_m)
    if not dropped:
        return grid

    # empty their blocks, and the space around them where soft values fade out
    blocks = torch.from_numpy(np.isin(labels, dropped))
    around = _grown(blocks) & ~(occupied & ~blocks)
    x, y, z = grid.values.shape
    device = grid.values.device
    outside = grid.values < ISO
    remove = _to_voxels(blocks.to(device))[:x, :y, :z] | (_to_voxels(around.to(device))[:x, :y, :z] & outside)
    return replace(grid, values=grid.values.masked_fill(remove, 0.0))


def filled_box(grid: OccupancyGrid) -> Box | None:
    """The box of all voxels that are not surely empty and connected with one inside; None for an empty grid.

    Faint voxels elsewhere are what is left around floating parts, or rays that nearly cross. If no
    voxel is inside, all that are not surely empty count.
    """
    from scipy.ndimage import label

    filled = grid.summary.filled
    inside = grid.summary.inside
    if filled is None or inside is None:
        return filled
    shell = SHELL_BLOCKS * PART_BLOCK
    beyond = [
        max(own.start - side.start, side.stop - own.stop) for side, own in zip(filled, inside, strict=True)
    ]
    if max(beyond) <= shell:
        return filled
    labels, _ = label(grid.summary.faint_blocks.numpy(), np.ones((3, 3, 3)))
    connected = np.unique(labels[grid.summary.blocks.numpy()])
    of_blocks = filled_sides(torch.from_numpy(np.isin(labels, connected)))
    assert of_blocks is not None, "there are voxels inside"
    x, y, z = (
        slice(max(side.start, PART_BLOCK * blocks.start), min(side.stop, PART_BLOCK * blocks.stop))
        for side, blocks in zip(filled, of_blocks, strict=True)
    )
    return x, y, z


def _grown(blocks: Bool[Tensor, "x y z"]) -> Bool[Tensor, "x y z"]:
    """The blocks and all that share a corner with them."""
    for axis, side in enumerate(blocks.shape):
        grown = blocks.clone()
        grown.narrow(axis, 1, side - 1).logical_or_(blocks.narrow(axis, 0, side - 1))
        grown.narrow(axis, 0, side - 1).logical_or_(blocks.narrow(axis, 1, side - 1))
        blocks = grown
    return blocks


def _surface(inside: Bool[Tensor, "x y z"]) -> Bool[Tensor, "x y z"]:
    """The voxels with a face that is outside: all that can be seen."""
    around = pad(inside, [1] * 6)
    own = slice(1, -1)
    core_x = around[:-2, own, own] & around[2:, own, own]
    core_y = around[own, :-2, own] & around[own, 2:, own]
    core_z = around[own, own, :-2] & around[own, own, 2:]
    return inside & ~(core_x & core_y & core_z)


def _to_voxels(blocks: Bool[Tensor, "x_block y_block z_block"]) -> Bool[Tensor, "x y z"]:
    sides = [length for side in blocks.shape for length in (side, PART_BLOCK)]
    return (
        blocks[:, None, :, None, :, None].expand(sides).reshape([PART_BLOCK * side for side in blocks.shape])
    )


def _unneeded(
    part: Int[np.ndarray, "voxel"], points: Float[Tensor, "voxel 3"], cameras: Cameras, voxel_m: float
) -> list[int]:
    """The parts that can go, one after another, while nearly all of every image stays covered.

    Cells next to a covered one count as covered, too: the same masks carved an unneeded part and the
    others, so their edges lie in the same places.
    """
    sizes = np.bincount(part)
    uv, z = project(points, cameras)
    sees = in_view(uv, z, cameras)
    views = []  # of each camera: how many parts each cell is covered by, and the cells of each part
    for view in range(len(cameras)):
        own = sees[view].numpy()
        if own.any():
            cell_px = CELL * float(cameras.K[view, 0, 0]) * voxel_m / float(z[view, sees[view]].min())
            x, y = (uv[view, sees[view]].numpy() / cell_px).astype(np.int64).T + 1
            views.append(_Cells.of(part[own], y, x))
    dropped = []
    for candidate in sizes.argsort(kind="stable")[(sizes == 0).sum() :].tolist():
        speck = SPECK if candidate != sizes.argmax() else 0
        if all(cells.can_go(candidate, speck) for cells in views):
            dropped.append(candidate)
            for cells in views:
                cells.drop(candidate)
    return dropped


@dataclass(frozen=True)
class _Cells:
    """What the parts cover of a camera's image."""

    count: Int[np.ndarray, "cell"]
    """How many parts cover a cell, or one next to it."""
    of_part: dict[int, tuple[Int[np.ndarray, "own"], Int[np.ndarray, "near"]]]
    """The cells of each part, and those with their neighbours."""

    @classmethod
    def of(
        cls, part: Int[np.ndarray, "point"], y: Int[np.ndarray, "point"], x: Int[np.ndarray, "point"]
    ) -> "_Cells":
        width = int(x.max()) + 2
        height = int(y.max()) + 2
        place = y * width + x
        count = np.zeros(height * width, np.int64)
        around = (np.arange(-1, 2)[:, None] * width + np.arange(-1, 2)).ravel()
        order = part.argsort(kind="stable")
        numbers, first = np.unique(part[order], return_index=True)
        of_part = {}
        for number, places in zip(numbers.tolist(), np.split(place[order], first[1:]), strict=True):
            own = _distinct(places, len(count))
            near = _distinct((own[:, None] + around).ravel(), len(count))
            count[near] += 1
            of_part[number] = own, near
        return cls(count, of_part)

    def can_go(self, number: int, speck: int) -> bool:
        """Whether others cover all of a part's image but a small share or `speck` cells, or it is not in the image."""
        if number not in self.of_part:
            return True
        own = self.of_part[number][0]
        return int((self.count[own] <= 1).sum()) <= max(speck, (1 - COVERED) * len(own))

    def drop(self, number: int) -> None:
        if number in self.of_part:
            self.count[self.of_part[number][1]] -= 1


def _distinct(values: Int[np.ndarray, "value"], end: int) -> Int[np.ndarray, "distinct"]:
    """The distinct ones of non-negative values below `end`."""
    if len(values) < MANY:
        return np.unique(values)
    found = np.zeros(end, bool)
    found[values] = True
    return np.flatnonzero(found)
