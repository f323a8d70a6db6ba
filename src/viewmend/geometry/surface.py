"""The surface of an occupancy grid, by marching cubes."""

import itertools
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.geometry.hull import OccupancyGrid
from viewmend.geometry.mesh import Mesh

ISO = 0.5


def extract_surface(grid: OccupancyGrid) -> Mesh:
    """The surface where the grid's value is one half, linearly interpolated: closed, outward, on the grid's device.

    Space beyond the grid counts as empty, so an object that leaves it is capped. Each side of a triangle belongs to
    exactly two triangles. An empty grid gives a mesh of no vertices.
    """
    device = grid.values.device
    box = occupied_box(grid.values > ISO)
    if box is None:
        empty = torch.zeros(0, 3, device=device)
        return Mesh(empty, torch.zeros(0, 3, dtype=torch.int32, device=device))
    values = torch.nn.functional.pad(grid.values[box], (1, 1, 1, 1, 1, 1))
    first = torch.tensor([side.start for side in box], device=device)
    vertices, faces = (part.to(device) for part in _march(values.cpu()))
    # Padding moved the origin by one voxel, values sit in the middle of theirs.
    return Mesh((vertices + first - 0.5) * grid.voxel_m + grid.low, faces)


def _march(values: Float[Tensor, "x y z"]) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Vertices, in voxels, and triangles."""
    from viewmend.geometry import _surface_numba as kernels

    grid = values.contiguous().numpy()
    vertices = torch.empty(kernels.count_crossings(grid, ISO), 3)
    vertex_of_edge = torch.empty(3, *values.shape, dtype=torch.int32).numpy()
    kernels.place_crossings(grid, ISO, vertices.numpy(), vertex_of_edge)
    # A vertex is in one loop of each of its edge's four cells, and n vertices of a loop make n - 2 triangles.
    faces = torch.empty(4 * len(vertices), 3, dtype=torch.int32)
    starts = torch.tensor([[e // 4, k & 1, k >> 1 & 1, k >> 2 & 1] for e, (k, _) in enumerate(EDGES)])
    table = triangle_table().numpy()
    count = kernels.connect(grid, ISO, table, starts.numpy(), vertex_of_edge, faces.numpy())
    return vertices, faces[:count].clone()  # half of it: the rest would stay as long as the mesh


def occupied_box(inside: Tensor) -> tuple[slice, ...] | None:
    """The box of inside voxels and one voxel around them, where the grid has it."""
    over_x = inside.any(0)
    sides = []
    for line in (inside.flatten(1).any(1), over_x.any(1), over_x.any(0)):
        index = line.nonzero()[:, 0].tolist()
        if not index:
            return None
        sides.append(slice(max(index[0] - 1, 0), min(index[-1] + 2, len(line))))
    return tuple(sides)


EDGES = tuple((k, k | 1 << axis) for axis in range(3) for k in range(8) if not k >> axis & 1)
"""The twelve edges as pairs of corners: four along x, four along y, four along z."""

Loop = list[int]
"""Edges of a cell in the order in which the surface crosses them."""


@cache
def triangle_table() -> Int[Tensor, "256 5 3"]:
    """For each case up to five triangles, as edges whose crossings are their corners; -1 where there are fewer.

    The surface cuts each face of a cell by a rule that looks at that face alone (inside corners that touch only
    diagonally stay apart), and no triangle has another side in a face. So neighbours always fit, and a surface of a
    volume whose border is outside is closed: each side belongs to exactly two triangles.
    """
    table = torch.full((256, 5, 3), -1, dtype=torch.long)
    for case in range(256):
        triangles = [corners for loop in _loops(case) for corners in _triangulate(loop)]
        for i, corners in enumerate(triangles):
            table[case, i] = torch.tensor(corners)
    return table


@cache
def _cell_faces() -> tuple[tuple[int, ...], ...]:
    """The six faces as corners, counter-clockwise seen from outside."""
    faces = []
    for axis in range(3):
        b, c = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        faces += [(0, c, b | c, b), tuple(k | 1 << axis for k in (0, b, b | c, c))]
    return tuple(faces)


def _edge(face: tuple[int, ...], side: int) -> int:
    a, b = face[side], face[(side + 1) % 4]
    return EDGES.index((min(a, b), max(a, b)))


def _loops(case: int) -> list[Loop]:
    """The closed lines along which the surface crosses the cell's faces, inside on their right seen from outside."""
    following = {}
    for face in _cell_faces():
        inside = [bool(case >> k & 1) for k in face]
        for enter in range(4):
            if not inside[enter] and inside[(enter + 1) % 4]:
                leave = (enter + 1) % 4
                while inside[(leave + 1) % 4]:
                    leave = (leave + 1) % 4
                following[_edge(face, enter)] = _edge(face, leave)
    loops = []
    while following:
        loop = [next(iter(following))]
        while (edge := following.pop(loop[-1])) != loop[0]:
            loop.append(edge)
        loops.append(loop)
    return loops


def _triangulate(loop: Loop) -> list[tuple[int, int, int]]:
    """The first triangulation of the loop none of whose inner sides lies in a face of the cell."""
    faces = [{_edge(face, side) for side in range(4)} for face in _cell_faces()]
    border = {frozenset(pair) for pair in zip(loop, loop[1:] + loop[:1], strict=True)}
    for triangles in _triangulations(loop):
        sides = {frozenset(pair) for corners in triangles for pair in itertools.combinations(corners, 2)}
        if not any(side <= face for side in sides - border for face in faces):
            return triangles
    raise AssertionError(f"no triangulation of {loop}")


def _triangulations(loop: Loop) -> list[list[tuple[int, int, int]]]:
    if len(loop) < 3:
        return [[]]
    return [
        [*left, (loop[0], loop[k], loop[-1]), *right]
        for k in range(1, len(loop) - 1)
        for left in _triangulations(loop[: k + 1])
        for right in _triangulations(loop[k:])
    ]
