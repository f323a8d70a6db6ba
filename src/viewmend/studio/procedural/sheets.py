"""Skin and cloth laid on the body: a stretch of the torso, of a limb, or a skirt, as a painted patch."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.body import Body
from viewmend.studio.procedural.fabric import PX_PER_M, Canvas, Image
from viewmend.studio.procedural.patches import Patch, outward_of, two_sided
from viewmend.studio.procedural.skeleton import INDEX, SKIRT_COLUMNS, Points, Skeleton, Values, Weights
from viewmend.studio.procedural.weights import body_weights, mix, one_joint, smoothstep

Painter = Callable[[Canvas], Image]
Azimuths = Float[np.ndarray, "column"]


@dataclass(frozen=True)
class Wearer:
    """The naked body that gives all sheets their weights."""

    body: Body
    skeleton: Skeleton
    height_m: float

    def weights(self, points: Points, part: int = 0) -> Weights:
        """Skinning weights at these points of a part's sheet."""
        return body_weights(self.body, self.skeleton, self.height_m, points, part)


@dataclass(frozen=True)
class Folds:
    """Soft creases: displaced geometry, and the shade they cast baked into the cloth."""

    depth_m: float
    along_m: float
    """Grain along the axis."""
    around_m: float
    seed: int
    px_per_m: float = PX_PER_M
    """Texels of the sheet's chart."""

    def height(self, canvas: Canvas) -> Float[np.ndarray, "height width"]:
        """Displacement on the canvas, metres, periodic from the right edge to the left one."""
        rng = np.random.default_rng(self.seed)
        field = canvas.noise(rng, self.around_m, self.along_m)
        field = field + 0.4 * canvas.noise(rng, self.around_m / 2, self.along_m / 2)
        share = np.clip((np.linspace(0, 1, field.shape[1]) - 0.85) / 0.15, 0, 1)
        return self.depth_m * (field + share * (field[:, :1] - field))

    def shade(self, canvas: Canvas) -> Float[np.ndarray, "height width"]:
        """Factor on the colour: slopes that face down are darker."""
        slope = np.gradient(self.height(canvas), axis=0) * canvas.px_per_m
        return np.clip(1 + 0.8 * slope, 0.65, 1.2)


BARE = Folds(0.0, 0.1, 0.1, 0, 220.0)
"""Skin: smooth, and with little to show."""


def azimuths(columns: int, gap: float = 0.0, aspect: float = 0.62) -> Azimuths:
    """Azimuths from the back round the front to the back, about evenly spaced on an ellipse; `gap` opens the front.

    With a gap they run from the front's left edge round the back to its right edge instead.
    """
    dense = np.linspace(-np.pi, np.pi, 1025) if gap == 0 else np.linspace(gap, 2 * np.pi - gap, 1025)
    r = 1 / np.hypot(np.sin(dense), np.cos(dense) / aspect)
    steps = np.hypot(np.diff(r * np.sin(dense)), np.diff(r * np.cos(dense)))
    arc = np.concatenate([[0], np.cumsum(steps)])
    return np.interp(np.linspace(0, arc[-1], columns), arc, dense)


def _paint(canvas: Canvas, painter: Painter, folds: Folds) -> Image:
    return np.clip(painter(canvas) * folds.shade(canvas)[..., None], 0, 1)


def _crease(canvas: Canvas, folds: Folds, uv: Float[np.ndarray, "row column 2"]) -> Float[np.ndarray, "row column"]:
    height = folds.height(canvas).astype(np.float32)
    rows, columns = height.shape
    x, y = uv[..., 0] * (columns - 1), (1 - uv[..., 1]) * (rows - 1)
    return cv2.remap(height, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR).astype(np.float64)


def _with_lips(grid: np.ndarray, low: np.ndarray | None, high: np.ndarray | None) -> np.ndarray:
    rows = (None if low is None else low[None], grid, None if high is None else high[None])
    return np.concatenate([row for row in rows if row is not None])


def torso_sheet(
    wearer: Wearer,
    shape: Body,
    low: Azimuths,
    high: Azimuths,
    around: Azimuths,
    painter: Painter,
    folds: Folds = BARE,
    rows: int = 44,
) -> Patch:
    """The torso of `shape` between the heights `low` and `high` (metres, per azimuth), with lips turned inwards."""
    torso = shape.torso
    arc = torso.arc
    s_low, s_high = np.interp(low, torso.y, arc), np.interp(high, torso.y, arc)
    s = s_low + np.linspace(0, 1, rows)[:, None] * (s_high - s_low)
    y = np.interp(s, arc, torso.y)
    theta = np.broadcast_to(around, s.shape)
    bottom, top = float(s_low.min()), float(s_high.max())
    middle = float(np.interp((bottom + top) / 2, arc, torso.y))
    ring = torso.point(around, np.full_like(around, middle))
    girth = float(np.linalg.norm(np.diff(ring, axis=0), axis=1).sum())
    canvas = Canvas(girth, top - bottom, folds.px_per_m)
    uv = np.stack([np.broadcast_to(np.linspace(0, 1, len(around)), s.shape), (s - bottom) / (top - bottom)], -1)
    outward = outward_of(theta)
    points = shape.settle(torso.point(theta, y), outward, 0)
    points = points + _crease(canvas, folds, uv)[..., None] * outward
    lips = []
    for row in (0, -1):
        inner = wearer.body.torso.point(around, y[row])
        axis = inner * np.array([0, 1, 0]) + np.array([0, 0, 1]) * np.interp(y[row], torso.y, torso.z)[:, None]
        lips.append(axis + 0.93 * (inner - axis) + np.array([0, 0.004 if row == 0 else -0.012, 0]))
    points = _with_lips(points, lips[0], lips[1])
    uv = _with_lips(uv, uv[0], uv[-1])
    closed = bool(np.isclose(around[-1] - around[0], 2 * np.pi))
    return Patch(points, uv, wearer.weights(points), _paint(canvas, painter, folds), closed=closed)


