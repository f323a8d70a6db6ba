"""Makes garments from the body's own shape, and paints them with cloth."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.body import (
    Body,
    Torso,
    body_weights,
    hand_patches,
    mix,
    one_joint,
    smoothstep,
)
from viewmend.studio.procedural.fabric import (
    QUIET,
    WORDS,
    Canvas,
    Fabric,
    Image,
    Patch,
    blend,
    edge,
    hsv,
    outward_of,
    sample_fabric,
    two_sided,
    write,
)
from viewmend.studio.procedural.folds import Folds, Painter
from viewmend.studio.procedural.skeleton import INDEX, SIDES, SKIRT_COLUMNS, Physique, Points, Values, Weights

Azimuths = Float[np.ndarray, "column"]
TOPS = ("t-shirt", "long sleeves", "shirt", "sweater", "tank top")
"""Kinds of tops."""
OUTERS = ("none", "jacket", "coat")
"""Kinds of clothes over the top."""
BOTTOMS = ("trousers", "jeans", "wide trousers", "leggings", "shorts", "skirt", "dress")
"""Kinds of clothes below the waist."""
LOOSE = ("plain", "heather", "denim", "tartan", "gingham", "knit", "pinstripes")
"""Patterns of fabrics of jackets and coats."""
LOWER = ("plain", "heather", "pinstripes", "tartan", "blobs", "knit", "zigzag", "gingham")
"""Patterns of clothes below the waist."""
BARE = Folds(depth_m=0.0, along_m=0.1, around_m=0.1, seed=0, px_per_m=220.0)
"""Skin, which is smooth and has little texture."""


def azimuths(columns: int, gap: float = 0.0) -> Azimuths:
    """Make azimuths from back to back, about evenly spaced on an ellipse.

    A gap begins at the front's left edge.
    """
    dense = np.linspace(-np.pi, np.pi, 1025) if gap == 0 else np.linspace(gap, 2 * np.pi - gap, 1025)
    r = 1 / np.hypot(np.sin(dense), np.cos(dense) / 0.62)
    steps = np.hypot(np.diff(r * np.sin(dense)), np.diff(r * np.cos(dense)))
    arc = np.concatenate([[0], np.cumsum(steps)])
    return np.interp(np.linspace(0, arc[-1], columns), arc, dense)


def _is_closed(around: Azimuths) -> bool:
    return bool(np.isclose(around[-1] - around[0], 2 * np.pi))


def torso_sheet(
    body: Body,
    shape: Body,
    low: Azimuths,
    high: Azimuths,
    around: Azimuths,
    painter: Painter,
    folds: Folds = BARE,
    rows: int = 44,
) -> Patch:
    """Make a sheet of the torso between two heights (metres, per azimuth), with edges turned inwards."""
    torso = shape.torso
    arc = shape.torso.arc
    s_low, s_high = (np.interp(edge, torso.y, arc) for edge in (low, high))
    s = s_low + np.linspace(0, 1, rows)[:, None] * (s_high - s_low)
    y = np.interp(s, arc, torso.y)
    theta = np.broadcast_to(around, s.shape)
    bottom = float(s_low.min())
    top = float(s_high.max())
    middle = float(np.interp((bottom + top) / 2, arc, torso.y))
    ring = torso.point(around, np.full_like(around, middle))
    girth = float(np.linalg.norm(np.diff(ring, axis=0), axis=1).sum())
    canvas = Canvas(girth, top - bottom, folds.px_per_m)
    uv = np.stack(
        [np.broadcast_to(np.linspace(0, 1, len(around)), s.shape), (s - bottom) / (top - bottom)], -1
    )
    outward = outward_of(theta)
    points = shape.settle(torso.point(theta, y), outward, 0)
    points = points + folds.crease(canvas, uv)[..., None] * outward
    low_edge = _inner_edge(body.torso, torso, around, y[0], 0.004)
    high_edge = _inner_edge(body.torso, torso, around, y[-1], -0.012)
    points = np.concatenate([low_edge[None], points, high_edge[None]])
    uv = np.concatenate([uv[:1], uv, uv[-1:]])
    return Patch(
        points, uv, body_weights(body, points), folds.paint(canvas, painter), closed=_is_closed(around)
    )


def _inner_edge(body: Torso, cloth: Torso, around: Azimuths, y: Azimuths, rise_m: float) -> Points:
    """Points just inside the body, at which an edge of cloth ends; `rise_m` moves them along the torso."""
    inner = body.point(around, y)
    axis = inner * np.array([0, 1, 0]) + np.array([0, 0, 1]) * np.interp(y, cloth.y, cloth.z)[:, None]
    return axis + 0.93 * (inner - axis) + np.array([0, rise_m, 0])


def limb_sheet(
    body: Body,
    shape: Body,
    part: int,
    low: float,
    high: float,
    painter: Painter,
    folds: Folds = BARE,
    grid: tuple[int, int] = (36, 29),
) -> Patch:
    """Make a sheet of a limb from t = `low`, near the body, to `high`, with an edge there.

    `part` is 1 to 4, as in `Body.fields`.
    """
    rows, columns = grid
    limb, naked = (s.limbs[part - 1] for s in (shape, body))
    theta = np.linspace(-np.pi, np.pi, columns)
    t = np.broadcast_to(np.linspace(high, low, rows)[:, None], (rows, columns))
    around = np.broadcast_to(theta, t.shape)
    radius = float(np.interp((low + high) / 2, limb.t, limb.r))
    canvas = Canvas(2 * np.pi * radius, (high - low) * limb.length, folds.px_per_m)
    uv = np.stack([np.broadcast_to(np.linspace(0, 1, columns), t.shape), (high - t) / (high - low)], -1)
    on_limb = limb.point(around, t)
    outward = (on_limb - limb.center(t)) / np.interp(t, limb.t, limb.r)[..., None]
    # A joint's first seam: the torso's sheet lies over the limb's.
    points = shape.settle(on_limb, outward, part) + folds.crease(canvas, uv)[..., None] * outward
    center = naked.center(t[0])
    lip = center + 0.8 * (naked.point(theta, t[0]) - center) + 0.004 * limb.frame[1]
    points = np.concatenate([lip[None], points])
    uv = np.concatenate([uv[:1], uv])
    return Patch(points, uv, body_weights(body, points, part), folds.paint(canvas, painter))


def skirt_weights(body: Body, points: Points, around: Values) -> Weights:
    """Weights of a skirt's points: the waist, and its upper and lower columns."""
    shape = points.shape[:-1]
    column = (around / (2 * np.pi) * SKIRT_COLUMNS) % SKIRT_COLUMNS
    first = np.floor(column).astype(int) % SKIRT_COLUMNS
    share = column - np.floor(column)
    y = points[..., 1]
    soft = 0.03 * body.height_m
    sheets = []
    steps = []
    for segment in ("low", "high"):
        dense = np.zeros((*shape, len(INDEX)))
        index = np.array([INDEX[f"skirt{c}_{segment}"] for c in range(SKIRT_COLUMNS)])
        np.put_along_axis(dense, index[first][..., None], (1 - share)[..., None], -1)
        np.put_along_axis(dense, index[(first + 1) % SKIRT_COLUMNS][..., None], share[..., None], -1)
        sheets.append(dense)
        top = float(body.skeleton.at(f"skirt0_{segment}")[1])
        steps.append(smoothstep(y, top - soft, top + soft))
    return mix(mix(sheets[0], sheets[1], steps[0]), one_joint(shape, "pelvis"), steps[1])


