"""Marching cubes' cases, derived rather than tabulated: which triangles cut a cell, given its corners' signs.

Corner k of a cell is at (k & 1, k >> 1 & 1, k >> 2 & 1); case bit k says that corner k is inside.
"""

import itertools
from functools import cache

import torch
from jaxtyping import Int
from torch import Tensor

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
