"""Models the body: a torso and four limbs as surfaces around their axes, joined by a smooth union of fields.

Each part is both a parametric surface (angle around the axis, place along it), which gives texture
coordinates, and a field (signed distance, first order), which gives the union and the skinning
weights. A garment is a bigger body.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.fabric import Image, Patch
from viewmend.studio.procedural.skeleton import (
    ARM,
    INDEX,
    JOINTS,
    LEG,
    SIDES,
    SIGN,
    SPINE,
    TABLES,
    Physique,
    Points,
    Rotation,
    Skeleton,
    Values,
    Vector,
    Weights,
    leg_stretch,
    unit,
)

TORSO, ARM_PROFILE, LEG_PROFILE = (np.array(TABLES[name]) for name in ("torso", "arm", "leg"))


RADII = ("width", "front", "back")
"""The fields of `Torso` that are distances from its axis."""


def smooth_table(xs: Float[np.ndarray, "knot"], table: Float[np.ndarray, "knot column"]):
    """Resample knots evenly and smooth them; returns positions [sample] and values [sample column]."""
    grid = np.linspace(xs[0], xs[-1], 256)
    values = np.stack([np.interp(grid, xs, column) for column in table.T], axis=1)
    for _ in range(2):
        padded = np.pad(values, ((4, 4), (0, 0)), mode="edge")
        values = np.stack([padded[i : i + len(grid)] for i in range(9)]).mean(0)
    return grid, values


@dataclass(frozen=True)
class Torso:
    """Trunk and neck around a vertical, slightly curved axis. All metres, heights in world coordinates."""

    y: Float[np.ndarray, "sample"]
    width: Float[np.ndarray, "sample"]
    front: Float[np.ndarray, "sample"]
    back: Float[np.ndarray, "sample"]
    z: Float[np.ndarray, "sample"]
    bumps: Float[np.ndarray, "bump 5"]
    """Bust and buttocks: azimuth, height, width in radians, height in metres, and thickness."""

    @property
    def arc(self) -> Float[np.ndarray, "sample"]:
        """Length along the side's outline from the lowest ring, metres; even steps of it make even rows."""
        steps = np.hypot(np.diff(self.y), np.diff(self.width))
        return np.concatenate([[0.0], np.cumsum(steps)])

    def radius(self, azimuth: Values, y: Values) -> Values:
        """Distance of the surface from the axis; azimuth 0 is the front, a quarter turn the left."""
        a, f, b = (np.interp(y, self.y, table) for table in (self.width, self.front, self.back))
        sine = np.abs(np.sin(azimuth))
        cosine = np.cos(azimuth)
        depth = np.where(cosine > 0, f, b)
        r = ((sine / a) ** 2.4 + (np.abs(cosine) / depth) ** 2.4) ** (-1 / 2.4)
        for place, height, spread, tall, swell in self.bumps:
            turn = np.angle(np.exp(1j * (azimuth - place)))
            drop = np.where(y > height, 1.5 * tall, tall)
            r = r + swell * np.exp(-((turn / spread) ** 2) - ((y - height) / drop) ** 2)
        return r

    def point(self, azimuth: Values, y: Values) -> Points:
        """The surface at this azimuth and height."""
        r = self.radius(azimuth, y)
        return np.stack([r * np.sin(azimuth), y, r * np.cos(azimuth) + np.interp(y, self.y, self.z)], -1)

    def field(self, points: Points) -> Values:
        """Distance to the surface to first order, negative inside."""
        x = points[..., 0]
        y = points[..., 1]
        z = points[..., 2] - np.interp(y, self.y, self.z)
        clamped = np.clip(y, self.y[0], self.y[-1])
        slope = np.interp(y, self.y, np.gradient(self.width, self.y))
        radial = (np.hypot(x, z) - self.radius(np.arctan2(x, z), clamped)) / np.hypot(1.0, slope)
        return np.maximum(radial, np.abs(y - clamped)) + np.where(radial > 0, 0.3 * np.abs(y - clamped), 0.0)

    def widen_around(self, other: "Torso", gap_m: float) -> "Torso":
        """Widen this torso to keep a distance of at least `gap_m` from `other` (on the same samples)."""
        return replace(self, **{n: np.maximum(getattr(self, n), getattr(other, n) + gap_m) for n in RADII})

    def loosen(self, ease_m: float, hang: float = 0.0, flare: float = 0.0) -> "Torso":
        """Make the torso of a garment: `ease_m` wider; with `hang` 1, cloth hangs straight from the chest."""
        wider = {"bumps": self.bumps * np.array([1, 1, 1, 1 + 0.6 * hang, 1])}
        below = np.interp(self.y, [self.y[0], self.y[-1] * 0.8], [1.0, 0.0])
        chest = self.y < 0.84 * self.y[-1]
        for name in RADII:
            # Cloth falls straight down from where the body below the arms is widest so far.
            table = getattr(self, name)
            fallen = np.maximum.accumulate(np.where(chest, table, 0)[::-1])[::-1]
            wider[name] = np.where(chest, table + hang * (fallen - table), table) + ease_m + flare * below
        return replace(self, **wider)


