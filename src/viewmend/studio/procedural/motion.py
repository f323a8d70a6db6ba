"""Seeded motions: feet and pelvis follow a score, arms alternate gestures, and the head looks around."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.skeleton import (
    SIDES,
    SIGN,
    TABLES,
    ArmPose,
    FootPose,
    Physique,
    Rotation,
    Skeleton,
    Stance,
    Vector,
    rotation,
)

Tempo = Literal["calm", "dance", "fast"]
SEAT = 0.262
"""Height of the stool that fits a person, as a fraction of the person's height."""
MOTIONS: dict[Tempo, tuple[str, ...]] = {
    "calm": ("walk", "talk", "turn", "reach", "sit", "crouch", "sway"),
    "dance": ("groove", "sidestep", "spin", "march", "lunge"),
    "fast": ("run", "jacks", "box", "groove", "spin"),
}
"""Motions of each tempo."""
BEAT_HZ: dict[Tempo, tuple[float, float]] = {"calm": (0.35, 0.6), "dance": (0.8, 1.15), "fast": (1.3, 1.8)}
"""Range of beats per second of each tempo."""
OWN_BEAT_HZ = {"walk": (0.75, 0.98), "jacks": (0.85, 1.15), "run": (1.25, 1.5)}
"""Range of beats per second of motions that have one of their own."""
ENERGY: dict[Tempo, float] = {"calm": 0.8, "dance": 1.0, "fast": 1.1}
"""Factor on the size of movements, by tempo."""
FASTEST_RAD_S = 7.0
"""Fastest turn of an arm's joint, radians per second; hands then stay below about ten metres a
second."""


def ease(x: float) -> float:
    """Ease from 0 to 1, with zero slope and curvature at both ends."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (10 - 15 * x + 6 * x * x)


@dataclass(frozen=True)
class Score:
    """The seeded parameters of a motion below the shoulders."""

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
        """The rotation about y to the heading."""
        return rotation(1, self.heading)

    def rest(self, width: float, drop: float, ahead_m: float = 0.0) -> Stance:
        """A stance with feet `width` apart and the pelvis `drop` lower (both relative to the height)."""
        H = self.height_m
        place = ahead_m * (self.turn @ np.array([0, 0, 1.0]))
        sides = [(s, place + self.turn @ np.array([s * width * H / 2, 0, 0])) for s in SIGN.values()]
        feet = [FootPose(at, self.heading + s * 0.16) for s, at in sides]
        pelvis = place + np.array([0, float(self.legs.at("pelvis")[1]) - drop * H, 0])
        return Stance(pelvis, self.heading, feet)


def _path(score: Score, time_s: float) -> tuple[Float[np.ndarray, "2"], float]:
    """The body's position on the floor (x, z) and its heading."""
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


def _foothold(score: Score, time_s: float, side: str) -> tuple[Vector, float]:
    """Where a foot is planted when the body is above it, and the foot's heading."""
    (x, z), heading = _path(score, time_s)
    width = 0.10 if score.kind != "sidestep" else 0.16
    aside = rotation(1, heading) @ np.array([SIGN[side] * width * score.height_m / 2, 0, 0])
    return np.array([x, 0, z]) + aside, heading + SIGN[side] * 0.10


