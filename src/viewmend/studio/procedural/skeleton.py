"""The performers' skeleton: joints, body builds, and poses by two-bone inverse kinematics.

The bind pose is an A-pose that faces +z, left side at +x, arms `ARM_ANGLE_RAD` away from hanging
straight down.
"""

import itertools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, "3"]
Rotation = Float[np.ndarray, "3 3"]
Transforms = Float[np.ndarray, "joint 4 4"]
"""The world_from_bind of every joint."""
Values = Float[np.ndarray, "*n"]
Points = Float[np.ndarray, "*n 3"]
Weights = Float[np.ndarray, "*n joint"]
"""Skinning weights, dense over the joints."""

TABLES: dict[str, Any] = tomllib.loads((files("viewmend.studio.procedural") / "tables.toml").read_text())
"""Tables by name; comments in the file name their columns."""

ARM_ANGLE_RAD = np.radians(48.0)
SKIRT_COLUMNS = 8

SPINE = ("pelvis", "spine", "chest", "upper", "neck", "head")
ARM = ("clavicle", "upperarm", "forearm", "hand", "fingers")
LEG = ("thigh", "shin", "foot", "toe")
SIDES = ("left", "right")
_CHAINS = (
    SPINE,
    *(
        (root, *(f"{s}_{name}" for name in limb))
        for s in SIDES
        for root, limb in (("upper", ARM), ("pelvis", LEG))
    ),
    *(("pelvis", f"skirt{column}_high", f"skirt{column}_low") for column in range(SKIRT_COLUMNS)),
    ("head", "tail"),
)
_PARENT = {child: parent for chain in _CHAINS for parent, child in itertools.pairwise(chain)}
JOINTS: tuple[str, ...] = ("pelvis", *_PARENT)
INDEX: dict[str, int] = {name: i for i, name in enumerate(JOINTS)}
PARENTS: tuple[int, ...] = (-1, *(INDEX[name] for name in _PARENT.values()))
SIGN = {"left": 1.0, "right": -1.0}
"""Sign of x on each side of the body."""
SKIN_RGB = np.array(TABLES["skin"])
"""Skin tones, sRGB in [0, 1]."""


def rotation(axis: int, angle_rad: float) -> Rotation:
    """Rotation about coordinate axis 0, 1 or 2."""
    c = np.cos(angle_rad)
    s = np.sin(angle_rad)
    R = np.eye(3)
    i = (axis + 1) % 3
    j = (axis + 2) % 3
    R[i, i] = c
    R[i, j] = -s
    R[j, i] = s
    R[j, j] = c
    return R


def unit(v: Points) -> Points:
    """Normalise vectors."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def hinge_frame(along: Vector, hinge: Vector) -> Rotation:
    """Compute the rotation with -y axis `along` (a bone) and an x axis as close to `hinge` as possible."""
    y = -unit(along)
    z = unit(np.cross(hinge, y))
    return np.stack([np.cross(y, z), y, z], axis=1)


def two_bone(start: Vector, target: Vector, lengths: tuple[float, float], pole: Vector) -> tuple[Vector, ...]:
    """Compute the directions of a limb's two bones from `start` to `target`, and the hinge.

    The middle joint is bent towards `pole`.

    A target out of reach is replaced by the nearest point the limb does reach.
    """
    a, b = lengths
    reach = target - start
    distance = float(np.clip(np.linalg.norm(reach), abs(a - b) + 1e-3, (a + b) * 0.9995))
    along = unit(reach)
    cosine = (a * a + distance * distance - b * b) / (2 * a * distance)
    sideways = unit(pole - along * (pole @ along))
    middle = a * (cosine * along + np.sqrt(max(0.0, 1 - cosine * cosine)) * sideways)
    return middle, distance * along - middle, np.cross(sideways, along)


@dataclass(frozen=True)
class Skeleton:
    """Bind positions of `JOINTS`, metres."""

    positions: Float[np.ndarray, "joint 3"]

    def at(self, name: str) -> Vector:
        """Bind position of this joint."""
        return self.positions[INDEX[name]]

    def length(self, first: str, second: str) -> float:
        """Distance between two joints in the bind pose, metres."""
        return float(np.linalg.norm(self.at(second) - self.at(first)))

    def move_joint(self, name: str, motion: Float[np.ndarray, "4 4"]) -> Vector:
        """Move a joint of the bind pose by a motion; world metres."""
        return motion[:3, :3] @ self.at(name) + motion[:3, 3]

    def place(self, name: str, R: Rotation, world_from_bind: Transforms) -> None:
        """Set a joint to the world rotation R, at the position to which its parent carries it."""
        joint = INDEX[name]
        origin = self.move_joint(name, world_from_bind[PARENTS[joint]])
        world_from_bind[joint, :3, :3] = R
        world_from_bind[joint, :3, 3] = origin - R @ self.at(name)


@dataclass(frozen=True, kw_only=True)
class Physique:
    """A person's build. Lengths elsewhere are fractions of `height_m` unless their names end in _m."""

    height_m: float
    femininity: float
    """Femininity from 0 to 1: shoulders, hips, waist, bust, neck and jaw."""
    weight: float
    """Weight: -1 is thin, 0 average, 1.6 heavy."""
    muscle: float
    """Muscularity from 0 to 1."""
    leg_share: float
    """Length of the legs relative to the average."""
    skin_rgb: tuple[float, float, float]
    """sRGB."""
    face: tuple[float, ...]
    """Eight numbers in [-1, 1] for the individual sizes and positions of facial features."""


