"""Draws head, face and hair: the head is one painted surface of rings; hair is the same surface, thicker."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.body import Torso, mix, one_joint, smooth_table, smoothstep
from viewmend.studio.procedural.fabric import Canvas, Image, Patch, Plane, blend, hsv, outward_of, two_sided
from viewmend.studio.procedural.skeleton import TABLES, Physique, Points, Skeleton, Values, Vector

RINGS = np.array(TABLES["head"])
HEAD_SHARE = 0.132
"""Height of the head as a fraction of the person's (7.6 heads)."""
EYE_AZIMUTH = 0.37
"""Angle of the eyes from the middle of the face, radians, to either side."""
EYE_Y = 0.495
"""Height of the eyes as a fraction of the head's."""


def _spot(turn: Values, y: Values, at: float, height: float, wide: float, tall: float) -> Values:
    """A bump on the face: 1 at its centre, and less around it."""
    return np.exp(-(((turn - at) / wide) ** 2) - ((y - height) / tall) ** 2)


@dataclass(frozen=True)
class Head:
    """A person's head: the surface at an azimuth (0 is the nose) and height (0 chin, 1 crown)."""

    person: Physique
    origin: Vector
    """The point below the ears at chin height, world metres."""
    size_m: float

    def radius(self, azimuth: Values, y: Values) -> Values:
        """Horizontal distance from the axis in head heights, with the face's features."""
        f = self.person.femininity
        face = self.person.face
        heights, rings = smooth_table(RINGS[:, 0], RINGS[:, 1:])
        close = np.sqrt(np.clip((1 - y) / 0.03, 0, 1))
        a, d, b = (np.interp(y, heights, rings[:, k]) * close for k in range(3))
        jaw = np.exp(-(((y - 0.12) / 0.14) ** 2))
        a = a * (1 + jaw * (0.05 - 0.10 * f + 0.05 * face[0]) + 0.04 * self.person.weight * jaw)
        sine = np.abs(np.sin(azimuth))
        cosine = np.cos(azimuth)
        depth = np.maximum(np.where(cosine > 0, d, b), 1e-3)
        r = ((sine / np.maximum(a, 1e-3)) ** 2.25 + (np.abs(cosine) / depth) ** 2.25) ** (-1 / 2.25)
        turn = np.abs(np.angle(np.exp(1j * azimuth)))
        return r + self._features(turn, y) * (np.cos(azimuth) > -0.2)

    def _features(self, turn: Values, y: Values) -> Values:
        """Relief of nose, brows, lips and the like at an angle from the middle of the face, in head heights."""
        f = self.person.femininity
        face = self.person.face
        ridge = np.interp(y, [0.315, 0.345, 0.37, 0.45, 0.53, 0.57], [0, 0.085, 0.112, 0.068, 0.028, 0.0])
        nose = (1 + 0.2 * face[1] - 0.1 * f) * ridge * np.exp(-((turn / (0.115 + 0.015 * face[2])) ** 2))
        features = nose
        for swelling, by_chin, by_sex, *place in TABLES["face"]:
            features = features + (swelling + by_chin * face[3] + by_sex * f) * _spot(turn, y, *place)
        return features

    def point(self, azimuth: Values, y: Values, thickness: Values | float = 0.0) -> Points:
        """World position on the head, or `thickness` head heights above it."""
        r = self.radius(azimuth, y)
        # Rings nearly flat at the crown must rise, not only widen, to grow thicker.
        steep = np.clip((y - 0.62) / 0.38, 0, 1) ** 1.5
        x, z = (r + thickness * (1 - 0.4 * steep)) * np.array([np.sin(azimuth), np.cos(azimuth)])
        rise = y + thickness * steep
        return self.origin + self.size_m * np.stack([x, rise, z], -1)


def build_head(person: Physique, skeleton: Skeleton) -> Head:
    """Build a person's head in the bind pose."""
    size = HEAD_SHARE * person.height_m
    neck = skeleton.at("head")
    return Head(person, np.array([0.0, person.height_m - size, neck[2] + 0.012]), size)


def face_grid(
    rows: int, columns: int
) -> tuple[Float[np.ndarray, "row column"], Float[np.ndarray, "row column"]]:
    """Make the azimuths and heights of a grid over the head, denser on the face."""
    c = np.linspace(-1, 1, columns)
    azimuth = np.pi * (0.55 * c + 0.45 * c**3)
    h = np.linspace(0, 1, rows)
    y = h + 0.06 * np.sin(2 * np.pi * h) * -1 * 0.5
    y = np.clip(np.interp(h, [0, 0.06, 0.94, 1], [0, 0.03, 0.975, 1]) * 0.6 + y * 0.4, 0, 1)
    return np.broadcast_to(azimuth, (rows, columns)), np.broadcast_to(y[:, None], (rows, columns))


