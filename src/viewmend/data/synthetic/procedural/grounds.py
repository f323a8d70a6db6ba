"""What carries the body: where feet and pelvis are by time, for each kind of motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from viewmend.data.synthetic.procedural.skeleton import (
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
    feet: Sequence[FootPose]
    arms: Sequence[ArmPose]
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
        skeleton.place(name, R, world)
    half = rotation(1, stance.look / 2) @ rotation(0, stance.nod / 2) @ rotation(2, -stance.tilt / 2)
    for name in ("neck", "head"):
        R = R @ half
        skeleton.place(name, R, world)
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
    hip = skeleton.moved(f"{side}_thigh", world[0])
    ankle, foot_R = _ankle(skeleton, side, foot)
    names = [f"{side}_{part}" for part in ("thigh", "shin", "foot", "toe")]
    lengths = (skeleton.length(names[0], names[1]), skeleton.length(names[1], names[2]))
    out = SIGN[side] * stance.knees_out
    yaw = stance.yaw + 0.5 * float(np.arctan2(np.sin(foot.yaw - stance.yaw), np.cos(foot.yaw - stance.yaw)))
    pole = rotation(1, yaw + out) @ np.array([0.0, 0.45, 1.0])
    thigh, shin, hinge = two_bone(hip, ankle, lengths, pole)
    for i, along in ((0, thigh), (1, shin)):
        bind = hinge_frame(skeleton.at(names[i + 1]) - skeleton.at(names[i]), np.array([1.0, 0, 0]))
        skeleton.place(names[i], hinge_frame(along, hinge) @ bind.T, world)
    skeleton.place(names[2], foot_R, world)
    flat = rotation(1, foot.yaw) @ rotation(0, -max(foot.pitch, 0.0))
    skeleton.place(names[3], flat, world)


def _place_arm(skeleton: Skeleton, side: str, arm: ArmPose, world: Transforms) -> None:
    s = SIGN[side]
    names = [f"{side}_{part}" for part in ("clavicle", "upperarm", "forearm", "hand", "fingers")]
    chest = world[INDEX["upper"], :3, :3]
    hanging = rotation(2, -s * ARM_ANGLE_RAD)
    raised = max(0.0, arm.abduction - 0.6) + 0.5 * max(0.0, arm.flexion - 0.9)
    lift = 0.0 if arm.target is not None else 0.28 * float(np.tanh(raised))
    skeleton.place(names[0], chest @ rotation(2, s * lift), world)
    if arm.target is None:
        R = chest @ rotation(0, -arm.flexion) @ rotation(2, s * arm.abduction) @ rotation(1, -s * arm.twist)
        upper, fore = R @ hanging, R @ rotation(0, -arm.elbow) @ hanging
    else:
        shoulder = skeleton.moved(names[1], world[INDEX[names[0]]])
        lengths = (skeleton.length(names[1], names[2]), skeleton.length(names[2], names[3]))
        pole = chest @ np.array([0.6 * s, -1.0, -0.7])
        along, second, hinge = two_bone(shoulder, arm.target, lengths, pole)
        upper, fore = (hinge_frame(bone, -hinge) @ hanging for bone in (along, second))
    skeleton.place(names[1], upper, world)
    skeleton.place(names[2], fore, world)
    skeleton.place(names[3], fore, world)
    curl = hanging.T @ rotation(2, -s * arm.curl) @ hanging
    skeleton.place(names[4], fore @ curl, world)


def _hang(skeleton: Skeleton, stance: Stance, before: Stance, elapsed_s: float, world: Transforms) -> None:
    """Place the columns of a skirt, held off by the legs and pulled down by weight, and the tail of the hair."""
    pelvis = world[0, :3, :3]
    speed = pelvis.T @ (stance.pelvis - before.pelvis) / elapsed_s
    turning = (stance.yaw + stance.sway - before.yaw - before.sway) / elapsed_s
    weight = pelvis.T @ np.array([0.0, -1.0, 0.0])
    bones = {}
    for segment, first, last in (("high", "thigh", "shin"), ("low", "shin", "foot")):
        ends = [[skeleton.moved(f"{s}_{part}", world[INDEX[f"{s}_{part}"]]) for part in (first, last)] for s in SIDES]
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
        R = pelvis @ spin @ _tilted(outward, tilt)
        bind = skeleton.positions[joints]
        origins = np.einsum("cij,cj->ci", world[parents, :3, :3], bind) + world[parents, :3, 3]
        world[joints, :3, :3] = R
        world[joints, :3, 3] = origins - np.einsum("cij,cj->ci", R, bind)
    head = world[INDEX["head"], :3, :3]
    drop = unit(0.6 * np.array([0, -1.0, 0]) + 0.4 * head @ np.array([0, -1.0, 0]) - 0.15 * pelvis @ speed)
    lag = rotation(1, -0.5 * float(np.tanh(turning / 4)))
    skeleton.place("tail", lag @ hinge_frame(drop, head @ np.array([1.0, 0, 0])), world)


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


Tempo = Literal["calm", "dance", "fast"]


def ease(x: float) -> float:
    """0 below 0, 1 above 1, with level ends and level curvature."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (10 - 15 * x + 6 * x * x)


