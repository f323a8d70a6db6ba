"""Hair: a layer over the head up to a hairline, with curls, and what hangs or is tied: curtain, tail, bun, cap."""

from dataclasses import dataclass, replace

import numpy as np

from viewmend.studio.procedural.body import Torso
from viewmend.studio.procedural.fabric import Canvas, Image, hsv
from viewmend.studio.procedural.head import Head, face_grid
from viewmend.studio.procedural.patches import Patch, outward_of, two_sided
from viewmend.studio.procedural.skeleton import Values, Vector
from viewmend.studio.procedural.weights import mix, one_joint, smoothstep

STYLES = ("bald", "cropped", "short", "parted", "afro", "bob", "long", "ponytail", "bun", "cap")


@dataclass(frozen=True)
class Hair:
    """A hairstyle and its colour."""

    style: str
    color: Vector
    volume: float
    """0 to 1."""
    seed: int

    @property
    def words(self) -> str:
        """The hair in words."""
        return {"bald": "bald", "cap": "in a cap"}.get(self.style, f"{self.style} hair")


def sample_hair(rng: np.random.Generator, femininity: float, dark_skin: bool) -> Hair:
    """Draw a hairstyle; colours over the human range, dark ones on dark skin."""
    if femininity > 0.5:
        odds = [0.01, 0.04, 0.08, 0.05, 0.08, 0.16, 0.24, 0.16, 0.12, 0.06]
    else:
        odds = [0.10, 0.22, 0.26, 0.16, 0.07, 0.02, 0.04, 0.02, 0.03, 0.08]
    style = STYLES[int(rng.choice(len(STYLES), p=odds))]
    shades = [(0.07, 0.5, 0.09), (0.07, 0.55, 0.2), (0.08, 0.55, 0.36), (0.11, 0.5, 0.7), (0.05, 0.75, 0.45)]
    shades += [(0.1, 0.04, 0.62), (rng.random(), 0.6, 0.6)]
    odds = [0.6, 0.25, 0.03, 0.02, 0.02, 0.06, 0.02] if dark_skin else [0.26, 0.24, 0.19, 0.13, 0.08, 0.07, 0.03]
    h, s, v = shades[int(rng.choice(len(shades), p=odds))]
    color = hsv(h, s * rng.uniform(0.85, 1.15), v * rng.uniform(0.8, 1.2))
    return Hair(style, color, float(rng.random()), int(rng.integers(2**31)))


def hairline(azimuth: Values, recede: float) -> Values:
    """Height of the hairline on the head (0 chin, 1 crown) at an azimuth."""
    turn = np.abs(np.angle(np.exp(1j * azimuth)))
    line = np.interp(
        turn,
        [0, 0.5, 0.95, 1.2, 1.5, 1.62, 1.75, 2.1, 2.6, np.pi],
        [0.83, 0.82, 0.75, 0.6, 0.44, 0.46, 0.6, 0.36, 0.2, 0.16],
    )
    return line + recede * 0.08 * np.exp(-(((turn - 0.55) / 0.35) ** 2))


def strands(hair: Hair, canvas: Canvas) -> Image:
    """Hair as paint: streaks that run down, lighter and darker."""
    rng = np.random.default_rng(hair.seed)
    tight = hair.style in ("afro", "cropped", "bald")
    streaks = canvas.noise(rng, 0.004, 0.006 if tight else 0.10) + 0.7 * canvas.noise(
        rng, 0.015, 0.012 if tight else 0.2
    )
    return np.clip(hair.color * (1 + 0.20 * streaks[..., None]) + 0.012 * streaks[..., None], 0, 1)