def head_patches(person: Physique, head: Head, rng: np.random.Generator, hair_rgb: Vector) -> list[Patch]:
    """Draw the head with its painted face, and two ears."""
    azimuth, y = face_grid(68, 73)
    points = head.point(azimuth, y)
    canvas = Canvas(0.56, head.size_m, 1000.0)
    chart = paint_face(person, canvas, rng, hair_rgb)
    uv = np.stack([azimuth / (2 * np.pi) + 0.5, y], -1)
    patches = [Patch(points, uv, one_joint(points.shape[:2], "head"), chart)]
    skin = np.broadcast_to(np.array(person.skin_rgb) * [0.97, 0.9, 0.88], (8, 8, 3))
    # They stand on the cheeks behind the middle, and lean out backwards.
    cheek = float(head.radius(np.array([1.62]), np.array([0.46]))[0]) + 0.012
    for side in (1.0, -1.0):
        phi, v = np.meshgrid(np.linspace(-np.pi, np.pi, 17), np.linspace(-1, 1, 11))
        tall = np.cos(v * np.pi / 2) ** 0.6
        x = 0.022 * np.sin(phi) * tall * (1 + 0.5 * np.maximum(0, v))
        z = 0.055 * np.cos(phi) * tall - 0.02
        at = np.stack([side * (cheek + x - 0.35 * z), 0.455 + 0.1 * v, z], -1)
        grid = head.origin + head.size_m * at
        grid = grid if side > 0 else grid[:, ::-1]
        uv = np.stack([(phi / np.pi + 1) / 2, (v + 1) / 2], -1)
        patches.append(Patch(grid, uv, one_joint(grid.shape[:2], "head"), skin))
    return patches


def paint_face(person: Physique, canvas: Canvas, rng: np.random.Generator, hair_rgb: Vector) -> Image:
    """Paint skin with eyes, brows, mouth, cheeks, nostrils, and sometimes stubble."""
    theta = canvas.x / canvas.width_m * 2 * np.pi
    y = canvas.y / canvas.height_m
    turn = np.abs(theta)
    skin = np.array(person.skin_rgb)
    face = person.face
    f = person.femininity
    mottled = 1 + 0.02 * canvas.noise(rng, 0.012, 0.012) + 0.012 * canvas.noise(rng, 0.003, 0.003)
    image = skin * mottled[..., None]

    def soft(*place: float) -> Plane:
        return _spot(turn, y, *place)

    def crisp(value: Plane, softness: float = 0.12) -> Plane:
        return np.clip(value / softness + 0.5, 0, 1)

    image = blend(image, skin * [1.0, 0.72, 0.68], 0.35 * soft(0.62, 0.36, 0.28, 0.09))
    image = blend(image, skin * 0.72, 0.5 * soft(EYE_AZIMUTH, EYE_Y + 0.01, 0.20, 0.05))
    image = blend(
        image, skin * 0.6, 0.35 * np.maximum(soft(0.16, 0.42, 0.05, 0.1), soft(0.0, 0.315, 0.16, 0.012))
    )
    image = blend(image, skin * 0.35, 0.8 * soft(0.08, 0.327, 0.035, 0.008))
    stubble = rng.random() * (f < 0.4) * (rng.random() < 0.6)
    jaw = smoothstep(-y, -0.30, -0.17) * smoothstep(-turn, -1.6, -1.25)
    image = blend(image, 0.5 * hair_rgb + 0.3 * skin, 0.7 * stubble * jaw)
    lip = (
        skin * [0.85, 0.55, 0.55] if f < 0.5 else 0.5 * skin + 0.5 * hsv(rng.uniform(-0.05, 0.02), 0.65, 0.6)
    )
    wide = 0.27 + 0.03 * face[4]
    lips = (
        1
        - (turn / wide) ** 2
        - ((y - 0.200) / (0.034 * np.sqrt(np.clip(1 - (turn / wide) ** 2, 0.02, 1)))) ** 2
    )
    image = blend(image, lip, 0.85 * crisp(lips, 0.5))
    image = blend(image, lip * 0.4, crisp(1 - (turn / (wide * 0.97)) ** 2 - ((y - 0.201) / 0.0055) ** 2, 0.8))
    x = turn - EYE_AZIMUTH - 0.01 * face[5]
    lid = ((y - EYE_Y) / 0.025) ** 2 + (x / 0.150) ** 2
    inside = crisp(1 - lid, 0.3)
    image = blend(image, np.array([0.84, 0.82, 0.80]), inside)
    iris = np.array([hsv(0.07, 0.7, 0.25), hsv(0.08, 0.6, 0.4), hsv(0.57, 0.45, 0.55), hsv(0.3, 0.3, 0.4)])
    color = iris[int(rng.choice(4, p=[0.5, 0.25, 0.15, 0.1]))]
    disc = np.hypot(x / 0.072, (y - EYE_Y) / 0.029)
    image = blend(image, color, inside * crisp(1 - disc, 0.2))
    image = blend(image, np.array([0.03, 0.03, 0.03]), inside * crisp(0.5 - disc, 0.15))
    lash = np.exp(-(((y - EYE_Y - 0.025 * np.sqrt(np.clip(1 - (x / 0.165) ** 2, 0, 1))) / 0.006) ** 2))
    image = blend(image, 0.25 * skin * 0.5, (0.6 + 0.4 * f) * lash * crisp(1 - (np.abs(x) / 0.17) ** 2))
    arch = 0.585 + 0.012 * face[6] + 0.018 * np.cos((x - 0.05) / 0.2 * 1.5)
    brow = 1 - ((y - arch) / (0.017 - 0.006 * f)) ** 2 - ((x - 0.02) / 0.21) ** 4
    return np.clip(blend(image, 0.75 * hair_rgb, 0.85 * crisp(brow, 0.7)), 0, 1)