def _swing_foot(score: Score, time_s: float, side: str, phase: float) -> FootPose:
    """The foot of a side that steps along the path; `phase` counts its steps."""
    run = score.kind == "run"
    duty = 0.42 if run else 0.62
    step = int(np.floor(phase))
    tau = float(phase - np.floor(phase))

    # Swing from this step's foothold to the next one
    here, heading = _foothold(score, time_s + (step + duty / 2 - phase) / score.beat_hz, side)
    there, next_heading = _foothold(score, time_s + (step + 1 + duty / 2 - phase) / score.beat_hz, side)
    go = (tau - duty) / (1 - duty)
    share = ease(go)
    place = here + share * (there - here)
    lift = {"run": 0.13, "march": 0.17, "walk": 0.045}.get(score.kind, 0.05) * score.height_m
    place[1] += lift * np.sin(np.pi * np.clip(go, 0, 1)) ** 2
    turn = heading + share * (next_heading - heading)

    # Roll off and strike
    roll_off = 0.45 * (ease((tau - duty + 0.16) / 0.16) - ease((go - 0.15) / 0.45)) * (go < 1)
    strike = (0.20 * (not run)) * (ease((go - 0.6) / 0.4) + (1 - ease(tau / 0.10)) * (tau < 0.10))
    flat = 0.4 if score.kind in ("sidestep", "turn", "spin") else 1.0
    return FootPose(place, turn, float(strike - roll_off) * flat)


def _step(score: Score, time_s: float, beats: float) -> Stance:
    """Step along the path: each foot is planted, lifted, and swung to where the body will be."""
    H = score.height_m
    run = score.kind == "run"
    at, yaw = _path(score, time_s)
    feet = [_swing_foot(score, time_s, side, beats + 0.5 * i) for i, side in enumerate(SIDES)]
    turn = 2 * np.pi * beats
    bob = (0.045 if run else 0.014) * H * np.cos(2 * turn + (0.4 if run else 2.6))
    over = rotation(1, yaw) @ np.array([0.016 * H * np.sin(turn - 0.2), 0, 0])
    pelvis = (
        np.array([at[0], float(score.legs.at("pelvis")[1]) - (0.035 if run else 0.022) * H + bob, at[1]])
        + over
    )
    swing = -0.13 * float(np.cos(turn - 0.6)) * (score.kind in ("walk", "run", "march"))
    return Stance(
        pelvis,
        yaw,
        feet,
        lean=0.14 if run else 0.03,
        roll=0.05 * float(np.sin(turn)),
        sway=swing,
        twist=-1.8 * swing,
        side=-0.04 * float(np.sin(turn)),
    )


def _stand(score: Score, time_s: float, beats: float) -> Stance:
    """Stand while talking or swaying: planted feet, shifting weight, breath."""
    a = score.amounts
    H = score.height_m
    calm = score.tempo == "calm"
    strong = {"talk": 0.5, "sway": 1.0, "groove": 1.3, "box": 0.8, "lunge": 1.0}[score.kind]
    base = score.rest(0.14 + 0.10 * a[0] * strong, 0.015 + 0.02 * strong)
    beat = 2 * np.pi * beats
    shift = (0.020 + 0.022 * a[1]) * strong * np.sin(beat / 2 if not calm else beat)
    dip = 0.0 if calm else (0.018 + 0.02 * a[2]) * (1 - np.cos(beat * 1.0)) * strong
    if score.kind == "lunge":
        shift = 2.6 * shift
        dip = 1.2 * dip + 0.05
    move = score.turn @ np.array([shift, 0, 0.3 * shift * np.cos(beat / 2)])
    s = float(np.sin(beat / 2 if not calm else beat))
    c = float(np.cos(beat / 2))
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


def _jump(score: Score, time_s: float, beats: float) -> Stance:
    """Do jumping jacks: feet and arms open and close, with a hop between."""
    H = score.height_m
    base = score.rest(0.0, 0.02)
    open_ = 0.5 + 0.5 * np.sin(2 * np.pi * beats)
    hop = 0.06 * H * np.cos(2 * np.pi * beats) ** 2
    feet = []
    for s in SIGN.values():
        place = score.turn @ np.array([s * (0.05 + 0.13 * open_) * H, 0, 0]) + np.array([0, hop, 0])
        feet.append(FootPose(place, score.heading + s * 0.2, -8.0 * hop / H * 0.6))
    return replace(base, pelvis=base.pelvis + np.array([0, 0.9 * hop - 0.04 * H * open_, 0]), feet=feet)


