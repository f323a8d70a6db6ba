"""Paints cloth on flat charts, in metres, and assembles a performer's charts into one mesh and one atlas."""

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.studio.performer import BoundMesh, TexturedMesh
from viewmend.studio.procedural.skeleton import Vector

PX_PER_M = 520.0
WORDS = (
    "VIEW",
    "MEND",
    "STUDIO",
    "NORTH",
    "RIVER",
    "SUN",
    "TEAM 7",
    "HELLO",
    "WAVE",
    "1984",
    "JAZZ",
    "ATLAS",
    "GO!",
)
KINDS = (
    *("plain", "heather", "stripes", "pinstripes", "bands", "gingham", "tartan", "dots"),
    *("flowers", "blobs", "gradient", "zigzag", "denim", "knit", "letters"),
)
QUIET = ("plain", "heather", "denim", "knit", "stripes", "gradient", "bands")
"""Kinds of cloth that leave room for a word across the chest."""
PRINTED = ("bands", "dots", "flowers", "blobs", "gradient", "zigzag", "letters")
Image = Float[np.ndarray, "height width 3"]
Plane = Float[np.ndarray, "height width"]
ATLAS_GUTTER_PX = 3
"""Pixels between two textures of the atlas, so that filters do not mix them."""


@dataclass(frozen=True)
class Canvas:
    """The texels of a chart in metres: x to the right from the middle (front), y up from the lower edge."""

    width_m: float
    height_m: float
    px_per_m: float = PX_PER_M

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of texels."""
        return max(8, round(self.height_m * self.px_per_m)), max(8, round(self.width_m * self.px_per_m))

    @property
    def x(self) -> Plane:
        """Metres right of the middle, of each texel."""
        rows, columns = self.shape
        return np.broadcast_to(np.linspace(-0.5, 0.5, columns) * self.width_m, (rows, columns))

    @property
    def y(self) -> Plane:
        """Metres above the lower edge, of each texel."""
        rows, columns = self.shape
        return np.broadcast_to((np.linspace(1, 0, rows) * self.height_m)[:, None], (rows, columns))

    def noise(self, rng: np.random.Generator, cell_x_m: float, cell_y_m: float) -> Plane:
        """Make smooth noise of about unit variance, with grains of this size."""
        rows, columns = self.shape
        coarse = (max(2, round(self.height_m / cell_y_m) + 1), max(2, round(self.width_m / cell_x_m) + 1))
        values = rng.standard_normal(coarse)
        if coarse[0] > rows or coarse[1] > columns:
            return rng.standard_normal((rows, columns))
        return cv2.resize(values, (columns, rows), interpolation=cv2.INTER_CUBIC)


def hsv(h: float, s: float, v: float) -> Vector:
    """Convert hue, saturation and value, each in [0, 1], to sRGB."""
    return np.array(colorsys.hsv_to_rgb(h % 1.0, min(max(s, 0), 1), min(max(v, 0), 1)))


@dataclass(frozen=True)
class Fabric:
    """A cloth: its kind, three colours and the size of its pattern."""

    kind: str
    colors: Float[np.ndarray, "3 3"]
    period_m: float
    seed: int

    def paint(self, canvas: Canvas) -> Image:
        """Paint the cloth on a flat canvas."""
        rng = np.random.default_rng(self.seed)
        flat = np.broadcast_to(self.colors[0], (*canvas.shape, 3)).astype(np.float64)
        image = (_print_pattern if self.kind in PRINTED else _weave_pattern)(flat, self, canvas, rng)
        weave = 1 + 0.025 * rng.standard_normal(canvas.shape)
        return np.clip(image * weave[..., None], 0, 1)


def sample_fabric(rng: np.random.Generator, kinds: tuple[str, ...] = KINDS) -> Fabric:
    """Sample a cloth of these kinds."""
    quiet = tuple(k for k in kinds if k in QUIET)
    pool = quiet if quiet and rng.random() < 0.3 else kinds
    kind = pool[int(rng.integers(len(pool)))]
    hue = rng.random()
    muted = rng.random() < 0.45
    saturation = rng.uniform(0.0, 0.35) if muted else rng.uniform(0.4, 0.95)
    value = rng.uniform(0.15, 0.95) if muted else rng.uniform(0.35, 0.95)
    main = hsv(hue, saturation, value)
    pale_or_dark = hsv(hue + rng.normal(0, 0.08), saturation * 0.4, 0.95 if value < 0.6 else 0.22)
    accent = hsv(hue + rng.choice([0.08, 0.33, 0.5, 0.6]), rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.95))
    if kind == "denim":
        main = hsv(rng.uniform(0.58, 0.63), rng.uniform(0.35, 0.65), rng.uniform(0.22, 0.6))
    second = accent if rng.random() < 0.35 else pale_or_dark
    period = float(np.exp(rng.uniform(np.log(0.028), np.log(0.11))))
    return Fabric(kind, np.stack([main, second, accent]), period, int(rng.integers(2**31)))


def blend(base: Image, color: Vector | Image, alpha: Plane) -> Image:
    """Composite `color` over `base` with coverage `alpha`."""
    return base + np.clip(alpha, 0, 1)[..., None] * (color - base)


def edge(distance_m: Plane, canvas: Canvas) -> Plane:
    """Anti-aliased coverage of the region where `distance_m` is positive."""
    return np.clip(distance_m * canvas.px_per_m + 0.5, 0, 1)


def wave(position_m: Plane, period_m: float, share: float, canvas: Canvas) -> Plane:
    """Coverage of stripes across this coordinate, `share` of each period wide, anti-aliased."""
    phase = np.abs((position_m / period_m) % 1.0 - 0.5)
    return edge((phase - 0.5 + share / 2) * period_m, canvas)


def _weave_pattern(image: Image, fabric: Fabric, canvas: Canvas, rng: np.random.Generator) -> Image:
    """Weave the fabric's pattern into an image of its first colour."""
    x = canvas.x
    y = canvas.y
    period = fabric.period_m
    _, second, third = fabric.colors
    match fabric.kind:
        case "heather":
            grain = 0.10 * canvas.noise(rng, 0.006, 0.002) + 0.05 * canvas.noise(rng, 0.02, 0.004)
            image = image * (1 + grain[..., None])
        case "stripes":
            image = blend(image, second, wave(y, period, rng.uniform(0.25, 0.6), canvas))
        case "pinstripes":
            image = blend(image, second, wave(x, period * rng.uniform(0.5, 1.2), 0.25, canvas))
        case "gingham":
            for axis in (y, x):
                image = blend(image, second, 0.5 * wave(axis, period, 0.5, canvas))
        case "tartan":
            period = period * 1.8
            stripes = ((second, 0.35, 0.0, 0.5), (third, 0.10, 0.31, 0.75), (second, 0.05, 0.62, 0.8))
            for color, share, shift, alpha in stripes:
                for axis in (x, y):
                    image = blend(image, color, alpha * wave(axis + shift * period, period, share, canvas))
        case "denim":
            twill = 0.08 * rng.standard_normal(canvas.shape) + 0.06 * canvas.noise(rng, 0.003, 0.03)
            image = image * (1 + (twill + 0.16 * canvas.noise(rng, 0.12, 0.25))[..., None])
        case "knit":
            rib = 0.13 * np.cos(2 * np.pi * x / 0.018) + 0.05 * np.cos(2 * np.pi * y / 0.011)
            image = image * (0.9 + rib[..., None])
    return image


