"""Makes objects that a hand holds, or that stand on the floor."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.body import Body, one_joint, unit_grid
from viewmend.studio.procedural.fabric import Canvas, Image, Patch, blend, edge, hsv, sample_fabric, wave
from viewmend.studio.procedural.skeleton import SIGN, TABLES, Rotation, Values, Vector, rotation

HELD = ("ball", "cup", "book", "bag", "staff", "bottle", "tablet")
STANDING = ("crate", "plant", "lamp", "ball", "suitcase", "table", "stool")


@dataclass(frozen=True)
class Frame:
    """Position and axes of an object in the bind pose or the world, and the joint that it follows."""

    origin: Vector
    axes: Rotation
    """Axes of the object as columns: x, y (up) and z."""
    joint: str = "pelvis"

    def offset_by(self, x: float, y: float, z: float) -> "Frame":
        """The frame at an offset in its own coordinates, metres."""
        return replace(self, origin=self.origin + self.axes @ np.array([x, y, z]))

    def patch(self, local: Float[np.ndarray, "row column 3"], chart: Image, closed: bool = True) -> Patch:
        """Make a sheet from points in the object's own coordinates."""
        points = local @ self.axes.T + self.origin
        return Patch(
            points, unit_grid(local.shape), one_joint(local.shape[:2], self.joint), chart, closed=closed
        )


def solid_of_revolution(frame: Frame, r: Values, y: Values, chart: Image, columns: int = 29) -> Patch:
    """Make a solid of revolution around y from radii at rising heights; repeated heights make sharp edges."""
    phi = np.linspace(-np.pi, np.pi, columns)
    x = r[:, None] * np.sin(phi)
    z = r[:, None] * np.cos(phi)
    return frame.patch(np.stack([x, np.broadcast_to(y[:, None], x.shape), z], -1), chart)


def profile_solid(frame: Frame, name: str, chart: Image, size_m: float = 0.0, columns: int = 29) -> Patch:
    """Make a solid of revolution from a profile in the tables."""
    r, y, share = np.array(TABLES["profiles"][name]).T
    return solid_of_revolution(frame, r, y + share * size_m, chart, columns)


def cylinder(frame: Frame, radius: float, height: float, chart: Image) -> Patch:
    """Make a closed cylinder with sharp rims."""
    r, y = np.array([(0, 0), (radius, 0), (radius, 0), (radius, height), (radius, height), (0, height)]).T
    return solid_of_revolution(frame, r, y, chart, 17)


def ball(frame: Frame, radius: float, chart: Image) -> Patch:
    """Make a sphere that stands on its lowest point."""
    polar = np.linspace(-np.pi / 2, np.pi / 2, 17)
    return solid_of_revolution(frame, radius * np.cos(polar), radius * (1 + np.sin(polar)), chart, 25)


def box(frame: Frame, size: tuple[float, float, float], chart: Image) -> list[Patch]:
    """Make six sides, each with the whole chart; x and z are centred, y starts at 0."""
    w = size[0] / 2
    h = size[1]
    d = size[2] / 2
    sides = []
    for k in range(4):
        wide, deep = (w, d) if k % 2 == 0 else (d, w)
        corners = np.array([[(-wide, 0, deep), (wide, 0, deep)], [(-wide, h, deep), (wide, h, deep)]])
        sides.append(corners @ rotation(1, k * np.pi / 2).T)
    sides.append(np.array([[(-w, h, d), (w, h, d)], [(-w, h, -d), (w, h, -d)]]))
    sides.append(np.array([[(-w, 0, -d), (w, 0, -d)], [(-w, 0, d), (w, 0, d)]]))
    return [frame.patch(side, chart, closed=False) for side in sides]


def plain_chart(color: Vector) -> Image:
    """Make a chart of one colour."""
    return np.broadcast_to(color, (8, 8, 3)).astype(np.float64)


def _wood(rng: np.random.Generator, canvas: Canvas) -> Image:
    color = hsv(rng.uniform(0.05, 0.1), rng.uniform(0.35, 0.65), rng.uniform(0.3, 0.75))
    grain = 0.12 * canvas.noise(rng, 0.012, 0.25) + 0.05 * canvas.noise(rng, 0.003, 0.1)
    planks = wave(canvas.x, 0.11, 0.03, canvas)
    return np.clip(blend(color * (1 + grain[..., None]), 0.4 * color, planks), 0, 1)


def _print(rng: np.random.Generator, width: float, height: float) -> Image:
    fabric = sample_fabric(rng)
    canvas = Canvas(width, height, 400.0)
    rim = np.minimum(
        np.minimum(canvas.y, height - canvas.y), np.minimum(canvas.x + width / 2, width / 2 - canvas.x)
    )
    image = fabric.paint(canvas)
    return blend(image, 0.5 * image, edge(0.006 - rim, canvas))


def stool(rng: np.random.Generator, origin: Vector, yaw: float, height_m: float) -> list[Patch]:
    """Make a stool of this height: round on four legs, or a block."""
    frame = Frame(origin, rotation(1, yaw))
    if rng.random() < 0.4:
        return box(frame, (0.38, height_m, 0.38), _print(rng, 0.38, height_m))
    wood = _wood(rng, Canvas(0.4, 0.4, 300.0))
    patches = [profile_solid(frame, "seat", wood, height_m)]
    for k in range(4):
        angle = np.pi / 4 + k * np.pi / 2
        leg = frame.offset_by(*(0.13 * np.array([np.sin(angle), 0, np.cos(angle)])))
        patches.append(cylinder(leg, 0.018, height_m - 0.045, wood[:64, :64]))
    return patches