def skirt_sheets(
    body: Body,
    shape: Body,
    waist_y: float,
    hem_y: float,
    around: Azimuths,
    painter: Painter,
    flare: float,
    pleats: tuple[int, float],
) -> list[Patch]:
    """Make the outside and inside of a skirt: it follows the hips, then widens by `flare` metres per metre.

    `pleats` are their number and depth in metres.
    """
    rows = 34
    y = np.broadcast_to(np.linspace(hem_y, waist_y, rows)[:, None], (rows, len(around)))
    theta = np.broadcast_to(around, y.shape)
    hip_y = float(body.skeleton.at("left_thigh")[1])
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
    weights = skirt_weights(body, points, theta)
    sheet = Patch(points, uv, weights, chart, closed=_is_closed(around))
    return two_sided(sheet, points - 0.005 * outward, 0.45)


@dataclass(frozen=True)
class Outfit:
    """A top, clothes for the legs, perhaps a jacket or coat, and shoes."""

    top: str
    bottom: str
    outer: str
    fabrics: tuple[Fabric, Fabric, Fabric]
    """Fabrics of top, bottom and outer."""
    lettering: str
    """Text across the chest; empty for none."""
    shoes: Float[np.ndarray, "2 3"]
    """Upper and sole, sRGB."""
    seed: int

    @property
    def words(self) -> str:
        """The outfit as text."""
        lower = "" if self.bottom == "dress" else f" and {self.fabrics[1].kind} {self.bottom}"
        upper = "dress" if self.bottom == "dress" else self.top
        outer = "" if self.outer == "none" else f" under a {self.outer}"
        return f"{self.fabrics[0].kind} {upper}{lower}{outer}"