@dataclass(frozen=True)
class Limb:
    """An arm or a leg: a round profile around the line from its first joint to its last. Metres."""

    start: Vector
    end: Vector
    t: Float[np.ndarray, "sample"]
    r: Float[np.ndarray, "sample"]
    shift: Float[np.ndarray, "sample"]
    """Distance of the centre line behind the axis, metres."""

    @property
    def length(self) -> float:
        """Metres from the first joint to the last."""
        return float(np.linalg.norm(self.end - self.start))

    @cached_property
    def frame(self) -> Rotation:
        """Axes as rows: sideways, up the limb, and forward."""
        up = unit(self.start - self.end)
        side = unit(np.cross(up, np.array([0.0, 0.0, 1.0])))
        return np.stack([side, up, np.cross(side, up)])

    def center(self, t: Values) -> Points:
        """The centre line at `t`."""
        axis = self.start + t[..., None] * (self.end - self.start)
        return axis - np.interp(t, self.t, self.shift)[..., None] * self.frame[2]

    def point(self, azimuth: Values, t: Values) -> Points:
        """The surface at this azimuth (0 is forward) and place along the limb."""
        around = np.sin(azimuth)[..., None] * self.frame[0] + np.cos(azimuth)[..., None] * self.frame[2]
        return self.center(t) + np.interp(t, self.t, self.r)[..., None] * around

    def along(self, points: Points) -> Values:
        """Place along the limb of the nearest point of its axis, not clamped."""
        return (self.start - points) @ self.frame[1] / self.length

    def field(self, points: Points) -> Values:
        """Distance to the surface to first order, negative inside."""
        t = np.clip(self.along(points), self.t[0], self.t[-1])
        return np.linalg.norm(points - self.center(t), axis=-1) - np.interp(t, self.t, self.r)

    def loosen(self, ease_m: float, hang_from: float = 2.0, flare: float = 0.0) -> "Limb":
        """Make a sleeve or trouser leg; beyond `hang_from` it hangs straight and widens by `flare` metres."""
        # Close at the joint, where the garment's trunk begins.
        r = self.r + ease_m * np.interp(self.t, [0.0, 0.25], [0.5, 1.0])
        hanging = self.t > hang_from
        held = float(np.interp(hang_from, self.t, r))
        far = np.clip((self.t - hang_from) / max(1 - hang_from, 1e-3), 0, 1)
        shift = np.where(hanging, np.interp(hang_from, self.t, self.shift), self.shift)
        return replace(self, r=np.where(hanging, np.maximum(r, held) + flare * far, r), shift=shift)


@dataclass(frozen=True)
class Body:
    """Torso and limbs around a skeleton; limbs are left arm, right arm, left leg, right leg."""

    torso: Torso
    arms: tuple[Limb, ...]
    legs: tuple[Limb, ...]
    skeleton: Skeleton
    height_m: float

    @property
    def limbs(self) -> tuple[Limb, ...]:
        """Arms and legs, left first."""
        return (*self.arms, *self.legs)

    def fields(self, points: Points) -> Float[np.ndarray, "part *n"]:
        """The field of each part: torso, arms, legs."""
        return np.stack([part.field(points) for part in (self.torso, *self.limbs)])

    def settle(self, points: Points, outward: Points, part: int) -> Points:
        """Move a part's surface outward onto the smooth union of all parts.

        The other parts count as 2 mm thinner: this part's sheet dives under theirs exactly where
        their fields cross, so that overlapping sheets meet in a clean seam.
        """
        bias = np.full(5, 0.002)
        bias[part] = 0.0
        bias[opposite(part)] = np.inf
        moved = np.zeros(points.shape[:-1])
        for _ in range(4):
            fields = self.fields(points + moved[..., None] * outward) + bias.reshape(-1, *[1] * moved.ndim)
            k = 0.010 * self.height_m
            union = -k * np.log(np.exp(np.clip(-fields / k, -30, 30)).sum(0))
            moved = np.clip(moved - 0.8 * union, 0.0, 2.0 * k)
        return points + moved[..., None] * outward


