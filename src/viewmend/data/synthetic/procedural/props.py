"""Things: held in a hand, or standing on the floor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from viewmend.data.synthetic.procedural.body import Body, one_joint, unit_grid
from viewmend.data.synthetic.procedural.fabric import (
    Canvas,
    Fabric,
    Image,
    Patch,
    blend,
    edge,
    hsv,
    sample_fabric,
    wave,
)
from viewmend.data.synthetic.procedural.skeleton import SIGN, Rotation, Skeleton, Vector, rotation

HELD = ("ball", "cup", "book", "bag", "staff", "bottle", "tablet")
STANDING = ("crate", "plant", "lamp", "ball", "suitcase", "table", "stool")


@dataclass(frozen=True)
class Frame:
    """Where a thing is in the bind pose or the world, and the joint it follows."""

    origin: Vector
    axes: Rotation
    """Columns: the thing's x, y (up) and z."""
    joint: str = "pelvis"

    def patch(self, local: Float[np.ndarray, "row column 3"], chart: Image, closed: bool = True) -> Patch:
        """A sheet given in the thing's own coordinates."""
        points = local @ self.axes.T + self.origin
        return Patch(points, unit_grid(local.shape), one_joint(local.shape[:2], self.joint), chart, closed=closed)


def turned_solid(frame: Frame, profile: Float[np.ndarray, "knot 2"], chart: Image, columns: int = 29) -> Patch:
    """A solid of revolution about y, from (radius, height) knots that go up; repeated knots make sharp edges."""
    phi = np.linspace(-np.pi, np.pi, columns)
    r, y = profile[:, :1], np.broadcast_to(profile[:, 1:], (len(profile), columns))
    return frame.patch(np.stack([r * np.sin(phi), y, r * np.cos(phi)], -1), chart)


def cylinder(frame: Frame, radius: float, low: float, high: float, chart: Image) -> Patch:
    """A closed cylinder with sharp rims."""
    knots = [(0, low), (radius, low), (radius, low), (radius, high), (radius, high), (0, high)]
    return turned_solid(frame, np.array(knots, dtype=np.float64), chart, 17)


def ball(frame: Frame, radius: float, chart: Image) -> Patch:
    """A sphere on its lowest point."""
    polar = np.linspace(-np.pi / 2, np.pi / 2, 17)
    knots = np.stack([radius * np.cos(polar), radius * (1 + np.sin(polar))], 1)
    return turned_solid(frame, knots, chart, 25)


def box(frame: Frame, size: tuple[float, float, float], chart: Image) -> list[Patch]:
    """Six sides, each with the whole chart; x and z are centred, y starts at 0."""
    w, h, d = size[0] / 2, size[1], size[2] / 2
    sides = []
    for k in range(4):
        wide, deep = (w, d) if k % 2 == 0 else (d, w)
        corners = np.array([[(-wide, 0, deep), (wide, 0, deep)], [(-wide, h, deep), (wide, h, deep)]])
        sides.append(corners @ rotation(1, k * np.pi / 2).T)
    sides.append(np.array([[(-w, h, d), (w, h, d)], [(-w, h, -d), (w, h, -d)]]))
    sides.append(np.array([[(-w, 0, -d), (w, 0, -d)], [(-w, 0, d), (w, 0, d)]]))
    return [frame.patch(side, chart, closed=False) for side in sides]


def plain_chart(color: Vector, size: int = 8) -> Image:
    """One colour."""
    return np.broadcast_to(color, (size, size, 3)).astype(np.float64)


def _wood(rng: np.random.Generator, canvas: Canvas) -> Image:
    color = hsv(rng.uniform(0.05, 0.1), rng.uniform(0.35, 0.65), rng.uniform(0.3, 0.75))
    grain = 0.12 * canvas.noise(rng, 0.012, 0.25) + 0.05 * canvas.noise(rng, 0.003, 0.1)
    planks = wave(canvas.x, 0.11, 0.03, canvas)
    return np.clip(blend(color * (1 + grain[..., None]), 0.4 * color, planks), 0, 1)