@dataclass(frozen=True)
class Hair:
    """A hairstyle and its colour."""

    style: str
    color: Vector
    volume: float
    """Volume from 0 to 1."""
    seed: int

    @property
    def words(self) -> str:
        """The hair as text."""
        return {"bald": "bald", "cap": "in a cap"}.get(self.style, f"{self.style} hair")


def sample_hair(rng: np.random.Generator, femininity: float, dark_skin: bool) -> Hair:
    """Sample a hairstyle; colours cover the human range, dark ones on dark skin."""
    styles = list(TABLES["hair"])
    odds = [row[femininity > 0.5] for row in TABLES["hair"].values()]
    style = styles[int(rng.choice(len(styles), p=odds))]
    colors = np.array([*TABLES["hair_colors"], (rng.random(), 0.6, 0.6, 0.03, 0.02)])
    h, s, v = colors[int(rng.choice(len(colors), p=colors[:, 4 if dark_skin else 3])), :3]
    color = hsv(h, s * rng.uniform(0.85, 1.15), v * rng.uniform(0.8, 1.2))
    return Hair(style, color, float(rng.random()), int(rng.integers(2**31)))


def strands(hair: Hair, canvas: Canvas) -> Image:
    """Paint hair: streaks that run down, lighter and darker."""
    rng = np.random.default_rng(hair.seed)
    tight = hair.style in ("afro", "cropped", "bald")
    streaks = canvas.noise(rng, 0.004, 0.006 if tight else 0.10)
    streaks = streaks + 0.7 * canvas.noise(rng, 0.015, 0.012 if tight else 0.2)
    return np.clip(hair.color * (1 + 0.20 * streaks[..., None]) + 0.012 * streaks[..., None], 0, 1)


def hair_patches(head: Head, hair: Hair, torso: Torso, accent: Vector) -> list[Patch]:
    """Make all sheets of this hairstyle."""
    if hair.style == "bald" and hair.volume < 0.5:
        return []
    rng = np.random.default_rng(hair.seed + 1)
    canvas = Canvas(0.6, 0.26, 600.0)
    chart = strands(hair, canvas)
    azimuth, y = face_grid(48, 65)
    thick = TABLES["hair"][hair.style][2] * (0.75 + 0.5 * hair.volume)
    turn = np.abs(np.angle(np.exp(1j * azimuth)))
    recede = float(rng.uniform(-0.4, 1.0)) * 0.08 * np.exp(-(((turn - 0.55) / 0.35) ** 2))
    line = np.interp(turn, *TABLES["hairline"]) + recede
    if hair.style == "cap":
        chart = np.clip(accent * (1 + 0.05 * canvas.noise(rng, 0.02, 0.02))[..., None], 0, 1)
        line = np.interp(np.abs(azimuth), [0, 1.2, np.pi], [0.70, 0.66, 0.52])
    inside = smoothstep(y - line, -0.03, 0.09 if hair.style != "cap" else 0.03)
    if hair.style == "bald":
        inside = inside * smoothstep(np.abs(azimuth), 1.3, 1.6) * smoothstep(-y, -0.74, -0.60)
    bumps = Canvas(0.6, 0.26, 100.0).noise(rng, 0.03, 0.03 if hair.style == "afro" else 0.06)
    rows, columns = bumps.shape
    curl = bumps[
        ((1 - y) * (rows - 1)).astype(int), ((azimuth / (2 * np.pi) + 0.5) * (columns - 1)).astype(int)
    ]
    curl = curl * np.clip((np.pi - np.abs(azimuth)) / 0.4, 0, 1) * (0.0 if hair.style == "cap" else 0.22)
    part = 0.3 * np.exp(-(((azimuth - 0.5) / 0.25) ** 2)) * (hair.style == "parted")
    layer = thick * inside * (1 + curl - part) - 0.006 * (1 - inside)
    points = head.point(azimuth, y, layer)
    uv = np.stack([azimuth / (2 * np.pi) + 0.5, y], -1)
    patches = [Patch(points, uv, one_joint(points.shape[:2], "head"), chart, keep=inside > 0)]
    if hair.style in ("bob", "long"):
        patches += _curtain(head, hair, torso, chart, thick)
    if hair.style in ("ponytail", "bun"):
        patches.append(_gather_hair(head, hair, chart))
    if hair.style == "cap":
        patches.append(_brim(head, chart))
        patches += hair_patches(head, replace(hair, style="cropped"), torso, accent)
    return patches