def hair_patches(head: Head, hair: Hair, torso: Torso, accent: Vector) -> list[Patch]:
    """All sheets of this hairstyle."""
    if hair.style == "bald" and hair.volume < 0.5:
        return []
    rng = np.random.default_rng(hair.seed + 1)
    canvas = Canvas(0.6, 0.26, 600.0)
    chart = strands(hair, canvas)
    azimuth, y = face_grid(48, 65)
    base = {"bald": 0.012, "cropped": 0.018, "short": 0.045, "parted": 0.06, "afro": 0.17, "bob": 0.075, "cap": 0.065}
    thick = base.get(hair.style, 0.05) * (0.75 + 0.5 * hair.volume)
    recede = float(rng.uniform(-0.4, 1.0))
    line = hairline(azimuth, recede)
    if hair.style == "cap":
        chart = np.clip(accent * (1 + 0.05 * canvas.noise(rng, 0.02, 0.02))[..., None], 0, 1)
        line = np.interp(np.abs(azimuth), [0, 1.2, np.pi], [0.70, 0.66, 0.52])
    inside = smoothstep(y - line, -0.03, 0.09 if hair.style != "cap" else 0.03)
    if hair.style == "bald":
        inside = inside * smoothstep(np.abs(azimuth), 1.3, 1.6) * smoothstep(-y, -0.74, -0.60)
    bumps = Canvas(0.6, 0.26, 100.0).noise(rng, 0.03, 0.03 if hair.style == "afro" else 0.06)
    rows, columns = bumps.shape
    curl = bumps[((1 - y) * (rows - 1)).astype(int), ((azimuth / (2 * np.pi) + 0.5) * (columns - 1)).astype(int)]
    curl = curl * np.clip((np.pi - np.abs(azimuth)) / 0.4, 0, 1) * (0.0 if hair.style == "cap" else 0.22)
    part = 0.3 * np.exp(-(((azimuth - 0.5) / 0.25) ** 2)) * (hair.style == "parted")
    layer = thick * inside * (1 + curl - part) - 0.006 * (1 - inside)
    points = head.point(azimuth, y, layer)
    uv = np.stack([azimuth / (2 * np.pi) + 0.5, y], -1)
    patches = [Patch(points, uv, one_joint(points.shape[:2], "head"), chart, keep=inside > 0)]
    if hair.style in ("bob", "long"):
        patches += _curtain(head, hair, torso, chart, thick)
    if hair.style in ("ponytail", "bun"):
        patches.append(_tied(head, hair, chart))
    if hair.style == "cap":
        patches.append(_brim(head, chart))
        patches += hair_patches(head, replace(hair, style="cropped"), torso, accent)
    return patches


def _curtain(head: Head, hair: Hair, torso: Torso, chart: Image, thick: float) -> list[Patch]:
    """Hair that falls behind the face to the neck or over the back, outside and inside."""
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


def _tied(head: Head, hair: Hair, chart: Image) -> Patch:
    """A ponytail or a bun behind the crown."""
    v, phi = np.meshgrid(np.linspace(0, 1, 24), np.linspace(-np.pi, np.pi, 17), indexing="ij")
    start = head.origin + head.size_m * np.array([0, 0.80, -0.44])
    if hair.style == "bun":
        s, radius = v, 0.16 * head.size_m * (0.9 + 0.5 * hair.volume)
        center = start + np.array([0, 0.1, -0.12]) * head.size_m
        across = radius * np.sqrt(np.clip(1 - (2 * s - 1) ** 2, 0, 1))
        points = center + np.stack([across * np.sin(phi), radius * (2 * s - 1), across * np.cos(phi)], -1)
        return Patch(points, np.stack([(phi / np.pi + 1) / 2, v], -1), one_joint(v.shape, "head"), chart)
    s = 1 - v
    length = head.size_m * (0.9 + 1.0 * hair.volume)
    radius = 0.10 * head.size_m * np.sqrt(np.clip(s * 6, 0, 1)) * np.interp(s, [0, 0.1, 0.5, 1], [0.55, 0.9, 1, 0.05])
    drop = np.stack(
        [np.zeros_like(s), -length * s + 0.03 * np.sin(np.pi * s), -0.09 * np.sin(np.minimum(s * 3, 1.57))], -1
    )
    ring = np.stack([radius * np.sin(phi), np.zeros_like(s), radius * np.cos(phi)], -1)
    uv = np.stack([(phi / np.pi + 1) / 2, v], -1)
    return Patch(start + drop + ring, uv, one_joint(v.shape, "tail"), chart)


def _brim(head: Head, chart: Image) -> Patch:
    """The peak of a cap."""
    phi, v = np.meshgrid(np.linspace(-np.pi, np.pi, 33), np.linspace(-1, 1, 9))
    across = np.sqrt(np.clip(1 - v**2, 0, 1))
    x, z = 0.31 * np.sin(phi) * across, 0.33 + 0.42 * np.cos(phi) * across
    at = np.stack([x, 0.70 + 0.016 * v - 0.25 * x**2 - 0.10 * (z - 0.33), z], -1)
    uv = np.stack([(phi / np.pi + 1) / 2, (v + 1) / 2], -1)
    return Patch(head.origin + head.size_m * at, uv, one_joint(v.shape, "head"), chart)