def _crouch(score: Score, time_s: float, beats: float) -> Stance:
    """Crouch down and stand up again."""
    H = score.height_m
    a = score.amounts
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


def _sit(score: Score, time_s: float, beats: float) -> Stance:
    """Sit on a stool at the centre; some stand up and sit down again."""
    H = score.height_m
    a = score.amounts
    forward = score.turn @ np.array([0, 0, 1.0])
    base = score.rest(0.13 + 0.06 * a[0], 0.01, 0.21 * H)
    seated = np.array([0, SEAT * H + 0.062 * H, 0]) - 0.02 * H * forward
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


def _reach(score: Score, time_s: float, beats: float) -> Stance:
    """Reach with the hands from one place to the next: up, aside, forward, to the floor."""
    H = score.height_m
    a = score.amounts
    base = score.rest(0.18, 0.03)
    step = int(np.floor(beats))
    tau = float(beats - np.floor(beats))
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
    """Positions of both wrists in the heading's frame, relative to the height; often they move together."""
    rng = np.random.default_rng([int(1e6 * score.amounts[5]), step % 1000])
    places = np.array(TABLES["reaches"])
    down = np.array([0.17, 0.47, 0.05])
    mirror = np.array([-1, 1, 1])
    chosen = rng.integers(0, len(places), 2)
    left = places[chosen[0]]
    right = places[chosen[1 if rng.random() < 0.4 else 0]] * mirror
    if rng.random() < 0.4:
        right = down * mirror
    elif rng.random() < 0.4:
        left = down
    return np.stack([left, right]) + rng.uniform(-0.03, 0.03, (2, 3))


def score_stance(score: Score, time_s: float, beats: float) -> Stance:
    """The stance of a score's motion at this time; `beats` counts the beats since time 0."""
    match score.kind:
        case "walk" | "run" | "march" | "turn" | "spin" | "sidestep":
            return _step(score, time_s, beats)
        case "jacks":
            return _jump(score, time_s, beats)
        case "crouch":
            return _crouch(score, time_s, beats)
        case "sit":
            return _sit(score, time_s, beats)
        case "reach":
            return _reach(score, time_s, beats)
        case _:  # talk, sway, groove, box and lunge
            return _stand(score, time_s, beats)


@dataclass(frozen=True)
class Gesture:
    """A family with a person's own bases, amplitudes and phases, for left and right."""

    bases: Float[np.ndarray, "side angle"]
    amplitudes: Float[np.ndarray, "side angle"]
    phases: Float[np.ndarray, "side angle"]
    harmonics: Float[np.ndarray, "side"]

    def angles(self, beats: float) -> Float[np.ndarray, "side angle"]:
        """Flexion, abduction, twist, elbow and curl of both arms at this beat."""
        moving = self.bases + self.amplitudes * np.sin(
            2 * np.pi * (self.harmonics[:, None] * beats + self.phases)
        )
        moving[:, [1, 3]] = np.maximum(moving[:, [1, 3]], 0.02)
        return moving


def sample_gesture(
    rng: np.random.Generator, kinds: list[str], bulk: float, energy: float, beat_hz: float
) -> Gesture:
    """Sample a gesture; `bulk` (radians) keeps hanging arms off the body, `energy` scales amplitudes."""
    first = kinds[int(rng.integers(len(kinds)))]
    names = (first, "hang" if first == "wave" else first)
    if first == "wave" and rng.random() < 0.5:
        names = (names[1], names[0])
    phase = rng.random()
    own = rng.uniform(0, 1, 4)
    sides = []
    for i, name in enumerate(names):
        angles, harmonic, apart, curl = TABLES["gestures"][name]
        table = np.array(angles)
        base = table[:, 0] + 0.08 * rng.standard_normal(4)
        base[1] = max(base[1], table[1, 0]) + bulk * np.clip(1.2 - base[1], 0, 1)
        # At this beat no joint turns faster than an arm can.
        most = FASTEST_RAD_S / (2 * np.pi * harmonic * beat_hz)
        amplitude = np.clip(table[:, 1] * energy * rng.uniform(0.8, 1.2), -most, most)
        # The main angle beats with the music; the others follow it loosely.
        offsets = (
            phase + i * apart + (0.12 * own if name not in ("jacks", "box", "drive", "swing") else 0 * own)
        )
        sides.append(([*base, curl], [*amplitude, 0.05], [*offsets, phase], harmonic))
    return Gesture(*map(np.array, zip(*sides, strict=True)))


