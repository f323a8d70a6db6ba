"""The surface of an occupancy grid, by marching cubes."""

import itertools
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.geometry.hull import ISO, OccupancyGrid
from viewmend.geometry.mesh import Mesh

EDGES = tuple((k, k | 1 << axis) for axis in range(3) for k in range(8) if not k >> axis & 1)
"""The twelve edges of a cell are pairs of corners: four along x, four along y, four along z."""

Loop = list[int]
"""Edges of a cell in the order in which the surface crosses them."""


def extract_surface(grid: OccupancyGrid) -> Mesh:
    """The surface where the grid's value is one half, linearly interpolated: closed, outward, on the grid's device.

    Space beyond the grid counts as empty, so an object that leaves it is capped. Each side of a
    triangle belongs to exactly two triangles. An empty grid gives a mesh of no vertices.
    """
    device = grid.values.device
    sides = grid.summary.inside
    if sides is None:
        empty = torch.zeros(0, 3, device=device)
        return Mesh(empty, empty.int())
    # the box of what is inside and one voxel around it, where the grid has it, in a border of empty voxels
    box = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in sides)
    values = torch.nn.functional.pad(grid.values[box], (1, 1, 1, 1, 1, 1))
    vertices, faces = (march_numba if values.device.type == "cpu" else march_torch)(values)
    # Padding moved the origin by one voxel, values sit in the middle of theirs.
    first = torch.tensor([float(side.start) for side in box])
    first, low = torch.stack([first, grid.low]).to(device)
    return Mesh((vertices + first - 0.5) * grid.voxel_m + low, faces)


def march_numba(values: Float[Tensor, "x y z"]) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Vertices, in voxels, and triangles, on the CPU."""
    from viewmend.geometry import _surface_numba as kernels

    grid = values.contiguous().numpy()
    vertices = torch.empty(kernels.count_crossings(grid, ISO), 3)
    vertex_of_edge = torch.empty(3, *values.shape, dtype=torch.int32).numpy()
    kernels.place_crossings(grid, ISO, vertices.numpy(), vertex_of_edge)
    # A vertex is in one loop of each of its edge's four cells, and n vertices of a loop make n - 2 triangles.
    faces = torch.empty(4 * len(vertices), 3, dtype=torch.int32)
    table, starts = _march_tables(values.device)
    count = kernels.connect(grid, ISO, table.numpy(), starts.numpy(), vertex_of_edge, faces.numpy())
    return vertices, faces[:count].clone()  # half of it: the rest would stay as long as the mesh


def march_torch(values: Float[Tensor, "x y z"]) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """The same on any device, which is read twice."""
    # where the surface crosses an edge, along x, then y, then z
    inside = values > ISO
    changes = torch.zeros(3, *values.shape, dtype=torch.bool, device=values.device)
    for axis in range(3):
        steps = values.shape[axis] - 1
        torch.ne(
            inside.narrow(axis, 0, steps),
            inside.narrow(axis, 1, steps),
            out=changes[axis].narrow(axis, 0, steps),
        )
    edges = changes.nonzero()
    vertex_of_edge = torch.full((3 * inside.numel(),), -1, dtype=torch.int32, device=values.device)
    axis, x, y, z = edges.unbind(1)
    size_y, size_z = values.shape[1:]
    cell = (x * size_y + y) * size_z + z
    vertex_of_edge[axis * inside.numel() + cell] = torch.arange(
        len(edges), dtype=torch.int32, device=values.device
    )

    # how far along the edge
    stride = torch.where(axis == 0, size_y * size_z, torch.where(axis == 1, size_z, 1))
    near = values.flatten()[cell]
    far = values.flatten()[cell + stride]
    along = (ISO - near) / (far - near)
    position = edges[:, 1:].to(values)
    position += (axis[:, None] == torch.arange(3, device=axis.device)) * along[:, None]
    return position, _triangles(inside, vertex_of_edge)


def _triangles(inside: Tensor, vertex_of_edge: Int[Tensor, "edge"]) -> Int[Tensor, "face 3"]:
    """The triangles of all cells, as vertices; `vertex_of_edge` has those on the edges from (x, y, z) along an axis."""
    size_x, size_y, size_z = inside.shape
    case = torch.zeros(size_x - 1, size_y - 1, size_z - 1, dtype=torch.uint8, device=inside.device)
    for k in range(8):
        x = k & 1
        y = k >> 1 & 1
        z = k >> 2 & 1
        corner = inside[x : size_x - 1 + x, y : size_y - 1 + y, z : size_z - 1 + z]
        case |= corner.to(torch.uint8) << k
    table, starts = _march_tables(inside.device)
    x, y, z, slot = (table[..., 0] >= 0)[case.long()].nonzero().unbind(1)
    edges = table[case[x, y, z].long(), slot]
    # Where each edge starts, relative to its cell, in the flat (axis, x, y, z) order of `vertex_of_edge`.
    axis, dx, dy, dz = starts[edges].unbind(-1)
    flat = ((axis * size_x + x[:, None] + dx) * size_y + y[:, None] + dy) * size_z + z[:, None] + dz
    return vertex_of_edge[flat]


@cache
def _march_tables(device: torch.device) -> tuple[Int[Tensor, "256 5 3"], Int[Tensor, "12 4"]]:
    """`triangle_table`, and axis and first corner of each edge, on a device."""
    starts = torch.tensor([[e // 4, k & 1, k >> 1 & 1, k >> 2 & 1] for e, (k, _) in enumerate(EDGES)])
    return triangle_table().to(device), starts.to(device)


@cache
def triangle_table() -> Int[Tensor, "256 5 3"]:
    """Up to five triangles per case, as edges whose crossings are their corners; -1 pads the rest.

    The surface cuts each face of a cell by a rule that looks at that face alone (inside corners
    that touch only diagonally stay apart), and no triangle has another side in a face. So
    neighbours always fit, and a surface of a volume whose border is outside is closed: each side
    belongs to exactly two triangles.
    """
    table = torch.full((256, 5, 3), -1, dtype=torch.long)
    for case in range(256):
        for i, corners in enumerate(corners for loop in _loops(case) for corners in _triangulate(loop)):
            table[case, i] = torch.tensor(corners)
    return table


@cache
def _cell_faces() -> tuple[tuple[int, ...], ...]:
    """The six faces as corners, counter-clockwise seen from outside."""
    faces = []
    for axis in range(3):
        b = 1 << (axis + 1) % 3
        c = 1 << (axis + 2) % 3
        faces += [(0, c, b | c, b), tuple(k | 1 << axis for k in (0, b, b | c, c))]
    return tuple(faces)


def _edge(face: tuple[int, ...], side: int) -> int:
    corners = (face[side], face[(side + 1) % 4])
    return EDGES.index((min(corners), max(corners)))


def _loops(case: int) -> list[Loop]:
    """The closed lines along which the surface crosses the cell's faces, inside on their right seen from outside."""
    following = {}
    for face in _cell_faces():
        inside = [case >> k & 1 for k in face]
        for enter in range(4):
            leave = (enter + 1) % 4
            if inside[enter] or not inside[leave]:
                continue
            while inside[(leave + 1) % 4]:
                leave = (leave + 1) % 4
            following[_edge(face, enter)] = _edge(face, leave)
    loops = []
    while following:
        loop = []
        edge = next(iter(following))
        while edge in following:
            loop.append(edge)
            edge = following.pop(edge)
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