def _print_pattern(image: Image, fabric: Fabric, canvas: Canvas, rng: np.random.Generator) -> Image:
    """Print the fabric's pattern on an image of its first colour."""
    x = canvas.x
    y = canvas.y
    period = fabric.period_m
    _, second, third = fabric.colors
    match fabric.kind:
        case "bands":
            low, high = sorted(rng.uniform(0.25, 0.85, 2) * canvas.height_m)
            image = blend(image, second, edge(y - low, canvas) * edge(high + 0.03 - y, canvas))
            rim = edge(0.012 - np.abs(y - low), canvas) + edge(0.012 - np.abs(y - high - 0.03), canvas)
            image = blend(image, third, rim)
        case "dots":
            radius = period * rng.uniform(0.18, 0.32)
            across = (x / period + 0.5 * (np.floor(y / period) % 2)) % 1.0 - 0.5
            distance = period * np.hypot(across, (y / period) % 1.0 - 0.5)
            image = blend(image, second, edge(radius - distance, canvas))
        case "flowers":
            image = _print_flowers(image, fabric, canvas, rng)
        case "blobs":
            cell = period * 0.9
            for color, level in ((second, 0.2), (third, 0.6)):
                spots = canvas.noise(rng, cell, cell) + 0.4 * canvas.noise(rng, cell / 2.5, cell / 2.5)
                image = blend(image, color, edge((spots - level) * cell * 0.3, canvas))
        case "gradient":
            image = blend(image, second, y / canvas.height_m)
        case "zigzag":
            fold = period * 0.6 * np.abs((x / period) % 1.0 - 0.5)
            image = blend(image, second, wave(y + fold, period, 0.4, canvas))
            image = blend(image, third, wave(y + fold + 0.4 * period, period, 0.12, canvas))
        case "letters":
            step = 0.13
            word = WORDS[int(rng.integers(len(WORDS)))]
            for row, top in enumerate(np.arange(step / 2, canvas.height_m, step)):
                for left in np.arange(-(row % 2) * step - canvas.width_m / 2, canvas.width_m / 2, 1.9 * step):
                    image = write(image, canvas, word, second, (left + step, top), 0.8 * step)
    return image