def sample_physique(rng: np.random.Generator) -> Physique:
    """Sample a person's build."""
    feminine = bool(rng.random() < 0.5)
    height = rng.normal(1.66, 0.07) if feminine else rng.normal(1.78, 0.08)
    tone = rng.uniform(0, len(SKIN_RGB) - 1)
    red, green, blue = (float(np.interp(tone, np.arange(len(SKIN_RGB)), column)) for column in SKIN_RGB.T)
    return Physique(
        height_m=float(np.clip(height, 1.5, 1.95)),
        femininity=float(np.clip(rng.normal(0.92 if feminine else 0.08, 0.08), 0, 1)),
        weight=float(np.clip(rng.normal(0.1, 0.5), -0.8, 1.6)),
        muscle=float(rng.uniform(0.1, 0.9)),
        leg_share=float(np.clip(rng.normal(1.0, 0.025), 0.95, 1.05)),
        skin_rgb=(red, green, blue),
        face=tuple(float(v) for v in rng.uniform(-1, 1, 8)),
    )


def build_skeleton(person: Physique) -> Skeleton:
    """Compute the joints' bind positions of a person."""
    places: dict[str, Any] = dict(TABLES["trunk"])
    shoulder = 0.106 - 0.011 * person.femininity + 0.003 * person.muscle
    hip = 0.049 + 0.004 * person.femininity
    arm = np.array([np.sin(ARM_ANGLE_RAD), -np.cos(ARM_ANGLE_RAD), 0.0])
    for side in SIDES:
        mirror = np.array([SIGN[side], 1, 1])
        places[f"{side}_clavicle"] = mirror * (0.018, 0.80, -0.004)
        for part, reach in zip(ARM[1:], (0.0, 0.168, 0.312, 0.366), strict=True):
            places[f"{side}_{part}"] = mirror * (np.array([shoulder, 0.795, -0.013]) + reach * arm)
        for part, (x, y, z) in zip(LEG, TABLES["leg_joints"], strict=True):
            places[f"{side}_{part}"] = mirror * (hip + x, y, z)
    for column in range(SKIRT_COLUMNS):
        x = np.sin(2 * np.pi * column / SKIRT_COLUMNS)
        z = np.cos(2 * np.pi * column / SKIRT_COLUMNS)
        places[f"skirt{column}_high"] = (0.07 * x, 0.57, 0.045 * z)
        places[f"skirt{column}_low"] = (0.09 * x, 0.40, 0.07 * z)
    positions = np.array([places[name] for name in JOINTS], dtype=np.float64)
    trunk = np.array([not name.endswith(ARM) for name in JOINTS])
    positions[trunk, 1] = leg_stretch(positions[trunk, 1], person.leg_share)
    return Skeleton(positions * person.height_m)


def leg_stretch(y: Values, share: float) -> Values:
    """Scale the legs' part of heights (fractions) by `share`; ankles, shoulders and head stay."""
    return np.interp(y, [0.0, 0.043, 0.522, 0.797, 1.0], [0.0, 0.043, 0.522 * share, 0.797, 1.0])


@dataclass(frozen=True)
class ArmPose:
    """Angles of an arm relative to hanging straight down, radians; or a position of the wrist."""

    flexion: float = 0.0
    """Forward and up."""
    abduction: float = 0.0
    """Away from the side, before flexion."""
    twist: float = 0.0
    """Inward about the upper arm."""
    elbow: float = 0.0
    curl: float = 0.0
    """How far the fingers are curled."""
    target: Vector | None = None
    """World position of the wrist, metres, in place of the angles."""


@dataclass(frozen=True)
class FootPose:
    """A foot: world position of the point below the ankle on a flat sole (metres), direction and pitch."""

    place: Vector
    yaw: float
    pitch: float = 0.0
    """Pitch: positive lifts the tip, negative the heel. The lower end keeps its position."""