def sample_outfit(rng: np.random.Generator, femininity: float) -> Outfit:
    """Sample an outfit."""
    odds = (
        [0.26, 0.22, 0.12, 0.08, 0.12, 0.11, 0.09]
        if femininity > 0.5
        else [0.32, 0.34, 0.1, 0.02, 0.22, 0, 0]
    )
    bottom = BOTTOMS[int(rng.choice(len(BOTTOMS), p=np.array(odds) / sum(odds)))]
    top = TOPS[int(rng.choice(len(TOPS), p=[0.32, 0.2, 0.2, 0.2, 0.08]))]
    outer = OUTERS[int(rng.choice(3, p=[0.72, 0.16, 0.12]))]
    if outer == "coat" and bottom in ("skirt", "dress"):
        outer = "jacket"  # a wide skirt has no room under a coat
    lower = sample_fabric(rng, ("denim",) if bottom == "jeans" else LOWER)
    fabrics = (sample_fabric(rng), lower, sample_fabric(rng, LOOSE))
    written = bottom != "dress" and outer == "none" and fabrics[0].kind in QUIET and rng.random() < 0.6
    lettering = WORDS[int(rng.integers(len(WORDS)))] if written else ""
    sole = np.full(3, 0.9 if rng.random() < 0.5 else 0.12)
    upper = hsv(rng.random(), rng.uniform(0, 0.7) * (rng.random() < 0.5), rng.uniform(0.1, 0.95))
    return Outfit(top, bottom, outer, fabrics, lettering, np.stack([upper, sole]), int(rng.integers(2**31)))


@dataclass(frozen=True)
class Cut:
    """The measures of an outfit.

    Ease is in metres, hems are fractions of the height, sleeves fractions of the limb.
    """

    loose_m: float
    hang: float
    sleeve: float
    top_hem: float
    neck: float
    vee: bool
    ease_m: float
    leg: float
    cuff: float
    """Position along the arm from which skin shows: the end of the longest sleeve."""
    leg_hang: float
    leg_flare_m: float


def sample_cut(outfit: Outfit) -> Cut:
    """Sample measures that suit these garments."""
    rng = np.random.default_rng(outfit.seed)
    loose = {"sweater": 0.014, "shirt": 0.010, "t-shirt": 0.009}.get(outfit.top, 0.004) + 0.006 * rng.random()
    sleeve = {"t-shirt": rng.uniform(0.2, 0.42), "tank top": 0.0}.get(outfit.top, rng.uniform(0.94, 1.0))
    if outfit.top == "shirt" and outfit.outer == "none" and rng.random() < 0.3:
        sleeve = rng.uniform(0.5, 0.6)
    kind = outfit.bottom
    tucked = kind == "dress" or (kind in ("trousers", "skirt") and rng.random() < 0.6)
    end = {"shorts": rng.uniform(0.32, 0.5), "skirt": 0.0, "dress": 0.0}.get(kind, rng.uniform(0.95, 1.03))
    flares: dict[str, float] = {"wide trousers": 0.02, "shorts": 0.004}
    eases: dict[str, float] = {"leggings": 0.002, "wide trousers": 0.010, "shorts": 0.011}
    hangs: dict[str, float] = {"leggings": 2.0, "wide trousers": 0.3, "shorts": 0.2}
    return Cut(
        loose_m=float(loose),
        hang=0.2 if outfit.top == "tank top" or kind == "dress" else float(rng.uniform(0.3, 0.9)),
        sleeve=float(sleeve),
        top_hem=0.598 if tucked else float(rng.uniform(0.49, 0.56)),
        neck=float(rng.uniform(0.0, 0.012) if outfit.top == "sweater" else rng.uniform(0.008, 0.045)),
        vee=bool(rng.random() < 0.35),
        ease_m=eases[kind] if kind in eases else float(rng.uniform(0.006, 0.011)),
        leg=float(end),
        cuff=float(sleeve if outfit.outer == "none" else max(sleeve, 0.97)),
        leg_hang=hangs[kind] if kind in hangs else float(rng.choice([0.5, 0.35, 0.72])),
        leg_flare_m=flares[kind] if kind in flares else float(rng.uniform(-0.012, 0.004)),
    )