@dataclass(frozen=True)
class Score:
    """What a seed fixes of a motion below the shoulders."""

    kind: str
    tempo: Tempo
    beat_hz: float
    legs: Skeleton
    height_m: float
    heading: float
    path_m: float
    """Radius of the walked circle, or half the width of side steps."""
    amounts: Float[np.ndarray, "8"]
    """Personal amounts in [0, 1] and phases."""

    @property
    def turn(self) -> Rotation:
        """To the heading."""
        return rotation(1, self.heading)

    def rest(self, width: float, drop: float, ahead_m: float = 0.0) -> Stance:
        """Standing with the feet `width` apart and the pelvis `drop` lower than at rest (shares of the height)."""
        H = self.height_m
        place = ahead_m * (self.turn @ np.array([0, 0, 1.0]))
        feet = [
            FootPose(place + self.turn @ np.array([s * width * H / 2, 0, 0]), self.heading + s * 0.16)
            for s in SIGN.values()
        ]
        pelvis = place + np.array([0, float(self.legs.at("pelvis")[1]) - drop * H, 0])
        return Stance(pelvis, self.heading, feet, (ArmPose(), ArmPose()))


def _path(score: Score, time_s: float) -> tuple[Float[np.ndarray, "2"], float]:
    """Where the body's middle is on the floor (x, z), and where it is heading."""
    if score.kind in ("walk", "run") and score.path_m > 0.15:
        speed = (0.42 if score.kind == "walk" else 0.55) * score.beat_hz * score.height_m
        angle = speed * time_s / score.path_m + score.heading
        # Walking to the left about the circle: the tangent.
        return score.path_m * np.array([np.sin(angle), np.cos(angle)]), angle + np.pi / 2
    if score.kind == "sidestep":
        aside = score.path_m * np.sin(np.pi / 2 * score.beat_hz * time_s)
        return aside * np.array([np.cos(score.heading), -np.sin(score.heading)]), score.heading
    rate = {"turn": 0.7, "spin": 2.4}.get(score.kind, 0.0) * (0.6 + 0.8 * float(score.amounts[3]))
    if rate:
        # Turns come in spells, with rests between; the integral of a raised cosine is smooth.
        phase = 0.25 * time_s * 2 * np.pi
        return np.zeros(2), score.heading + rate * (time_s - 0.8 * float(np.sin(phase)) / (2 * np.pi * 0.25))
    return np.zeros(2), score.heading