@dataclass(frozen=True)
class Stance:
    """A whole body at one moment. Angles in radians; lean and bend are forward, side and roll to the left."""

    pelvis: Vector
    yaw: float
    feet: list[FootPose]
    arms: Sequence[ArmPose] = ()
    lean: float = 0.0
    roll: float = 0.0
    sway: float = 0.0
    """Rotation of the pelvis relative to the heading."""
    bend: float = 0.0
    side: float = 0.0
    twist: float = 0.0
    nod: float = 0.0
    look: float = 0.0
    tilt: float = 0.0
    knees_out: float = 0.1

    def solve(self, skeleton: Skeleton, before: "Stance", elapsed_s: float) -> Transforms:
        """Compute world_from_bind of every joint.

        `before` is the stance `elapsed_s` earlier, which skirts and hair follow.
        """
        world = np.tile(np.eye(4), (len(INDEX), 1, 1))
        R = rotation(1, self.yaw) @ rotation(1, self.sway) @ rotation(0, self.lean) @ rotation(2, -self.roll)
        world[0, :3, :3] = R
        world[0, :3, 3] = _reachable(skeleton, self, R) - R @ skeleton.positions[0]
        third = rotation(1, self.twist / 3) @ rotation(0, self.bend / 3) @ rotation(2, -self.side / 3)
        half = rotation(1, self.look / 2) @ rotation(0, self.nod / 2) @ rotation(2, -self.tilt / 2)
        for name, turn in zip(SPINE[1:], (third, third, third, half, half), strict=True):
            R = R @ turn
            skeleton.place(name, R, world)
        for i, side in enumerate(SIDES):
            _place_arm(skeleton, side, self.arms[i], world)
            _place_leg(skeleton, side, self.feet[i], self, world)
        _place_hanging(skeleton, self, before, elapsed_s, world)
        return world


def _ankle(skeleton: Skeleton, side: str, foot: FootPose) -> tuple[Vector, Rotation]:
    """World position of the ankle and rotation of the foot, which turns about its ball or its heel."""
    ankle = skeleton.at(f"{side}_foot")
    toe = skeleton.at(f"{side}_toe")
    reach = float(toe[2] - ankle[2]) if foot.pitch < 0 else -0.45 * float(toe[2] - ankle[2])
    pivot = np.array([0.0, -ankle[1], reach])
    turn = rotation(1, foot.yaw)
    R = turn @ rotation(0, -foot.pitch)
    return foot.place + np.array([0, ankle[1], 0]) + turn @ pivot - R @ pivot, R


def _reachable(skeleton: Skeleton, stance: Stance, R: Rotation) -> Vector:
    """Lower the pelvis until both legs reach their feet."""
    pelvis = stance.pelvis.copy()
    for i, side in enumerate(SIDES):
        ankle, _ = _ankle(skeleton, side, stance.feet[i])
        hip = pelvis + R @ (skeleton.at(f"{side}_thigh") - skeleton.at("pelvis"))
        leg = skeleton.length(f"{side}_thigh", f"{side}_shin") + skeleton.length(
            f"{side}_shin", f"{side}_foot"
        )
        flat = float(np.hypot(*(hip - ankle)[[0, 2]]))
        highest = ankle[1] + np.sqrt(max((0.992 * leg) ** 2 - flat**2, 0.01))
        # max(0, missing), rounded within two centimetres: a kink would jerk the whole body.
        missing = float(hip[1] - highest)
        pelvis[1] -= 0.5 * (missing + float(np.hypot(missing, 0.02)))
    return pelvis


def _place_leg(skeleton: Skeleton, side: str, foot: FootPose, stance: Stance, world: Transforms) -> None:
    hip = skeleton.move_joint(f"{side}_thigh", world[0])
    ankle, foot_R = _ankle(skeleton, side, foot)
    names = [f"{side}_{part}" for part in ("thigh", "shin", "foot", "toe")]
    lengths = (skeleton.length(names[0], names[1]), skeleton.length(names[1], names[2]))
    yaw = stance.yaw + 0.5 * float(np.arctan2(np.sin(foot.yaw - stance.yaw), np.cos(foot.yaw - stance.yaw)))
    pole = rotation(1, yaw + SIGN[side] * stance.knees_out) @ np.array([0.0, 0.45, 1.0])
    thigh, shin, hinge = two_bone(hip, ankle, lengths, pole)
    for i, along in ((0, thigh), (1, shin)):
        bind = hinge_frame(skeleton.at(names[i + 1]) - skeleton.at(names[i]), np.array([1.0, 0, 0]))
        skeleton.place(names[i], hinge_frame(along, hinge) @ bind.T, world)
    skeleton.place(names[2], foot_R, world)
    skeleton.place(names[3], rotation(1, foot.yaw) @ rotation(0, -max(foot.pitch, 0.0)), world)