def standing_prop(kind: str, rng: np.random.Generator, origin: Vector, yaw: float) -> list[Patch]:
    """Make one of `STANDING` on the floor at `origin`."""
    frame = Frame(origin, rotation(1, yaw))
    match kind:
        case "stool":
            return stool(rng, origin, yaw, float(rng.uniform(0.42, 0.5)))
        case "crate":
            side = float(rng.uniform(0.28, 0.45))
            chart = _wood(rng, Canvas(side, side, 400.0)) if rng.random() < 0.5 else _print(rng, side, side)
            return box(frame, (side, side * float(rng.uniform(0.7, 1.3)), side), chart)
        case "ball":
            return [ball(frame, float(rng.uniform(0.11, 0.3)), _print(rng, 0.8, 0.4))]
        case "suitcase":
            rods = (frame.offset_by(x, 0.62, 0.0) for x in (-0.1, 0.1))
            grip = [cylinder(rod, 0.009, 0.3, plain_chart(np.full(3, 0.3))) for rod in rods]
            return [*box(frame, (0.42, 0.62, 0.24), _print(rng, 0.42, 0.62)), *grip]
        case "table":
            return [
                profile_solid(
                    frame, "table", _wood(rng, Canvas(0.5, 0.5, 300.0)), float(rng.uniform(0.5, 0.75))
                )
            ]
        case "lamp":
            tall = float(rng.uniform(1.2, 1.6))
            metal = plain_chart(np.full(3, rng.uniform(0.1, 0.6)))
            shade = profile_solid(frame, "shade", _print(rng, 0.8, 0.3), tall)
            return [profile_solid(frame, "lamp", metal, tall), shade]
    return _plant(rng, frame)


def _plant(rng: np.random.Generator, frame: Frame) -> list[Patch]:
    """Make a pot with broad leaves."""
    patches = [profile_solid(frame, "pot", _print(rng, 0.6, 0.27))]
    green = hsv(rng.uniform(0.22, 0.38), rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6))
    s, phi = np.meshgrid(np.linspace(0, 1, 14), np.linspace(-np.pi, np.pi, 11), indexing="ij")
    canvas = Canvas(0.1, 0.3, 300.0)
    chart = np.clip(green * (1 + 0.12 * canvas.noise(rng, 0.02, 0.1))[..., None], 0, 1)
    for k in range(int(rng.integers(7, 12))):
        tall = rng.uniform(0.35, 0.8)
        reach = rng.uniform(0.1, 0.34)
        wide = rng.uniform(0.03, 0.07) * np.sqrt(np.clip(np.sin(np.pi * np.clip(s, 0.02, 1)), 0, 1)) + 0.004
        turn = Frame(frame.origin, rotation(1, 2.4 * k))
        rise = 0.22 + tall * np.sin(s * 1.8) / np.sin(1.6)
        x = wide * np.sin(phi)
        z = 0.02 + reach * s**1.5 + 0.006 * np.cos(phi)
        patches.append(turn.patch(np.stack([x, rise, z], -1), chart))
    return patches


def held_prop(kind: str, rng: np.random.Generator, body: Body, side: str) -> list[Patch]:
    """Make one of `HELD` in a hand in the bind pose."""
    H = body.height_m
    arm = body.arms[0 if side == "left" else 1]
    along = -arm.frame[1]
    forward = arm.frame[2]
    palm = np.cross(along, forward) * SIGN[side]
    grip = body.skeleton.at(f"{side}_hand") + 0.058 * H * along + 0.024 * H * palm
    # The hand's own up is towards the thumb: a fist holds a stick that way.
    across = np.cross(forward, along)
    frame = Frame(grip, np.stack([across, forward, np.cross(across, forward)], 1), f"{side}_hand")
    hanging = replace(frame, axes=np.stack([forward, -along, np.cross(forward, -along)], 1))
    color = hsv(rng.random(), rng.uniform(0.2, 0.9), rng.uniform(0.3, 0.95))
    match kind:
        case "staff":
            return [
                cylinder(
                    frame.offset_by(0.0, -0.6, 0.0),
                    0.013,
                    float(rng.uniform(1.0, 1.3)),
                    _print(rng, 0.1, 0.9),
                )
            ]
        case "cup" | "bottle":
            return [profile_solid(frame, kind, _print(rng, 0.2, 0.15), columns=17)]
        case "ball":
            below = replace(frame, origin=grip + palm * 0.10 - forward * 0.115)
            return [ball(below, 0.115, _print(rng, 0.7, 0.35))]
        case "bag":
            loop = cylinder(hanging.offset_by(0.0, -0.12, 0.0), 0.008, 0.13, plain_chart(0.5 * color))
            return [
                *box(hanging.offset_by(0.0, -0.44, 0.0), (0.30, 0.32, 0.11), _print(rng, 0.30, 0.32)),
                loop,
            ]
    size = (0.15, 0.21, 0.025) if kind == "book" else (0.17, 0.24, 0.009)
    flat = replace(hanging, origin=grip + 0.14 * along + 0.02 * palm)
    return box(flat, size, _print(rng, size[0], size[1]))