def opposite(part: int) -> list[int]:
    """The limb of the other side, whose cloth must not merge with this one's; none for the torso."""
    return [] if part == 0 else [part + 1 if part % 2 else part - 1]


def build_body(person: Physique, skeleton: Skeleton) -> Body:
    """Build the naked shape of a person in the bind pose; head, hands and feet are drawn elsewhere."""
    H = person.height_m
    w = person.weight
    girth = 1 + 0.10 * w + 0.10 * (person.muscle - 0.5) - 0.06 * person.femininity
    leg_girth = 1 + 0.10 * w + 0.05 * (person.muscle - 0.5) + 0.03 * person.femininity

    def pair(first: str, last: str, profile: Float[np.ndarray, "knot 3"], girth: float) -> tuple[Limb, ...]:
        t, table = smooth_table(profile[:, 0], profile[:, 1:] * np.array([girth * H, H]))
        return tuple(
            Limb(skeleton.at(f"{s}_{first}"), skeleton.at(f"{s}_{last}"), t, *table.T) for s in SIDES
        )

    arms = pair("upperarm", "hand", ARM_PROFILE, girth)
    legs = pair("thigh", "foot", LEG_PROFILE, leg_girth)
    return Body(_build_torso(person), arms, legs, skeleton, H)


def _build_torso(person: Physique) -> Torso:
    """Build the trunk and neck of a person: the mean of both sexes' profiles, with weight and muscle added."""
    H = person.height_m
    f = person.femininity
    w = person.weight
    y, a_m, a_f, d_m, d_f, back, z = TORSO.T
    belly = np.exp(-(((y - 0.605) / 0.065) ** 2)) * np.where(w > 0, 1.0, 0.35)
    trunk = np.clip((0.85 - y) / 0.05, 0, 1)
    width = (a_m + f * (a_f - a_m)) * (
        1 + trunk * (0.05 * w + 0.02 * (person.muscle - 0.5))
    ) + 0.008 * w * belly
    front = (d_m + f * (d_f - d_m)) * (1 + 0.04 * w * trunk) + 0.026 * w * belly
    rear = back * (1 + 0.05 * w * trunk) + 0.008 * w * belly
    columns = np.stack([width, front, rear, z], 1) * H
    heights, table = smooth_table(leg_stretch(y, person.leg_share) * H, columns)
    bust = (0.010 + 0.010 * f * (1 + 0.3 * w)) * f + 0.003 * (1 - f)
    bumps = [(s * 0.62, 0.722, 0.42, 0.026, bust) for s in (1, -1)]
    bumps += [(np.pi + s * 0.5, 0.51 * person.leg_share, 0.42, 0.030, 0.010 + 0.004 * f) for s in (1, -1)]
    return Torso(heights, *table.T, bumps=np.array(bumps) * np.array([1, H, 1, H, H]))


def smoothstep(x: Values, low: float, high: float) -> Values:
    """Step smoothly from 0 below `low` to 1 above `high` (low < high)."""
    s = np.clip((x - low) / (high - low), 0, 1)
    return s * s * (3 - 2 * s)


def one_joint(shape: tuple[int, ...], name: str) -> Weights:
    """Weights of points that follow this joint alone."""
    weights = np.zeros((*shape, len(JOINTS)))
    weights[..., INDEX[name]] = 1
    return weights


def mix(first: Weights, second: Weights, share: Values) -> Weights:
    """Interpolate from `first` where `share` is 0 to `second` where it is 1."""
    return first + share[..., None] * (second - first)