def _curtain(head: Head, hair: Hair, torso: Torso, chart: Image, thick: float) -> list[Patch]:
    """Make hair that falls behind the face to the neck or over the back, outside and inside."""
    low = -0.05 + 0.12 * hair.volume if hair.style == "bob" else -0.35 - 0.75 * hair.volume
    opening = 1.12 + 0.15 * (hair.style == "long")
    theta, y = np.meshgrid(np.linspace(opening, 2 * np.pi - opening, 49), np.linspace(low, 0.86, 32))
    lock = 1 + 0.06 * np.sin(theta * 17 + hair.seed % 7) * smoothstep(-y, -0.6, 0.0)
    held = np.maximum(y, 0.42)
    # It comes out from under the layer on the crown.
    grow = thick * lock * (0.75 + 0.6 * smoothstep(-y, -0.80, 0.1))
    points = head.point(theta, held, grow)
    points[..., 1] -= (held - y) * head.size_m
    outward = outward_of(theta)
    for _ in range(5):
        gap = 0.022 - torso.field(points)
        points = points + np.clip(gap, 0, 0.03)[..., None] * np.array([0, 0, -1.0])
    turn = smoothstep(-y, 0.05, 0.45)
    weights = mix(one_joint(y.shape, "head"), one_joint(y.shape, "upper"), turn)
    uv = np.stack([(theta - opening) / (2 * np.pi - 2 * opening), (y - low) / (0.86 - low)], -1)
    return two_sided(Patch(points, uv, weights, chart, closed=False), points - 0.012 * outward, 0.5)


def _gather_hair(head: Head, hair: Hair, chart: Image) -> Patch:
    """Make a ponytail or a bun behind the crown."""
    v, phi = np.meshgrid(np.linspace(0, 1, 24), np.linspace(-np.pi, np.pi, 17), indexing="ij")
    start = head.origin + head.size_m * np.array([0, 0.80, -0.44])
    uv = np.stack([(phi / np.pi + 1) / 2, v], -1)
    if hair.style == "bun":
        radius = 0.16 * head.size_m * (0.9 + 0.5 * hair.volume)
        center = start + np.array([0, 0.1, -0.12]) * head.size_m
        across = radius * np.sqrt(np.clip(1 - (2 * v - 1) ** 2, 0, 1))
        points = center + np.stack([across * np.sin(phi), radius * (2 * v - 1), across * np.cos(phi)], -1)
        return Patch(points, uv, one_joint(v.shape, "head"), chart)
    s = 1 - v
    length = head.size_m * (0.9 + 1.0 * hair.volume)
    radius = (
        0.10
        * head.size_m
        * np.sqrt(np.clip(s * 6, 0, 1))
        * np.interp(s, [0, 0.1, 0.5, 1], [0.55, 0.9, 1, 0.05])
    )
    drop = -length * s + 0.03 * np.sin(np.pi * s)
    back = -0.09 * np.sin(np.minimum(s * 3, 1.57))
    ring = np.stack([radius * np.sin(phi), np.zeros_like(s), radius * np.cos(phi)], -1)
    points = start + np.stack([np.zeros_like(s), drop, back], -1) + ring
    return Patch(points, uv, one_joint(v.shape, "tail"), chart)


def _brim(head: Head, chart: Image) -> Patch:
    """Make the peak of a cap."""
    phi, v = np.meshgrid(np.linspace(-np.pi, np.pi, 33), np.linspace(-1, 1, 9))
    across = np.sqrt(np.clip(1 - v**2, 0, 1))
    x = 0.31 * np.sin(phi) * across
    z = 0.33 + 0.42 * np.cos(phi) * across
    at = np.stack([x, 0.70 + 0.016 * v - 0.25 * x**2 - 0.10 * (z - 0.33), z], -1)
    uv = np.stack([(phi / np.pi + 1) / 2, (v + 1) / 2], -1)
    return Patch(head.origin + head.size_m * at, uv, one_joint(v.shape, "head"), chart)