def _stepping(score: Score, time_s: float, beats: float) -> Stance:
    """Feet that step along the path: planted, lifted, swung to where the body will be."""
    H = score.height_m
    run = score.kind == "run"
    duty = 0.42 if run else 0.62
    lift = {"run": 0.13, "march": 0.17, "walk": 0.045}.get(score.kind, 0.05) * H
    width = 0.10 if score.kind != "sidestep" else 0.16
    at, yaw = _path(score, time_s)
    feet = []
    for i, side in enumerate(SIDES):
        phase = beats + 0.5 * i
        step, tau = int(np.floor(phase)), float(phase - np.floor(phase))
        planted = []
        for k in (step, step + 1):
            when = time_s + (k + duty / 2 - phase) / score.beat_hz
            (x, z), turn = _path(score, when)
            aside = rotation(1, turn) @ np.array([SIGN[side] * width * H / 2, 0, 0])
            planted.append((np.array([x, 0, z]) + aside, turn + SIGN[side] * 0.10))
        go = (tau - duty) / (1 - duty)
        share = ease(go)
        place = planted[0][0] + share * (planted[1][0] - planted[0][0])
        place[1] += lift * np.sin(np.pi * np.clip(go, 0, 1)) ** 2
        turn = planted[0][1] + share * (planted[1][1] - planted[0][1])
        roll_off = 0.45 * (ease((tau - duty + 0.16) / 0.16) - ease((go - 0.15) / 0.45)) * (go < 1)
        strike = (0.20 * (not run)) * (ease((go - 0.6) / 0.4) + (1 - ease(tau / 0.10)) * (tau < 0.10))
        flat = score.kind in ("sidestep", "turn", "spin")
        feet.append(FootPose(place, turn, float(strike - roll_off) * (0.4 if flat else 1.0)))
    turn = 2 * np.pi * beats
    bob = (0.045 if run else 0.014) * H * np.cos(2 * turn + (0.4 if run else 2.6))
    over = rotation(1, yaw) @ np.array([0.016 * H * np.sin(turn - 0.2), 0, 0])
    pelvis = np.array([at[0], float(score.legs.at("pelvis")[1]) - (0.035 if run else 0.022) * H + bob, at[1]]) + over
    swing = -0.13 * float(np.cos(turn - 0.6)) * (score.kind in ("walk", "run", "march"))
    return Stance(
        pelvis,
        yaw,
        feet,
        (ArmPose(), ArmPose()),
        lean=0.14 if run else 0.03,
        roll=0.05 * float(np.sin(turn)),
        sway=swing,
        twist=-1.8 * swing,
        side=-0.04 * float(np.sin(turn)),
    )


def _standing(score: Score, time_s: float, beats: float) -> Stance:
    """Talking or swaying: planted feet, weight that shifts, breath."""
    a, H = score.amounts, score.height_m
    calm = score.tempo == "calm"
    strong = {"talk": 0.5, "sway": 1.0, "groove": 1.3, "box": 0.8, "lunge": 1.0}[score.kind]
    base = score.rest(0.14 + 0.10 * a[0] * strong, 0.015 + 0.02 * strong)
    beat = 2 * np.pi * beats
    shift = (0.020 + 0.022 * a[1]) * strong * np.sin(beat / 2 if not calm else beat)
    dip = 0.0 if calm else (0.018 + 0.02 * a[2]) * (1 - np.cos(beat * 1.0)) * strong
    if score.kind == "lunge":
        shift, dip = 2.6 * shift, 1.2 * dip + 0.05
    move = score.turn @ np.array([shift, 0, 0.3 * shift * np.cos(beat / 2)])
    s, c = float(np.sin(beat / 2 if not calm else beat)), float(np.cos(beat / 2))
    heel = -0.35 * strong * (not calm) * np.clip(np.array([-s, s]), 0, 1) ** 2
    feet = [replace(foot, pitch=float(h)) for foot, h in zip(base.feet, heel, strict=True)]
    return replace(
        base,
        pelvis=base.pelvis + H * (move + np.array([0, -dip, 0])),
        feet=feet,
        roll=0.10 * strong * s,
        side=-0.16 * strong * s,
        sway=0.18 * strong * c * (not calm),
        twist=(0.10 + 0.25 * a[3] * (not calm)) * strong * float(np.sin(beat / 2 + 2 * a[4])),
        bend=0.04 + 0.05 * float(np.sin(0.5 * beat)) + (0.12 if score.kind == "box" else 0.0),
        knees_out=0.12 + 0.15 * strong * float(a[5]),
    )


def _jumping(score: Score, time_s: float, beats: float) -> Stance:
    """Jumping jacks: feet and arms open and close, with a hop between."""
    H = score.height_m
    base = score.rest(0.0, 0.02)
    open_ = 0.5 + 0.5 * np.sin(2 * np.pi * beats)
    hop = 0.06 * H * np.cos(2 * np.pi * beats) ** 2
    feet = []
    for s in SIGN.values():
        place = score.turn @ np.array([s * (0.05 + 0.13 * open_) * H, 0, 0]) + np.array([0, hop, 0])
        feet.append(FootPose(place, score.heading + s * 0.2, -8.0 * hop / H * 0.6))
    return replace(base, pelvis=base.pelvis + np.array([0, 0.9 * hop - 0.04 * H * open_, 0]), feet=feet)