def body_weights(body: Body, points: Points, part: int = 0) -> Weights:
    """Compute skinning weights near the body: soft membership in a part, then soft steps along its joints.

    Points of a limb's sheet (`part`, as in `Body.fields`) never follow the limb of the other side.
    """
    fields = body.fields(points)
    fields[opposite(part)] = 1.0
    soft = 0.010 * body.height_m
    member = np.exp(np.clip(-(fields - fields.min(0)) / soft, -40, 0))
    member /= member.sum(0)
    weights = member[0][..., None] * _trunk(body.skeleton, body.height_m, points)
    for i, side in enumerate(SIDES):
        # The width is half the bend's extent as a share of the limb.
        for n, names, width in ((i, ARM[1:4], 0.10), (2 + i, LEG[:3], 0.085)):
            t = body.limbs[n].along(points)
            middle = float(body.limbs[n].along(body.skeleton.at(f"{side}_{names[1]}")[None])[0])
            first, second, third = (one_joint(points.shape[:-1], f"{side}_{name}") for name in names)
            bent = mix(first, second, smoothstep(t, middle - width, middle + width))
            weights = weights + member[1 + n][..., None] * mix(bent, third, smoothstep(t, 0.94, 1.05))
    return weights


def _trunk(skeleton: Skeleton, height_m: float, points: Points) -> Weights:
    shape = points.shape[:-1]
    weights = one_joint(shape, "pelvis")
    for name, half in zip(SPINE[1:], (0.035, 0.04, 0.04, 0.018, 0.016), strict=True):
        y = float(skeleton.at(name)[1])
        soft = half * height_m
        weights = mix(weights, one_joint(shape, name), smoothstep(points[..., 1], y - soft, y + soft))
    for side in SIDES:
        outer = float(skeleton.at(f"{side}_upperarm")[0])
        across = smoothstep(points[..., 0] / outer, 0.35, 0.95)
        high = smoothstep(points[..., 1] / height_m, 0.74, 0.80)
        weights = mix(weights, one_joint(shape, f"{side}_clavicle"), 0.8 * across * high)
    return weights


def _tube(
    tip: Vector,
    centers: Float[np.ndarray, "row 3"],
    across: Vector,
    radii: Float[np.ndarray, "2 row"],
    columns: int,
) -> Float[np.ndarray, "row+1 column 3"]:
    """Make ellipses around a line, from its far end up, after their tip; `across` is the first radius."""
    up = unit(np.gradient(centers, axis=0))
    side = unit(across - up * (across * up).sum(-1, keepdims=True))
    front = np.cross(side, up)
    phi = np.linspace(-np.pi, np.pi, columns)[None, :, None]
    first, second = radii[..., None, None]
    ring = first * np.sin(phi) * side[:, None] + second * np.cos(phi) * front[:, None]
    return np.concatenate([np.broadcast_to(tip, (1, columns, 3)), centers[:, None] + ring])


def unit_grid(shape: tuple[int, ...]) -> Float[np.ndarray, "row column 2"]:
    """Chart coordinates of a regular grid: u along the columns, v along the rows."""
    v, u = np.meshgrid(np.linspace(0, 1, shape[0]), np.linspace(0, 1, shape[1]), indexing="ij")
    return np.stack([u, v], -1)


def hand_patches(body: Body, side: str, skin: Image, girth: float) -> list[Patch]:
    """Draw one hand with slightly curled fingers; `girth` 1 is average."""
    H = body.height_m
    arm = body.arms[0 if side == "left" else 1]
    wrist = body.skeleton.at(f"{side}_hand")
    along = -arm.frame[1]
    forward = arm.frame[2]
    s = np.linspace(1, -0.12, 12)
    reach = 0.054 * H * s
    breadth = np.interp(s, [-0.12, 0.1, 0.45, 0.8, 1.0], [0.0140, 0.0160, 0.0220, 0.0235, 0.0215]) * H * girth
    thick = np.interp(s, [-0.12, 0.1, 0.5, 1.0], [0.0115, 0.0110, 0.0105, 0.0070]) * H * girth
    centers = wrist + reach[:, None] * along
    grid = _tube(centers[0] + 0.006 * along, centers, forward, np.stack([breadth, thick]), 17)
    before, behind = (one_joint(grid.shape[:2], f"{side}_{name}") for name in ("forearm", "hand"))
    weights = mix(before, behind, smoothstep(arm.along(grid), 0.96, 1.03))
    return [Patch(grid, unit_grid(grid.shape), weights, skin), *_finger_patches(body, side, skin, girth)]