def _print_flowers(image: Image, fabric: Fabric, canvas: Canvas, rng: np.random.Generator) -> Image:
    # Bytes are the only depth that OpenCV draws smooth edges in.
    flat = np.ascontiguousarray((255 * image).astype(np.uint8))
    rows, columns = canvas.shape
    size = fabric.period_m * 0.42 * canvas.px_per_m
    palette = [fabric.colors[1], fabric.colors[2], hsv(0.32, 0.5, 0.4)]
    for _ in range(max(int(rows * columns / (2.6 * size) ** 2 * 1.6), 3)):
        center = rng.uniform(0, 1, 2) * (columns, rows)
        turn = rng.uniform(0, 6.3)
        scale = size * rng.uniform(0.5, 1.1)
        color = (255 * palette[int(rng.integers(3))]).tolist()
        petals = int(rng.integers(4, 7))
        for k in range(petals):
            angle = turn + 2 * np.pi * k / petals
            x, y = center + 0.55 * scale * np.array([np.cos(angle), np.sin(angle)])
            axes = (max(1, int(0.45 * scale)), max(1, int(0.25 * scale)))
            cv2.ellipse(flat, (int(x), int(y)), axes, np.degrees(angle), 0, 360, color, -1, cv2.LINE_AA)
        middle = (int(center[0]), int(center[1]))
        radius = max(1, int(0.22 * scale))
        cv2.circle(flat, middle, radius, (240, 200, 50), -1, cv2.LINE_AA)
    return flat / 255.0


def write(
    image: Image, canvas: Canvas, word: str, color: Vector, at_m: tuple[float, float], width_m: float
) -> Image:
    """Write a word of this width, at most 9 cm tall, centred at a position of the canvas."""
    font = cv2.FONT_HERSHEY_DUPLEX
    thick = max(2, round(0.05 * width_m * canvas.px_per_m))
    (wide, tall), _ = cv2.getTextSize(word, font, 1.0, 1)
    scale = min(width_m * canvas.px_per_m / wide, 0.09 * canvas.px_per_m / tall)
    left = int((at_m[0] + canvas.width_m / 2) * canvas.px_per_m - scale * wide / 2)
    base = int((canvas.height_m - at_m[1]) * canvas.px_per_m + scale * tall / 2)
    ink = np.zeros(canvas.shape, dtype=np.uint8)
    cv2.putText(ink, word, (left, base), font, scale, 255, thick, cv2.LINE_AA)
    return blend(image, color, ink / 255.0)


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
    """Vertices to keep; faces all of whose vertices are dropped are removed."""
    closed: bool = True
    """Whether the last column repeats the first, so that their normals must agree."""