@dataclass(frozen=True)
class Motion:
    """A motion of one person; `stance` is a smooth, deterministic function of time."""

    score: Score
    gestures: list[Gesture]
    bar_s: float
    """Rate at which the two gestures alternate."""
    center: tuple[float, float]
    grip: str | None = None
    """The side whose hand holds something."""

    def stance(self, time_s: float) -> Stance:
        """Compute the body's stance at this time."""
        beats = self.score.beat_hz * time_s + float(self.score.amounts[7])
        stance = score_stance(self.score, time_s, beats)
        a, b, c = 6 * self.score.amounts[:3]
        look = 0.45 * np.sin(0.9 * time_s + a) * np.sin(0.37 * time_s + b)
        strong = 0.03 if self.score.tempo == "calm" else 0.10
        nod = 0.10 * np.sin(0.7 * time_s + c) + strong * np.sin(2 * np.pi * beats)
        offset = np.array([self.center[0], 0.0, self.center[1]])
        arms = stance.arms or self._arms(time_s, beats)
        return replace(
            stance,
            look=float(look) - 0.5 * stance.twist,
            nod=float(nod) - 0.45 * (stance.bend + stance.lean),
            tilt=0.10 * float(np.sin(np.pi * beats)),
            pelvis=stance.pelvis + offset,
            feet=[replace(foot, place=foot.place + offset) for foot in stance.feet],
            arms=[arm if arm.target is None else replace(arm, target=arm.target + offset) for arm in arms],
        )

    def _arms(self, time_s: float, beats: float) -> list[ArmPose]:
        bar = time_s / self.bar_s + float(self.score.amounts[6])
        # The distance from the middle of the second gesture's bar, in bars, goes up and down between 0 and 1.
        share = ease((0.7 - abs(bar % 2.0 - 1.0)) / 0.4)
        first, second = (gesture.angles(beats) for gesture in self.gestures)
        angles = first + share * (second - first)
        if self.grip:
            angles[SIDES.index(self.grip), 4] = 1.3
        return [ArmPose(*arm) for arm in angles.tolist()]


def sample_motion(
    rng: np.random.Generator,
    person: Physique,
    skeleton: Skeleton,
    tempo: Tempo,
    kind: str | None,
    bulk: float,
    center: tuple[float, float] = (0.0, 0.0),
) -> Motion:
    """Sample a motion of this tempo; `kind` fixes which."""
    chosen = kind or MOTIONS[tempo][int(rng.integers(len(MOTIONS[tempo])))]
    beat = float(rng.uniform(*BEAT_HZ[tempo]))
    if chosen in OWN_BEAT_HZ:
        beat = float(rng.uniform(*OWN_BEAT_HZ[chosen]))
    gestures = [
        sample_gesture(rng, TABLES["gestures_of_motion"][chosen], bulk, ENERGY[tempo], beat) for _ in range(2)
    ]
    path = 0.0
    if chosen in ("walk", "run") and rng.random() < 0.7:
        path = float(rng.uniform(0.42, 0.65))
    if chosen == "sidestep":
        path = float(rng.uniform(0.12, 0.3))
    heading = float(rng.uniform(-np.pi, np.pi))
    score = Score(chosen, tempo, beat, skeleton, person.height_m, heading, path, rng.uniform(0, 1, 8))
    return Motion(score, gestures, float(rng.uniform(2.5, 5.0)), center)