def _finger_patches(body: Body, side: str, skin: Image, girth: float) -> list[Patch]:
    """Draw four fingers and the thumb of a hand."""
    H = body.height_m
    arm = body.arms[0 if side == "left" else 1]
    wrist = body.skeleton.at(f"{side}_hand")
    along = -arm.frame[1]
    forward = arm.frame[2]
    palm = np.cross(along, forward) * SIGN[side]
    fingers = []
    for k, length in enumerate((0.043, 0.048, 0.045, 0.036)):
        root = wrist + (0.050 * along) * H + (1.5 - k) * 0.0108 * H * girth * forward
        lean = unit(along + 0.10 * (1.5 - k) * 0.5 * forward)
        fingers.append(_finger(root, lean, palm, length * H, 0.0050 * H * girth, f"{side}_fingers", skin))
    root = wrist + (0.012 * along + 0.014 * forward) * H
    thumb = unit(0.78 * along + 0.62 * forward + 0.15 * palm)
    return [*fingers, _finger(root, thumb, palm, 0.045 * H, 0.0062 * H * girth, f"{side}_hand", skin)]


def _finger(
    root: Vector, along: Vector, palm: Vector, length_m: float, radius_m: float, joint: str, skin: Image
) -> Patch:
    s = np.linspace(1, 0, 9)[:, None]
    centers = root + length_m * (s * along * (1 - 0.25 * s * 0.3) + 0.28 * s**2 * palm)
    radius = radius_m * np.interp(s[:, 0], [0, 0.5, 0.9, 1.0], [1.05, 1.0, 0.8, 0.45])
    tip = centers[0] + 0.35 * radius_m * unit(centers[0] - centers[1])
    grid = _tube(tip, centers, np.cross(palm, along), np.stack([radius, radius]), 9)
    return Patch(grid, unit_grid(grid.shape), one_joint(grid.shape[:2], joint), skin)


def shoe_patch(body: Body, side: str, upper_rgb: Vector, sole_rgb: Vector) -> Patch:
    """Draw one shoe, its sole on the floor y = 0 in the bind pose.

    The chart's u runs around the shoe, v from heel to tip.
    """
    H = body.height_m
    ankle = body.skeleton.at(f"{side}_foot")
    s = np.concatenate([np.linspace(0, 0.1, 6)[:-1], np.linspace(0.1, 0.9, 18), np.linspace(0.9, 1, 7)[1:]])
    place, *measures = np.array(TABLES["shoe"]).T
    half, tall = (np.interp(s, place, measure) * H for measure in measures)
    phi = np.linspace(0, 2 * np.pi, 29)
    sole = 0.009 * H
    # The upper is round, the sole a box with soft corners; phi runs from the outer side over the top.
    cosine = np.cos(phi)
    sine = np.sin(phi)
    x = half[:, None] * np.sign(cosine) * np.abs(cosine) ** np.where(sine > 0, 0.85, 0.35)
    y = np.where(
        sine > 0, sole + (tall - sole)[:, None] * np.abs(sine) ** 0.9, sole * (1 - np.abs(sine) ** 0.35)
    )
    # Heel and tip close to a point just above the floor.
    middle = 0.006 * H
    y = middle + (y - middle) * np.clip(half / (0.012 * H), 0, 1)[:, None]
    z = np.broadcast_to(((s - 0.25) * 0.152 * H)[:, None], x.shape)
    splay = SIGN[side] * 0.04 * H * np.maximum(s - 0.25, 0)[:, None] * 0.7
    points = np.stack([ankle[0] + x + splay, y, ankle[2] + z], -1)
    chart = _paint_shoe(upper_rgb, sole_rgb)
    return Patch(points, unit_grid(points.shape), _shoe_weights(body, side, points), chart)


def _shoe_weights(body: Body, side: str, points: Points) -> Weights:
    """Weights of a shoe's points: those in front of the toe's joint follow it."""
    toe_z = float(body.skeleton.at(f"{side}_toe")[2])
    soft = 0.02 * body.height_m
    foot, tip = (one_joint(points.shape[:2], f"{side}_{name}") for name in ("foot", "toe"))
    return mix(foot, tip, smoothstep(points[..., 2], toe_z - soft, toe_z + soft))


def _paint_shoe(upper_rgb: Vector, sole_rgb: Vector) -> Image:
    """Paint the chart of a shoe: upper, laces and sole."""
    u = np.linspace(0, 1, 128)[None, :, None] * 2 * np.pi
    v = np.linspace(1, 0, 96)[:, None, None]
    laces = (np.abs(np.sin(u) - 1) < 0.14) & (v > 0.42) & (v < 0.66) & ((v * 24) % 1 < 0.4)
    return np.where(laces, 0.5 * sole_rgb + 0.45, np.where(np.sin(u) < 0.16, sole_rgb, upper_rgb))