def outward_of(azimuth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
    """The horizontal unit vectors at these azimuths."""
    return np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], -1)


def two_sided(outside: Patch, inside: Float[np.ndarray, "row column 3"], shade: float) -> list[Patch]:
    """Make an open sheet and its other side at `inside`, in `shade` times the chart's mean colour."""
    dark = np.broadcast_to(shade * outside.chart.mean((0, 1)), (8, 8, 3))
    back = Patch(inside[:, ::-1], outside.uv[:, ::-1], outside.weights[:, ::-1], dark, closed=outside.closed)
    return [outside, back]


def assemble(patches: list[Patch]) -> BoundMesh:
    """Assemble all patches into one mesh and one atlas."""
    offsets, atlas = pack_charts([patch.chart for patch in patches])
    height, width = atlas.shape[:2]
    faces = []
    normals = []
    uvs = []
    first = 0
    for patch, (left, top) in zip(patches, offsets, strict=True):
        triangles = _visible_faces(patch)
        normals.append(_grid_normals(patch, triangles).reshape(-1, 3))
        chart_height, chart_width = patch.chart.shape[:2]
        u = (left + 0.5 + patch.uv[..., 0] * (chart_width - 1)) / width
        v = (top + 0.5 + (1 - patch.uv[..., 1]) * (chart_height - 1)) / height
        uvs.append(np.stack([u, v], -1).reshape(-1, 2))
        faces.append(triangles + first)
        first += len(normals[-1])
    vertices = np.concatenate([patch.points.reshape(-1, 3) for patch in patches])
    dense = np.concatenate([patch.weights.reshape(-1, patch.weights.shape[-1]) for patch in patches])
    joints = np.argsort(-dense, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(dense, joints, axis=1)
    weights /= weights.sum(1, keepdims=True)
    # Vertices that no face uses would stretch bounding boxes and move the lowest point: drop them.
    face_table, inverse = np.unique(np.concatenate(faces), return_inverse=True)
    mesh = Mesh(_float(vertices[face_table]), torch.from_numpy(inverse.reshape(-1, 3).astype(np.int64)))
    rest = TexturedMesh(
        mesh,
        _float(np.concatenate(normals)[face_table]),
        _float(np.clip(np.concatenate(uvs)[face_table], 0, 1)),
        torch.zeros(len(mesh.faces), dtype=torch.int64),
        (_float(atlas).permute(2, 0, 1).contiguous(),),
    )
    return BoundMesh(rest, torch.from_numpy(joints[face_table].astype(np.int64)), _float(weights[face_table]))


def _float(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def _visible_faces(patch: Patch) -> Int[np.ndarray, "face 3"]:
    """Make two triangles for each kept cell of a grid, counter-clockwise from outside, none degenerate."""
    rows, columns = patch.points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (
        part.reshape(-1) for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    )
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
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


def pack_charts(charts: list[Float[np.ndarray, "_ _ 3"]]) -> tuple[list[tuple[int, int]], Image]:
    """Pack the charts on shelves of one near-square image; returns each chart's (left, top), and the image.

    Each chart is framed by a gutter that repeats its edge, so that sampling near an edge never
    reaches a neighbour.
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
            left = 0
            top = top + shelf
            shelf = 0
        offsets[i] = (left + gutter, top + gutter)
        left = left + w
        shelf = max(shelf, h)
    atlas = np.zeros((top + shelf, width, 3), dtype=np.float32)
    for chart, (x, y) in zip(charts, offsets, strict=True):
        framed = np.pad(chart, ((gutter, gutter), (gutter, gutter), (0, 0)), mode="edge")
        atlas[y - gutter : y - gutter + framed.shape[0], x - gutter : x - gutter + framed.shape[1]] = framed
    return offsets, atlas