def neckline(
    around: Azimuths, height_m: float, depth: float, vee: bool = False, wide: float = 0.0
) -> Azimuths:
    """Heights of a neckline in metres, round or V-shaped, lower in front by `depth` (of the height)."""
    turn = np.abs(np.angle(np.exp(1j * around)))
    dip = np.clip(1 - turn / 0.75, 0, 1) if vee else np.exp(-((turn / 0.85) ** 2))
    return (0.836 - wide - depth * dip) * height_m


@dataclass(frozen=True)
class Tailor:
    """Cuts garments for one body."""

    body: Body
    outfit: Outfit
    cut: Cut

    def folds(self, depth_m: float, along_m: float, around_m: float, number: int) -> Folds:
        """Creases with their own seed."""
        return Folds(depth_m, along_m, around_m, self.outfit.seed % 100_000 + 17 * number)

    def lower_shape(self) -> Body:
        """The body with trousers, leggings, shorts or a skirt."""
        body = self.body
        cut = self.cut
        legs = tuple(leg.loosen(cut.ease_m, cut.leg_hang, cut.leg_flare_m) for leg in body.legs)
        return replace(body, torso=body.torso.loosen(min(cut.ease_m, 0.006) - 0.001), legs=legs)

    def _trunk(self, under: Torso) -> Torso:
        """The trunk with the top, over what is tucked into it."""
        return self.body.torso.loosen(self.cut.loose_m, self.cut.hang, 0.004).widen_around(under, 0.005)

    def top(self) -> list[Patch]:
        """Make the top: trunk and sleeves."""
        H = self.body.height_m
        outfit = self.outfit
        body = self.body
        cut = self.cut
        lower = self.lower_shape()
        hang, flare = (0.10, 0.012) if cut.sleeve < 0.7 else (0.62, -0.006)
        arms = tuple(arm.loosen(cut.loose_m + 0.003, hang, flare) for arm in body.arms)
        legs = tuple(leg.loosen(0.004) for leg in lower.legs)
        shape = replace(body, torso=self._trunk(lower.torso), arms=arms, legs=legs)
        around = azimuths(65)
        high = neckline(around, H, cut.neck, cut.vee, 0.008 if outfit.top == "tank top" else 0.0)
        low = np.full_like(around, cut.top_hem * H)
        trunk = torso_sheet(
            self.body, shape, low, high, around, self._paint_top, self.folds(0.0022, 0.10, 0.16, 0), 40
        )
        start = -0.03 if outfit.outer == "none" else 0.8
        if outfit.outer != "none":
            # Only what an open front and the hems show: the rest could but poke through.
            shown = np.broadcast_to(np.abs(around) < 0.9, trunk.points.shape[:2]).copy()
            shown[:6] = shown[-5:] = True
            trunk = replace(trunk, keep=shown)
        if cut.sleeve <= max(start, 0.05):
            return [trunk]
        folds = self.folds(0.0022, 0.06, 0.12, 1)
        rows = 20 if cut.sleeve < 0.7 or start > 0 else 40
        sleeve = (start, cut.sleeve, self._paint_sleeve, folds, (rows, 25))
        return [trunk, *(limb_sheet(self.body, shape, arm, *sleeve) for arm in (1, 2))]

    def _paint_top(self, canvas: Canvas) -> Image:
        outfit = self.outfit
        image = outfit.fabrics[0].paint(canvas)
        second = outfit.fabrics[0].colors[1]
        y = canvas.y
        image = blend(image, 0.7 * image, edge(0.0015 - np.abs(y - 0.022), canvas))
        if outfit.top == "shirt":
            image = blend(image, 0.75 * image, edge(0.0015 - np.abs(np.abs(canvas.x) - 0.016), canvas))
            button = np.hypot(canvas.x, (y % 0.085) - 0.04)
            image = blend(image, 0.4 * second + 0.5, edge(0.006 - button, canvas))
        if outfit.lettering:
            image = write(image, canvas, outfit.lettering, second, (0.0, 0.62 * canvas.height_m), 0.24)
        return image

    def _paint_sleeve(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[0].paint(canvas)
        return blend(image, 0.7 * image, edge(0.0015 - np.abs(canvas.y - 0.02), canvas))

    def bottom(self) -> list[Patch]:
        """Make trousers, shorts or a skirt."""
        H = self.body.height_m
        cut = self.cut
        kind = self.outfit.bottom
        if kind in ("skirt", "dress"):
            return self._skirt()
        shape = self.lower_shape()
        around = azimuths(65)
        # Under a hanging shirt the waistband is nowhere to be seen, and nothing can poke through.
        waist = 0.602 if cut.top_hem > 0.58 else cut.top_hem + 0.035
        folds = self.folds(0.0 if kind == "leggings" else 0.0020, 0.08, 0.12, 2)
        low, high = (np.full_like(around, share * H) for share in (0.470, waist))
        waistband = torso_sheet(self.body, shape, low, high, around, self._paint_waist, folds, 26)
        leg = (-0.02, cut.leg, self._paint_leg, folds, (24 if kind == "shorts" else 44, 29))
        return [waistband, *(limb_sheet(self.body, shape, part, *leg) for part in (3, 4))]

    def _paint_waist(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[1].paint(canvas)
        top = canvas.height_m - canvas.y
        image = blend(image, 0.65 * image, edge(0.0015 - np.abs(top - 0.036), canvas))
        if self.outfit.seed % 3 == 0:
            leather = 0.4 * self.outfit.shoes[0] + np.array([0.06, 0.04, 0.03])
            image = blend(image, leather, edge(0.034 - top, canvas))
            buckle = 0.018 - np.maximum(np.abs(canvas.x), np.abs(top - 0.018))
            image = blend(image, np.array([0.75, 0.7, 0.5]), edge(buckle, canvas))
        pocket = np.abs(np.abs(canvas.x) - 0.10 - 0.35 * (top - 0.04))
        inside = edge(top - 0.036, canvas) * edge(0.15 - top, canvas)
        image = blend(image, 0.6 * image, inside * edge(0.0018 - pocket, canvas))
        fly = edge(0.0014 - np.abs(canvas.x), canvas) * edge(top - 0.036, canvas)
        return blend(image, 0.6 * image, fly * edge(0.17 - top, canvas))

    def _paint_leg(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[1].paint(canvas)
        # Seams run down the outer and inner side; jeans have bright stitches there.
        seam = np.abs(np.abs(canvas.x) - canvas.width_m / 4)
        image = blend(image, 0.72 * image, edge(0.0016 - seam, canvas))
        return blend(image, 0.75 * image, edge(0.0014 - np.abs(canvas.y - 0.025), canvas))

    def _skirt(self) -> list[Patch]:
        H = self.body.height_m
        outfit = self.outfit
        body = self.body
        rng = np.random.default_rng(outfit.seed + 1)
        fabric = outfit.fabrics[0 if outfit.bottom == "dress" else 1]
        hem = float(rng.uniform(0.17, 0.36))
        flare = float(rng.uniform(0.14, 0.42))
        pleats = (int(rng.integers(7, 15)), float(rng.uniform(0.002, 0.014)))
        shape = replace(body, torso=body.torso.loosen(0.014))
        waist = 0.606 if self.cut.top_hem > 0.58 else self.cut.top_hem + 0.02
        return skirt_sheets(self.body, shape, waist * H, hem * H, azimuths(97), fabric.paint, flare, pleats)

    def outer(self) -> list[Patch]:
        """Make a jacket or coat, open in front."""
        H = self.body.height_m
        outfit = self.outfit
        body = self.body
        if outfit.outer == "none":
            return []
        rng = np.random.default_rng(outfit.seed + 2)
        ease = float(rng.uniform(0.026, 0.034))
        torso = body.torso.loosen(ease, float(rng.uniform(0.5, 0.9)))
        torso = torso.widen_around(self._trunk(self.lower_shape().torso), 0.012)
        shape = replace(
            body, torso=torso, arms=tuple(arm.loosen(ease - 0.004, 0.55, -0.004) for arm in body.arms)
        )
        around = azimuths(65, float(rng.uniform(0.12, 0.4)))
        coat = outfit.outer == "coat"
        cloth = outfit.fabrics[2].paint
        hem = 0.535 if coat else float(rng.uniform(0.50, 0.55))
        low = np.full_like(around, hem * H)
        high = neckline(around, H, 0.05, vee=True)
        folds = self.folds(0.0025, 0.09, 0.14, 5)
        trunk = torso_sheet(self.body, shape, low, high, around, self._paint_outer, folds)
        sleeves = [limb_sheet(self.body, shape, part, -0.03, 0.97, cloth, folds) for part in (1, 2)]
        patches = [trunk, lining(trunk), *sleeves]
        if coat:
            skirt_hem = float(rng.uniform(0.2, 0.38)) * H
            patches += skirt_sheets(self.body, shape, 0.575 * H, skirt_hem, around, cloth, 0.16, (6, 0.003))
        return patches

    def _paint_outer(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[2].paint(canvas)
        # The chart of an open garment begins and ends at the front's edges.
        front = canvas.width_m / 2 - np.abs(canvas.x)
        return blend(image, 0.6 * image, edge(0.002 - np.abs(front - 0.03), canvas))

    def skin(self, person: Physique, rng: np.random.Generator) -> list[Patch]:
        """Make the bare skin: neck, shoulders, arms, legs and hands; covered parts stay inside the cloth."""
        H = person.height_m
        body = self.body
        cut = self.cut

        def paint(canvas: Canvas) -> Image:
            tone = 1 + 0.015 * canvas.noise(rng, 0.03, 0.03) + 0.012 * canvas.noise(rng, 0.004, 0.004)
            return np.clip(np.array(person.skin_rgb) * tone[..., None], 0, 1)

        around = azimuths(49)
        low = np.full_like(around, 0.73 * H)
        high = np.full_like(around, 0.893 * H)
        patches = [torso_sheet(body, body, low, high, around, paint, rows=24)]
        # Cloth covers what lies further in than a hand's breadth from its hem.
        arm = max(cut.cuff - 0.15, -0.03)
        leg = max(cut.leg - 0.12, 0.0)
        grids = (8 + int(24 * (1 - arm)), 21), (8 + int(28 * (1 - leg)), 25)
        for i in (0, 1):
            patches.append(limb_sheet(body, body, 1 + i, arm, 1.0, paint, grid=grids[0]))
            patches.append(limb_sheet(body, body, 3 + i, leg, 1.04, paint, grid=grids[1]))
        skin = paint(Canvas(0.1, 0.1))
        girth = 1.05 - 0.13 * person.femininity + 0.05 * person.weight
        for side in SIDES:
            patches += hand_patches(body, side, skin, girth)
        return patches


def lining(sheet: Patch) -> Patch:
    """Make the inside of an open sheet near its front edges: a dark copy a few millimetres within."""
    inside = sheet.points[:, ::-1].copy()
    center = inside.mean(1, keepdims=True)
    inside = center + 0.975 * (inside - center)
    column = np.arange(inside.shape[1])
    keep = np.broadcast_to(np.minimum(column, column[::-1]) < 7, inside.shape[:2])
    dark = np.broadcast_to(0.45 * sheet.chart.mean((0, 1)), (8, 8, 3))
    return Patch(inside, sheet.uv[:, ::-1], sheet.weights[:, ::-1], dark, keep, closed=False)