def _place_arm(skeleton: Skeleton, side: str, arm: ArmPose, world: Transforms) -> None:
    s = SIGN[side]
    names = [f"{side}_{part}" for part in ("clavicle", "upperarm", "forearm", "hand", "fingers")]
    chest = world[INDEX["upper"], :3, :3]
    hanging = rotation(2, -s * ARM_ANGLE_RAD)
    lift = 0.28 * float(np.tanh(max(0.0, arm.abduction - 0.6) + 0.5 * max(0.0, arm.flexion - 0.9)))
    skeleton.place(names[0], chest @ rotation(2, s * lift), world)
    if arm.target is None:
        R = chest @ rotation(0, -arm.flexion) @ rotation(2, s * arm.abduction) @ rotation(1, -s * arm.twist)
        upper = R @ hanging
        fore = R @ rotation(0, -arm.elbow) @ hanging
    else:
        shoulder = skeleton.move_joint(names[1], world[INDEX[names[0]]])
        lengths = (skeleton.length(names[1], names[2]), skeleton.length(names[2], names[3]))
        pole = chest @ np.array([0.6 * s, -1.0, -0.7])
        along, second, hinge = two_bone(shoulder, arm.target, lengths, pole)
        upper, fore = (hinge_frame(bone, -hinge) @ hanging for bone in (along, second))
    fingers = fore @ (hanging.T @ rotation(2, -s * arm.curl) @ hanging)
    for name, R in zip(names[1:], (upper, fore, fore, fingers), strict=True):
        skeleton.place(name, R, world)


def _place_hanging(
    skeleton: Skeleton, stance: Stance, before: Stance, elapsed_s: float, world: Transforms
) -> None:
    """Place the columns of a skirt, held off by the legs and pulled down by weight, and the tail of the hair."""
    pelvis = world[0, :3, :3]
    speed = pelvis.T @ (stance.pelvis - before.pelvis) / elapsed_s
    turning = (stance.yaw + stance.sway - before.yaw - before.sway) / elapsed_s
    weight = pelvis.T @ np.array([0.0, -1.0, 0.0])
    bones = {}
    for segment, first, last in (("high", "thigh", "shin"), ("low", "shin", "foot")):
        ends = [
            [skeleton.move_joint(f"{s}_{part}", world[INDEX[f"{s}_{part}"]]) for part in (first, last)]
            for s in SIDES
        ]
        bones[segment] = np.array([pelvis.T @ unit(end - start) for start, end in ends] + [weight])
    azimuth = 2 * np.pi * np.arange(SKIRT_COLUMNS) / SKIRT_COLUMNS
    outward = np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], 1)
    for segment, give in (("high", 0.6), ("low", 1.0)):
        tilts = np.arctan2(outward @ bones[segment].T, -bones[segment][:, 1])
        tilt = np.log(np.exp(9 * tilts).mean(1)) / 9
        tilt = tilt + 0.07 + 0.09 * np.maximum(tilt, 0.0)
        tilt += give * (0.10 * abs(np.tanh(turning / 3)) - 0.22 * np.tanh(outward @ speed / 2))
        spin = rotation(1, -give * 0.25 * float(np.tanh(turning / 4)))
        joints = np.array([INDEX[f"skirt{column}_{segment}"] for column in range(SKIRT_COLUMNS)])
        parents = np.array([PARENTS[joint] for joint in joints])
        R = pelvis @ spin @ _tilt(outward, tilt)
        bind = skeleton.positions[joints]
        origins = np.einsum("cij,cj->ci", world[parents, :3, :3], bind) + world[parents, :3, 3]
        world[joints, :3, :3] = R
        world[joints, :3, 3] = origins - np.einsum("cij,cj->ci", R, bind)
    head = world[INDEX["head"], :3, :3]
    drop = unit(0.6 * np.array([0, -1.0, 0]) + 0.4 * head @ np.array([0, -1.0, 0]) - 0.15 * pelvis @ speed)
    lag = rotation(1, -0.5 * float(np.tanh(turning / 4)))
    skeleton.place("tail", lag @ hinge_frame(drop, head @ np.array([1.0, 0, 0])), world)


def _tilt(outward: Points, angle_rad: Values) -> Float[np.ndarray, "column 3 3"]:
    """Rotations that lift what hangs down (-y) towards `outward` by these angles."""
    x = outward[:, 0]
    z = outward[:, 2]
    c = np.cos(angle_rad)
    s = np.sin(angle_rad)
    # In the plane of `outward` and y; what is across both stays.
    rows = [
        [1 + (c - 1) * x * x, -s * x, (c - 1) * x * z],
        [s * x, c, s * z],
        [(c - 1) * x * z, -s * z, 1 + (c - 1) * z * z],
    ]
    return np.array(rows).transpose(2, 0, 1)