def _crouching(score: Score, time_s: float, beats: float) -> Stance:
    """Down on bent knees and up again."""
    H, a = score.height_m, score.amounts
    base = score.rest(0.16 + 0.06 * a[0], 0.015)
    low = ease(0.5 - 0.5 * np.cos(2 * np.pi * 0.5 * beats)) * (0.75 + 0.25 * a[1])
    back = score.turn @ np.array([0, 0, -0.07 * low * H])
    feet = [replace(foot, pitch=-0.35 * ease((low - 0.35) / 0.6)) for foot in base.feet]
    return replace(
        base,
        pelvis=base.pelvis + back + np.array([0, -0.27 * H * low, 0]),
        feet=feet,
        lean=0.45 * float(low),
        bend=0.45 * float(low),
        knees_out=0.25 + 0.2 * float(a[2]),
    )


def seat_height(height_m: float) -> float:
    """Height of the stool that fits this person, metres."""
    return 0.262 * height_m


def _sitting(score: Score, time_s: float, beats: float) -> Stance:
    """Sitting on a stool at the centre; some get up and sit down again."""
    H, a = score.height_m, score.amounts
    forward = score.turn @ np.array([0, 0, 1.0])
    base = score.rest(0.13 + 0.06 * a[0], 0.01, 0.21 * H)
    seated = np.array([0, seat_height(H) + 0.062 * H, 0]) - 0.02 * H * forward
    cycle = (time_s / 7.0 + a[1]) % 1.0
    down = 1.0 if a[2] < 0.5 else 1 - ease((cycle - 0.55) / 0.18) + ease((cycle - 0.82) / 0.18)
    pelvis = base.pelvis + down * (seated - base.pelvis) - 0.03 * H * np.sin(np.pi * down) * forward
    leaning = float(0.75 * np.sin(np.pi * down))
    rock = float(np.sin(2 * np.pi * 0.5 * beats))
    return replace(
        base,
        pelvis=pelvis,
        lean=0.5 * leaning - 0.05 * down,
        bend=0.5 * leaning + 0.12 * down + 0.05 * rock,
        twist=0.15 * rock * float(a[3]),
        side=0.06 * rock,
        knees_out=0.15 + 0.25 * float(a[4]),
    )


def _reaching(score: Score, time_s: float, beats: float) -> Stance:
    """Hands that go from one place to the next: up, aside, forward, to the floor."""
    H, a = score.height_m, score.amounts
    base = score.rest(0.18, 0.03)
    step, tau = int(np.floor(beats)), float(beats - np.floor(beats))
    share = ease(tau / 0.7)
    goals = [_goal(score, step + k) for k in (0, 1)]
    goal = goals[0] + share * (goals[1] - goals[0])
    middle = goal.mean(0)
    low = float(np.clip(0.62 - middle[1], 0, 0.5))
    lean = (0.10 * (middle - np.array([0, 0.7, 0.15]))) * np.array([1, 0, 0.5])
    arms = [ArmPose(curl=0.25, target=score.turn @ (goal[i] * H)) for i in range(2)]
    return replace(
        base,
        pelvis=base.pelvis + score.turn @ (lean * H) + np.array([0, -0.35 * low * H, 0]),
        bend=0.15 + 1.6 * low,
        lean=0.9 * low,
        side=float(0.6 * middle[0]),
        twist=float(0.9 * middle[0]),
        knees_out=0.15 + 0.1 * float(a[0]),
        arms=arms,
    )


def _goal(score: Score, step: int) -> Float[np.ndarray, "side 3"]:
    """Places of both wrists in the heading's frame, shares of the height; the hands often go together."""
    rng = np.random.default_rng([int(1e6 * score.amounts[5]), step % 1000])
    places = np.array(
        [(0.12, 0.98, 0.16), (0.36, 0.74, 0.12), (0.14, 0.62, 0.30), (0.20, 0.86, 0.26), (0.16, 0.40, 0.24)]
    )
    chosen = rng.integers(0, len(places), 2)
    left, right = places[chosen[0]], places[chosen[1 if rng.random() < 0.4 else 0]] * np.array([-1, 1, 1])
    down = np.array([0.17, 0.47, 0.05])
    if rng.random() < 0.4:
        right = down * np.array([-1, 1, 1])
    elif rng.random() < 0.4:
        left = down
    return np.stack([left, right]) + rng.uniform(-0.03, 0.03, (2, 3))


GROUNDS = {
    **dict.fromkeys(("walk", "run", "march", "turn", "spin", "sidestep"), _stepping),
    **dict.fromkeys(("talk", "sway", "groove", "box", "lunge"), _standing),
    "jacks": _jumping,
    "crouch": _crouching,
    "sit": _sitting,
    "reach": _reaching,
}