def _print(rng: np.random.Generator, width: float, height: float) -> Image:
    fabric: Fabric = sample_fabric(rng)
    canvas = Canvas(width, height, 400.0)
    rim = np.minimum(np.minimum(canvas.y, height - canvas.y), np.minimum(canvas.x + width / 2, width / 2 - canvas.x))
    image = fabric.paint(canvas)
    return blend(image, 0.5 * image, edge(0.006 - rim, canvas))


def stool(rng: np.random.Generator, origin: Vector, yaw: float, height_m: float) -> list[Patch]:
    """A seat of this height: round on four legs, or a block."""
    frame = Frame(origin, rotation(1, yaw))
    if rng.random() < 0.4:
        return box(frame, (0.38, height_m, 0.38), _print(rng, 0.38, height_m))
    wood = _wood(rng, Canvas(0.4, 0.4, 300.0))
    thick, r = 0.045, 0.19
    knots = [(0, height_m - thick), (r, height_m - thick), (r, height_m - thick)]
    knots += [(r + 0.005, height_m - thick / 2), (r, height_m - 0.004), (r - 0.02, height_m), (0, height_m)]
    patches = [turned_solid(frame, np.array(knots), wood)]
    for k in range(4):
        angle = np.pi / 4 + k * np.pi / 2
        foot = frame.axes @ (0.13 * np.array([np.sin(angle), 0, np.cos(angle)]))
        leg = Frame(origin + foot, frame.axes)
        patches.append(cylinder(leg, 0.018, 0.0, height_m - thick, wood[:64, :64]))
    return patches


def standing_prop(kind: str, rng: np.random.Generator, origin: Vector, yaw: float) -> list[Patch]:
    """One of `STANDING` on the floor at `origin`."""
    frame = Frame(origin, rotation(1, yaw))
    if kind == "stool":
        return stool(rng, origin, yaw, float(rng.uniform(0.42, 0.5)))
    if kind == "crate":
        side = float(rng.uniform(0.28, 0.45))
        chart = _wood(rng, Canvas(side, side, 400.0)) if rng.random() < 0.5 else _print(rng, side, side)
        return box(frame, (side, side * float(rng.uniform(0.7, 1.3)), side), chart)
    if kind == "ball":
        return [ball(frame, float(rng.uniform(0.11, 0.3)), _print(rng, 0.8, 0.4))]
    if kind == "suitcase":
        body = box(frame, (0.42, 0.62, 0.24), _print(rng, 0.42, 0.62))
        grip = Frame(origin + np.array([0, 0.62, 0]), frame.axes)
        return [
            *body,
            *(cylinder(_beside(grip, x), 0.009, 0.0, 0.3, plain_chart(np.full(3, 0.3))) for x in (-0.1, 0.1)),
        ]
    if kind == "table":
        wood = _wood(rng, Canvas(0.5, 0.5, 300.0))
        tall = float(rng.uniform(0.5, 0.75))
        knots = np.array([(0, 0), (0.16, 0), (0.16, 0.02), (0.025, 0.04), (0.025, tall - 0.03), (0.27, tall - 0.03)])
        top = np.array([(0.27, tall - 0.03), (0.27, tall), (0.27, tall), (0, tall)])
        return [turned_solid(frame, np.concatenate([knots, top]), wood)]
    if kind == "lamp":
        tall = float(rng.uniform(1.2, 1.6))
        metal = plain_chart(np.full(3, rng.uniform(0.1, 0.6)))
        pole = np.array([(0, 0), (0.14, 0), (0.14, 0.02), (0.012, 0.03), (0.012, tall - 0.2), (0, tall - 0.2)])
        shade = np.array(
            [(0, tall - 0.25), (0.19, tall - 0.25), (0.19, tall - 0.25), (0.11, tall), (0.11, tall), (0, tall)]
        )
        return [turned_solid(frame, pole, metal), turned_solid(frame, shade, _print(rng, 0.8, 0.3))]
    return _plant(rng, frame)


def _beside(frame: Frame, x: float) -> Frame:
    return Frame(frame.origin + frame.axes[:, 0] * x, frame.axes, frame.joint)