def limb_sheet(
    wearer: Wearer,
    shape: Body,
    part: int,
    low: float,
    high: float,
    painter: Painter,
    folds: Folds = BARE,
    grid: tuple[int, int] = (36, 29),
) -> Patch:
    """A limb of `shape` (part 1..4 of `Body.parts`) from t = `low` (towards the body) to `high`, with a lip there.

    `grid` counts its rows and columns.
    """
    rows, columns = grid
    limb, naked = (s.limbs[part - 1] for s in (shape, wearer.body))
    theta = np.linspace(-np.pi, np.pi, columns)
    t = np.broadcast_to(np.linspace(high, low, rows)[:, None], (rows, columns))
    around = np.broadcast_to(theta, t.shape)
    radius = float(np.interp((low + high) / 2, limb.t, limb.r))
    canvas = Canvas(2 * np.pi * radius, (high - low) * limb.length, folds.px_per_m)
    uv = np.stack([np.broadcast_to(np.linspace(0, 1, columns), t.shape), (high - t) / (high - low)], -1)
    on_limb = limb.point(around, t)
    outward = (on_limb - limb.center(t)) / np.interp(t, limb.t, limb.r)[..., None]
    # A joint's first seam: the torso's sheet lies over the limb's.
    points = shape.settle(on_limb, outward, part) + _crease(canvas, folds, uv)[..., None] * outward
    center = naked.center(t[0])
    lip = center + 0.8 * (naked.point(theta, t[0]) - center) + 0.004 * limb.frame[1]
    points = _with_lips(points, lip, None)
    return Patch(points, _with_lips(uv, uv[0], None), wearer.weights(points, part), _paint(canvas, painter, folds))


def skirt_weights(wearer: Wearer, points: Points, around: Values) -> Weights:
    """Weights of a skirt's points: the waist, then its hanging columns, high and low, each between two neighbours."""
    shape = points.shape[:-1]
    column = (around / (2 * np.pi) * SKIRT_COLUMNS) % SKIRT_COLUMNS
    first = np.floor(column).astype(int) % SKIRT_COLUMNS
    share = column - np.floor(column)
    weights = {}
    for segment in ("high", "low"):
        dense = np.zeros((*shape, len(INDEX)))
        index = np.array([INDEX[f"skirt{c}_{segment}"] for c in range(SKIRT_COLUMNS)])
        np.put_along_axis(dense, index[first][..., None], (1 - share)[..., None], -1)
        np.put_along_axis(dense, index[(first + 1) % SKIRT_COLUMNS][..., None], share[..., None], -1)
        weights[segment] = dense
    y = points[..., 1]
    hip, knee = (float(wearer.skeleton.at(name)[1]) for name in ("skirt0_high", "skirt0_low"))
    soft = 0.03 * wearer.height_m
    hanging = mix(weights["low"], weights["high"], smoothstep(y, knee - soft, knee + soft))
    return mix(hanging, one_joint(shape, "pelvis"), smoothstep(y, hip - soft, hip + soft))


def skirt_sheets(
    wearer: Wearer,
    shape: Body,
    waist_y: float,
    hem_y: float,
    around: Azimuths,
    painter: Painter,
    flare: float,
    pleats: tuple[int, float],
) -> list[Patch]:
    """A skirt, outside and inside. It follows the hips, then widens by `flare` metres per metre; pleats (count, m)."""
    rows = 34
    y = np.broadcast_to(np.linspace(hem_y, waist_y, rows)[:, None], (rows, len(around)))
    theta = np.broadcast_to(around, y.shape)
    hip_y = float(wearer.skeleton.at("left_thigh")[1])
    held = np.maximum(y, hip_y)
    points = shape.torso.point(theta, held)
    fall = hip_y - np.minimum(y, hip_y)
    outward = outward_of(theta)
    wide = flare * fall + pleats[1] * (fall / max(hip_y - hem_y, 0.05)) * np.cos(pleats[0] * theta)
    points = points + wide[..., None] * outward
    points[..., 1] = y
    ring = points[rows // 3]
    canvas = Canvas(float(np.linalg.norm(np.diff(ring, axis=0), axis=1).sum()), waist_y - hem_y)
    u = np.broadcast_to(np.linspace(0, 1, len(around)), y.shape)
    uv = np.stack([u, (y - hem_y) / (waist_y - hem_y)], -1)
    turn = np.interp(np.linspace(0, 1, canvas.shape[1]), u[0], around)
    shade = 1 + 8 * pleats[1] * np.cos(pleats[0] * turn) * (1 - canvas.y / canvas.height_m)
    chart = np.clip(painter(canvas) * np.clip(shade, 0.65, 1.15)[..., None], 0, 1)
    weights = skirt_weights(wearer, points, theta)
    closed = bool(np.isclose(around[-1] - around[0], 2 * np.pi))
    return two_sided(Patch(points, uv, weights, chart, closed=closed), points - 0.005 * outward, 0.45)
