"""Hands and feet: palm, fingers and thumb; shoes."""

import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.body import Body
from viewmend.studio.procedural.fabric import Image
from viewmend.studio.procedural.patches import Patch
from viewmend.studio.procedural.skeleton import SIGN, Skeleton, Vector, unit
from viewmend.studio.procedural.tables import TABLES
from viewmend.studio.procedural.weights import mix, one_joint, smoothstep


def _tube(
    centers: Float[np.ndarray, "row 3"],
    across: Float[np.ndarray, "row 3"],
    radii: Float[np.ndarray, "row 2"],
    columns: int,
) -> Float[np.ndarray, "row column 3"]:
    """Ellipses around a line that runs from its far end to its near end (up); `across` is the first radius' axis."""
    up = unit(np.gradient(centers, axis=0))
    side = unit(across - up * (across * up).sum(-1, keepdims=True))
    front = np.cross(side, up)
    phi = np.linspace(-np.pi, np.pi, columns)[None, :, None]
    ring = radii[:, None, :1] * np.sin(phi) * side[:, None] + radii[:, None, 1:] * np.cos(phi) * front[:, None]
    return centers[:, None] + ring


def unit_grid(shape: tuple[int, ...]) -> Float[np.ndarray, "row column 2"]:
    """Chart coordinates of a regular grid: u along the columns, v along the rows."""
    v, u = np.meshgrid(np.linspace(0, 1, shape[0]), np.linspace(0, 1, shape[1]), indexing="ij")
    return np.stack([u, v], -1)


def hand_patches(body: Body, skeleton: Skeleton, height_m: float, side: str, skin: Image, girth: float) -> list[Patch]:
    """One hand, its fingers a little curled; `girth` 1 is average."""
    H = height_m
    arm = body.arms[0 if side == "left" else 1]
    wrist = skeleton.at(f"{side}_hand")
    along, forward = -arm.frame[1], arm.frame[2]
    palm = np.cross(along, forward) * SIGN[side]
    s = np.linspace(1, -0.12, 12)
    reach = 0.054 * H * s
    breadth = np.interp(s, [-0.12, 0.1, 0.45, 0.8, 1.0], [0.0140, 0.0160, 0.0220, 0.0235, 0.0215]) * H * girth
    thick = np.interp(s, [-0.12, 0.1, 0.5, 1.0], [0.0115, 0.0110, 0.0105, 0.0070]) * H * girth
    centers = wrist + reach[:, None] * along
    grid = _tube(centers, np.broadcast_to(forward, centers.shape), np.stack([breadth, thick], 1), 17)
    grid = np.concatenate([np.broadcast_to(centers[0] + 0.006 * along, (1, 17, 3)), grid])
    weights = one_joint(grid.shape[:2], f"{side}_hand")
    wrist_turn = smoothstep(arm.along(grid), 0.96, 1.03)
    weights = mix(one_joint(grid.shape[:2], f"{side}_forearm"), weights, wrist_turn)
    patches = [Patch(grid, unit_grid(grid.shape), weights, skin)]
    for k in range(4):
        spread = (1.5 - k) * 0.0108 * H * girth
        length = (0.043, 0.048, 0.045, 0.036)[k] * H
        root = wrist + (0.050 * along) * H + spread * forward
        lean = along + 0.10 * (1.5 - k) * 0.5 * forward
        patches.append(_finger(root, unit(lean), palm, length, 0.0050 * H * girth, f"{side}_fingers", skin))
    root = wrist + (0.012 * along + 0.014 * forward) * H
    thumb = unit(0.78 * along + 0.62 * forward + 0.15 * palm)
    return [*patches, _finger(root, thumb, palm, 0.045 * H, 0.0062 * H * girth, f"{side}_hand", skin)]


def _finger(
    root: Vector, along: Vector, palm: Vector, length_m: float, radius_m: float, joint: str, skin: Image
) -> Patch:
    s = np.linspace(1, 0, 9)
    curl = 0.28 * s**2
    centers = root + length_m * (s[:, None] * along * (1 - 0.25 * s[:, None] * 0.3) + curl[:, None] * palm)
    radius = radius_m * np.interp(s, [0, 0.5, 0.9, 1.0], [1.05, 1.0, 0.8, 0.45])
    radii = np.stack([radius, radius], 1)
    side = np.broadcast_to(np.cross(palm, along), centers.shape)
    grid = _tube(centers, side, radii, 9)
    tip = centers[0] + 0.35 * radius_m * unit(centers[0] - centers[1])
    grid = np.concatenate([np.broadcast_to(tip, (1, 9, 3)), grid])
    return Patch(grid, unit_grid(grid.shape), one_joint(grid.shape[:2], joint), skin)


SHOE = np.array(TABLES["shoe"])


def shoe_patch(skeleton: Skeleton, height_m: float, side: str, upper_rgb: Vector, sole_rgb: Vector) -> Patch:
    """One shoe, its sole on the floor y = 0 in the bind pose. The chart's u runs around, v from heel to tip."""
    H = height_m
    ankle = skeleton.at(f"{side}_foot")
    s = np.concatenate([np.linspace(0, 0.1, 6)[:-1], np.linspace(0.1, 0.9, 18), np.linspace(0.9, 1, 7)[1:]])
    half, tall = (np.interp(s, SHOE[:, 0], SHOE[:, k]) * H for k in (1, 2))
    phi = np.linspace(0, 2 * np.pi, 29)
    sole = 0.009 * H
    # The upper is round, the sole a box with soft corners; phi runs from the outer side over the top.
    cosine, sine = np.cos(phi), np.sin(phi)
    x = half[:, None] * np.sign(cosine) * np.abs(cosine) ** np.where(sine > 0, 0.85, 0.35)
    y = np.where(sine > 0, sole + (tall - sole)[:, None] * np.abs(sine) ** 0.9, sole * (1 - np.abs(sine) ** 0.35))
    # Heel and tip close to a point just above the floor.
    middle, close = 0.006 * H, np.clip(half / (0.012 * H), 0, 1)[:, None]
    y = middle + (y - middle) * close
    z = np.broadcast_to(((s - 0.25) * 0.152 * H)[:, None], x.shape)
    splay = SIGN[side] * 0.04 * H * np.maximum(s - 0.25, 0)[:, None] * 0.7
    points = np.stack([ankle[0] + x + splay, y, ankle[2] + z], -1)
    chart = np.empty((96, 128, 3))
    u = np.linspace(0, 1, 128)[None, :, None] * 2 * np.pi
    v = np.linspace(1, 0, 96)[:, None, None]
    chart[:] = np.where((np.sin(u) < 0.16), sole_rgb, upper_rgb)
    laces = (np.abs(np.sin(u) - 1) < 0.14) & (v > 0.42) & (v < 0.66) & ((v * 24) % 1 < 0.4)
    chart = np.where(laces, 0.5 * np.asarray(sole_rgb) + 0.45, chart)
    weights = one_joint(points.shape[:2], f"{side}_foot")
    toe = float(skeleton.at(f"{side}_toe")[2])
    bend = smoothstep(points[..., 2], toe - 0.02 * H, toe + 0.02 * H)
    return Patch(points, unit_grid(points.shape), mix(weights, one_joint(points.shape[:2], f"{side}_toe"), bend), chart)