def _plant(rng: np.random.Generator, frame: Frame) -> list[Patch]:
    """A pot with broad leaves."""
    pot = np.array([(0, 0), (0.10, 0), (0.10, 0), (0.15, 0.27), (0.15, 0.27), (0.13, 0.27), (0.13, 0.24), (0, 0.24)])
    patches = [turned_solid(frame, pot, _print(rng, 0.6, 0.27))]
    green = hsv(rng.uniform(0.22, 0.38), rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6))
    s, phi = np.meshgrid(np.linspace(0, 1, 14), np.linspace(-np.pi, np.pi, 11), indexing="ij")
    canvas = Canvas(0.1, 0.3, 300.0)
    chart = np.clip(green * (1 + 0.12 * canvas.noise(rng, 0.02, 0.1))[..., None], 0, 1)
    for k in range(int(rng.integers(7, 12))):
        tall, reach = rng.uniform(0.35, 0.8), rng.uniform(0.1, 0.34)
        wide = rng.uniform(0.03, 0.07) * np.sqrt(np.clip(np.sin(np.pi * np.clip(s, 0.02, 1)), 0, 1)) + 0.004
        turn = Frame(frame.origin, rotation(1, 2.4 * k))
        rise = 0.22 + tall * np.sin(s * 1.8) / np.sin(1.6)
        x, z = wide * np.sin(phi), 0.02 + reach * s**1.5 + 0.006 * np.cos(phi)
        patches.append(turn.patch(np.stack([x, rise, z], -1), chart))
    return patches


def held_prop(
    kind: str, rng: np.random.Generator, body: Body, skeleton: Skeleton, height_m: float, side: str
) -> list[Patch]:
    """One of `HELD`, in the bind pose of this hand."""
    H = height_m
    arm = body.arms[0 if side == "left" else 1]
    along, forward = -arm.frame[1], arm.frame[2]
    palm = np.cross(along, forward) * SIGN[side]
    grip = skeleton.at(f"{side}_hand") + 0.058 * H * along + 0.024 * H * palm
    # The hand's own up is towards the thumb: a fist holds a stick that way.
    across = np.cross(forward, along)
    axes = np.stack([across, forward, np.cross(across, forward)], 1)
    frame = Frame(grip, axes, f"{side}_hand")

    def moved(x: float, y: float, z: float) -> Frame:
        return Frame(grip + axes @ np.array([x, y, z]), axes, frame.joint)

    color = hsv(rng.random(), rng.uniform(0.2, 0.9), rng.uniform(0.3, 0.95))
    if kind == "staff":
        return [cylinder(moved(0.0, -0.6, 0.0), 0.013, 0.0, float(rng.uniform(1.0, 1.3)), _print(rng, 0.1, 0.9))]
    if kind in ("cup", "bottle"):
        r = 0.036 if kind == "cup" else 0.03
        knots = [(0, -0.05), (0.85 * r, -0.05), (0.85 * r, -0.05), (r, 0.05), (r, 0.05), (0.8 * r, 0.045), (0, 0.045)]
        if kind == "bottle":
            knots = [(0, -0.08), (r, -0.08), (r, -0.08), (r, 0.06), (0.012, 0.1), (0.012, 0.13), (0, 0.13)]
        return [turned_solid(frame, np.array(knots), _print(rng, 0.2, 0.15), 17)]
    if kind == "ball":
        out = palm * 0.10
        return [ball(Frame(grip + out - axes[:, 1] * 0.115, axes, frame.joint), 0.115, _print(rng, 0.7, 0.35))]
    if kind == "bag":
        hang = np.stack([forward, -along, np.cross(forward, -along)], 1)
        low = Frame(grip + 0.44 * along, hang, frame.joint)
        loop = cylinder(Frame(grip + 0.12 * along, hang, frame.joint), 0.008, 0.0, 0.13, plain_chart(0.5 * color))
        return [*box(low, (0.30, 0.32, 0.11), _print(rng, 0.30, 0.32)), loop]
    size = (0.15, 0.21, 0.025) if kind == "book" else (0.17, 0.24, 0.009)
    flat = np.stack([forward, -along, np.cross(forward, -along)], 1)
    chart = _print(rng, size[0], size[1])
    return box(Frame(grip + 0.14 * along + 0.02 * palm, flat, frame.joint), size, chart)
