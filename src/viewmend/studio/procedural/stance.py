"""One moment of a motion in a performer's own terms, and its solution: the world transform of every joint."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.skeleton import (
    ARM_ANGLE_RAD,
    INDEX,
    PARENTS,
    SIDES,
    SIGN,
    SKIRT_COLUMNS,
    Rotation,
    Skeleton,
    Transforms,
    Vector,
    hinge_frame,
    joint_origin,
    rotation,
    two_bone,
    unit,
)


@dataclass(frozen=True)
class ArmPose:
    """Angles of an arm against hanging straight down, radians; or a place for the wrist."""

    flexion: float = 0.0
    """Forward and up."""
    abduction: float = 0.15
    """Away from the side, before flexion."""
    twist: float = 0.2
    """Inward about the upper arm."""
    elbow: float = 0.25
    curl: float = 0.3
    """How far the fingers are curled."""
    target: Vector | None = None
    """World place of the wrist, metres; the angles above then do not count."""


@dataclass(frozen=True)
class FootPose:
    """A foot: where the point below the ankle would be on a flat sole (world metres), where it points, its pitch."""

    place: Vector
    yaw: float
    pitch: float = 0.0
    """Positive: the tip is up and the heel down; negative: the heel is up. The lower end keeps its place."""


@dataclass(frozen=True)
class Stance:
    """A whole body at one moment. Angles in radians; lean and bend are forward, side and roll to the left."""

    pelvis: Vector
    yaw: float
    feet: tuple[FootPose, FootPose]
    arms: tuple[ArmPose, ArmPose]
    lean: float = 0.0
    roll: float = 0.0
    sway: float = 0.0
    """Turn of the pelvis against the heading."""
    bend: float = 0.0
    side: float = 0.0
    twist: float = 0.0
    nod: float = 0.0
    look: float = 0.0
    tilt: float = 0.0
    knees_out: float = 0.1


def solve(skeleton: Skeleton, stance: Stance, before: Stance, elapsed_s: float) -> Transforms:
    """world_from_bind of every joint; `before` is the stance `elapsed_s` earlier, for what swings behind."""
    world = np.tile(np.eye(4), (len(INDEX), 1, 1))
    heading = rotation(1, stance.yaw)
    R = heading @ rotation(1, stance.sway) @ rotation(0, stance.lean) @ rotation(2, -stance.roll)
    world[0, :3, :3] = R
    world[0, :3, 3] = _reachable(skeleton, stance, R) - R @ skeleton.positions[0]
    third = rotation(1, stance.twist / 3) @ rotation(0, stance.bend / 3) @ rotation(2, -stance.side / 3)
    for name in ("spine", "chest", "upper"):
        R = R @ third
        skeleton.place(INDEX[name], R, world)
    half = rotation(1, stance.look / 2) @ rotation(0, stance.nod / 2) @ rotation(2, -stance.tilt / 2)
    for name in ("neck", "head"):
        R = R @ half
        skeleton.place(INDEX[name], R, world)
    for i, side in enumerate(SIDES):
        _place_arm(skeleton, side, stance.arms[i], world)
        _place_leg(skeleton, side, stance.feet[i], stance, world)
    _hang(skeleton, stance, before, elapsed_s, world)
    return world


def _ankle(skeleton: Skeleton, side: str, foot: FootPose) -> tuple[Vector, Rotation]:
    """World place of the ankle and rotation of the foot, which turns about its ball or its heel."""
    ankle, toe = skeleton.at(f"{side}_foot"), skeleton.at(f"{side}_toe")
    reach = float(toe[2] - ankle[2]) if foot.pitch < 0 else -0.45 * float(toe[2] - ankle[2])
    pivot = np.array([0.0, -ankle[1], reach])
    turn = rotation(1, foot.yaw)
    R = turn @ rotation(0, -foot.pitch)
    return foot.place + np.array([0, ankle[1], 0]) + turn @ pivot - R @ pivot, R


def _reachable(skeleton: Skeleton, stance: Stance, R: Rotation) -> Vector:
    """The pelvis, lowered where a leg would be too short for its foot."""
    pelvis = stance.pelvis.copy()
    for i, side in enumerate(SIDES):
        ankle, _ = _ankle(skeleton, side, stance.feet[i])
        hip = pelvis + R @ (skeleton.at(f"{side}_thigh") - skeleton.at("pelvis"))
        leg = skeleton.length(f"{side}_thigh", f"{side}_shin") + skeleton.length(f"{side}_shin", f"{side}_foot")
        flat = float(np.hypot(*(hip - ankle)[[0, 2]]))
        highest = ankle[1] + np.sqrt(max((0.992 * leg) ** 2 - flat**2, 0.01))
        # max(0, missing), rounded within two centimetres: a kink would jerk the whole body.
        missing = float(hip[1] - highest)
        pelvis[1] -= 0.5 * (missing + float(np.hypot(missing, 0.02)))
    return pelvis


def _place_leg(skeleton: Skeleton, side: str, foot: FootPose, stance: Stance, world: Transforms) -> None:
    hip_parent = world[INDEX["pelvis"]]
    hip = hip_parent[:3, :3] @ skeleton.at(f"{side}_thigh") + hip_parent[:3, 3]
    ankle, foot_R = _ankle(skeleton, side, foot)
    names = [f"{side}_{part}" for part in ("thigh", "shin", "foot", "toe")]
    lengths = (skeleton.length(names[0], names[1]), skeleton.length(names[1], names[2]))
    out = SIGN[side] * stance.knees_out
    yaw = stance.yaw + 0.5 * float(np.arctan2(np.sin(foot.yaw - stance.yaw), np.cos(foot.yaw - stance.yaw)))
    pole = rotation(1, yaw + out) @ np.array([0.0, 0.45, 1.0])
    thigh, shin, hinge = two_bone(hip, ankle, lengths, pole)
    for i, along in ((0, thigh), (1, shin)):
        bind = hinge_frame(skeleton.at(names[i + 1]) - skeleton.at(names[i]), np.array([1.0, 0, 0]))
        skeleton.place(INDEX[names[i]], hinge_frame(along, hinge) @ bind.T, world)
    skeleton.place(INDEX[names[2]], foot_R, world)
    flat = rotation(1, foot.yaw) @ rotation(0, -max(foot.pitch, 0.0))
    skeleton.place(INDEX[names[3]], flat, world)


def _place_arm(skeleton: Skeleton, side: str, arm: ArmPose, world: Transforms) -> None:
    s = SIGN[side]
    names = [f"{side}_{part}" for part in ("clavicle", "upperarm", "forearm", "hand", "fingers")]
    chest = world[INDEX["upper"], :3, :3]
    hanging = rotation(2, -s * ARM_ANGLE_RAD)
    raised = max(0.0, arm.abduction - 0.6) + 0.5 * max(0.0, arm.flexion - 0.9)
    lift = 0.0 if arm.target is not None else 0.28 * float(np.tanh(raised))
    skeleton.place(INDEX[names[0]], chest @ rotation(2, s * lift), world)
    if arm.target is None:
        R = chest @ rotation(0, -arm.flexion) @ rotation(2, s * arm.abduction) @ rotation(1, -s * arm.twist)
        upper, fore = R @ hanging, R @ rotation(0, -arm.elbow) @ hanging
    else:
        clavicle = world[INDEX[names[0]]]
        shoulder = clavicle[:3, :3] @ skeleton.at(names[1]) + clavicle[:3, 3]
        lengths = (skeleton.length(names[1], names[2]), skeleton.length(names[2], names[3]))
        pole = chest @ np.array([0.6 * s, -1.0, -0.7])
        along, second, hinge = two_bone(shoulder, arm.target, lengths, pole)
        upper, fore = (hinge_frame(bone, -hinge) @ hanging for bone in (along, second))
    skeleton.place(INDEX[names[1]], upper, world)
    skeleton.place(INDEX[names[2]], fore, world)
    skeleton.place(INDEX[names[3]], fore, world)
    curl = hanging.T @ rotation(2, -s * arm.curl) @ hanging
    skeleton.place(INDEX[names[4]], fore @ curl, world)


def _hang(skeleton: Skeleton, stance: Stance, before: Stance, elapsed_s: float, world: Transforms) -> None:
    """Place the columns of a skirt, held off by the legs and pulled down by weight, and the tail of the hair."""
    pelvis = world[0, :3, :3]
    speed = pelvis.T @ (stance.pelvis - before.pelvis) / elapsed_s
    turning = (stance.yaw + stance.sway - before.yaw - before.sway) / elapsed_s
    weight = pelvis.T @ np.array([0.0, -1.0, 0.0])
    bones = {}
    for segment, first, last in (("high", "thigh", "shin"), ("low", "shin", "foot")):
        ends = [
            joint_origin(skeleton, f"{s}_{last}", world) - joint_origin(skeleton, f"{s}_{first}", world) for s in SIDES
        ]
        bones[segment] = np.array([pelvis.T @ unit(end) for end in ends] + [weight])
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
        R = pelvis @ spin @ _tilted(outward, tilt)
        bind = skeleton.positions[joints]
        origins = np.einsum("cij,cj->ci", world[parents, :3, :3], bind) + world[parents, :3, 3]
        world[joints, :3, :3] = R
        world[joints, :3, 3] = origins - np.einsum("cij,cj->ci", R, bind)
    head = world[INDEX["head"], :3, :3]
    drop = unit(0.6 * np.array([0, -1.0, 0]) + 0.4 * head @ np.array([0, -1.0, 0]) - 0.15 * pelvis @ speed)
    lag = rotation(1, -0.5 * float(np.tanh(turning / 4)))
    skeleton.place(INDEX["tail"], lag @ hinge_frame(drop, head @ np.array([1.0, 0, 0])), world)


def _tilted(
    outward: Float[np.ndarray, "column 3"], angle_rad: Float[np.ndarray, "column"]
) -> Float[np.ndarray, "column 3 3"]:
    """Rotations that lift what hangs down (-y) towards `outward` by these angles: (column, 3, 3)."""
    x, z = outward[:, 0], outward[:, 2]
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    # In the plane of `outward` and y; what is across both stays.
    rows = [
        [1 + (c - 1) * x * x, -s * x, (c - 1) * x * z],
        [s * x, c, s * z],
        [(c - 1) * x * z, -s * z, 1 + (c - 1) * z * z],
    ]
    return np.array(rows).transpose(2, 0, 1)
