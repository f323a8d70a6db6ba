"""Sheets: grids of points with weights and a painted chart each, and their assembly into one skinned mesh."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.geometry.mesh import Mesh, vertex_normals

ATLAS_GUTTER_PX = 3


@dataclass(frozen=True)
class Patch:
    """One sheet in the bind pose. Seen from outside, columns run to the right and rows run up."""

    points: Float[np.ndarray, "row column 3"]
    uv: Float[np.ndarray, "row column 2"]
    """Texture coordinates in this patch's own chart: u to the right, v up, in [0, 1]."""
    weights: Float[np.ndarray, "row column joint"]
    chart: Float[np.ndarray, "height width 3"]
    """sRGB in [0, 1], top row first."""
    keep: Bool[np.ndarray, "row column"] | None = None
    """A face goes where none of its corners is kept."""
    closed: bool = True
    """The last column repeats the first (the normals must agree)."""


@dataclass(frozen=True)
class BoundMesh:
    """A skinned mesh in its bind pose, ready for `skinning.skin_with_normals`."""

    mesh: Mesh
    normals: Float[Tensor, "vertex 3"]
    uv: Float[Tensor, "vertex 2"]
    joints: Int[Tensor, "vertex 4"]
    weights: Float[Tensor, "vertex 4"]
    atlas: Float[Tensor, "3 texture_height texture_width"]


def outward_of(azimuth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    """The horizontal unit vectors at these azimuths."""
    return np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], -1)


def two_sided(outside: Patch, inside: Float[np.ndarray, "row column 3"], shade: float) -> list[Patch]:
    """An open sheet and its other side at the points `inside`: in one colour, `shade` times the chart's mean."""
    dark = np.broadcast_to(shade * outside.chart.mean((0, 1)), (8, 8, 3))
    back = Patch(inside[:, ::-1], outside.uv[:, ::-1], outside.weights[:, ::-1], dark, closed=outside.closed)
    return [outside, back]


def grid_faces(rows: int, columns: int) -> Int[np.ndarray, "face 3"]:
    """Two triangles for each cell of a grid, counter-clockwise from outside."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])


def assemble(patches: list[Patch]) -> BoundMesh:
    """One mesh and one atlas out of all patches."""
    offsets, atlas = pack_charts([patch.chart for patch in patches])
    height, width = atlas.shape[:2]
    faces, normals, uvs, first = [], [], [], 0
    for patch, (left, top) in zip(patches, offsets, strict=True):
        rows, columns = patch.points.shape[:2]
        triangles = _shown_faces(patch)
        normals.append(_grid_normals(patch, triangles).reshape(-1, 3))
        chart_height, chart_width = patch.chart.shape[:2]
        u = (left + 0.5 + patch.uv[..., 0] * (chart_width - 1)) / width
        v = (top + 0.5 + (1 - patch.uv[..., 1]) * (chart_height - 1)) / height
        uvs.append(np.stack([u, v], -1).reshape(-1, 2))
        faces.append(triangles + first)
        first += rows * columns
    vertices = np.concatenate([patch.points.reshape(-1, 3) for patch in patches])
    dense = np.concatenate([patch.weights.reshape(-1, patch.weights.shape[-1]) for patch in patches])
    joints = np.argsort(-dense, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(dense, joints, axis=1)
    weights /= weights.sum(1, keepdims=True)
    # Vertices that no face uses would stretch bounding boxes and move the lowest point: drop them.
    face_table, inverse = np.unique(np.concatenate(faces), return_inverse=True)
    return BoundMesh(
        mesh=Mesh(_float(vertices[face_table]), torch.from_numpy(inverse.reshape(-1, 3).astype(np.int64))),
        normals=_float(np.concatenate(normals)[face_table]),
        uv=_float(np.clip(np.concatenate(uvs)[face_table], 0, 1)),
        joints=torch.from_numpy(joints[face_table].astype(np.int64)),
        weights=_float(weights[face_table]),
        atlas=_float(atlas).permute(2, 0, 1).contiguous(),
    )


def _float(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def _shown_faces(patch: Patch) -> Int[np.ndarray, "face 3"]:
    triangles = grid_faces(*patch.points.shape[:2])
    if patch.keep is not None:
        triangles = triangles[patch.keep.reshape(-1)[triangles].any(1)]
    a, b, c = patch.points.reshape(-1, 3)[triangles].transpose(1, 0, 2)
    return triangles[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-10]


def _grid_normals(patch: Patch, triangles: Int[np.ndarray, "face 3"]) -> Float[np.ndarray, "row column 3"]:
    mesh = Mesh(torch.from_numpy(patch.points.reshape(-1, 3)), torch.from_numpy(triangles.astype(np.int64)))
    normals = vertex_normals(mesh).numpy().reshape(patch.points.shape).copy()
    if patch.closed:
        seam = normals[:, 0] + normals[:, -1]
        normals[:, 0] = normals[:, -1] = seam / np.maximum(np.linalg.norm(seam, axis=1, keepdims=True), 1e-9)
    return normals


def pack_charts(
    charts: list[Float[np.ndarray, "_ _ 3"]],
) -> tuple[list[tuple[int, int]], Float[np.ndarray, "height width 3"]]:
    """Shelve the charts in one near-square image: (left, top) of each in pixels, and the image.

    Each chart is framed by a gutter that repeats its edge, so that sampling near an edge never reaches a neighbour.
    """
    gutter = ATLAS_GUTTER_PX
    sizes = [(c.shape[1] + 2 * gutter, c.shape[0] + 2 * gutter) for c in charts]
    area = sum(w * h for w, h in sizes)
    width = max(max(w for w, _ in sizes), int(np.ceil((1.08 * area) ** 0.5)))
    offsets: list[tuple[int, int]] = [(0, 0)] * len(charts)
    left = top = shelf = 0
    for i in sorted(range(len(charts)), key=lambda i: (-sizes[i][1], i)):
        w, h = sizes[i]
        if left + w > width:
            left, top, shelf = 0, top + shelf, 0
        offsets[i] = (left + gutter, top + gutter)
        left, shelf = left + w, max(shelf, h)
    atlas = np.zeros((top + shelf, width, 3), dtype=np.float32)
    for chart, (x, y) in zip(charts, offsets, strict=True):
        framed = np.pad(chart, ((gutter, gutter), (gutter, gutter), (0, 0)), mode="edge")
        atlas[y - gutter : y - gutter + framed.shape[0], x - gutter : x - gutter + framed.shape[1]] = framed
    return offsets, atlas
