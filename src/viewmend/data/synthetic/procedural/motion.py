"""Seeded motions: feet and pelvis follow a score, arms alternate gestures, and the head looks around."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from viewmend.data.synthetic.procedural.grounds import GROUNDS, ArmPose, Score, Stance, Tempo, ease
from viewmend.data.synthetic.procedural.skeleton import SIDES, TABLES, Physique, Skeleton

MOTIONS: dict[Tempo, tuple[str, ...]] = {
    "calm": ("walk", "talk", "turn", "reach", "sit", "crouch", "sway"),
    "dance": ("groove", "sidestep", "spin", "march", "lunge"),
    "fast": ("run", "jacks", "box", "groove", "spin"),
}
GESTURES: dict[str, tuple[str, ...]] = {kind: tuple(names) for kind, names in TABLES["gestures_of_motion"].items()}
BEAT_HZ: dict[Tempo, tuple[float, float]] = {"calm": (0.35, 0.6), "dance": (0.8, 1.15), "fast": (1.3, 1.8)}
OWN_BEAT_HZ = {"walk": (0.75, 0.98), "jacks": (0.85, 1.15), "run": (1.25, 1.5)}
ENERGY: dict[Tempo, float] = {"calm": 0.8, "dance": 1.0, "fast": 1.1}


FAMILIES = TABLES["gestures"]
FASTEST_RAD_S = 7.0
"""Fastest turn of an arm's joint; hands then stay below about ten metres a second."""


@dataclass(frozen=True)
class Gesture:
    """A family with a person's own bases, amplitudes and phases, for left and right."""

    families: tuple[str, str]
    bases: Float[np.ndarray, "side angle"]
    amplitudes: Float[np.ndarray, "side angle"]
    phases: Float[np.ndarray, "side angle"]
    harmonics: Float[np.ndarray, "side"]

    def angles(self, beats: float) -> Float[np.ndarray, "side angle"]:
        """Flexion, abduction, twist, elbow, curl of both arms at this point of the music."""
        moving = self.bases + self.amplitudes * np.sin(2 * np.pi * (self.harmonics[:, None] * beats + self.phases))
        moving[:, 1] = np.maximum(moving[:, 1], 0.02)
        moving[:, 3] = np.maximum(moving[:, 3], 0.02)
        return moving


def sample_gesture(
    rng: np.random.Generator, families: tuple[str, ...], bulk: float, energy: float, beat_hz: float
) -> Gesture:
    """Draw a gesture; `bulk` (radians) keeps hanging arms off a wide body, `energy` scales the amplitudes.

    At `beat_hz` no joint turns faster than an arm can.
    """
    first = families[int(rng.integers(len(families)))]
    names = (first, "hang" if first == "wave" else first)
    if first == "wave" and rng.random() < 0.5:
        names = (names[1], names[0])
    phase = rng.random()
    own = rng.uniform(0, 1, 4)
    bases, amplitudes, phases, harmonics = [], [], [], []
    for i, name in enumerate(names):
        angles, harmonic, apart, curl = FAMILIES[name]
        table = np.array(angles)
        base = table[:, 0] + 0.08 * rng.standard_normal(4)
        base[1] = max(base[1], table[1, 0]) + bulk * np.clip(1.2 - base[1], 0, 1)
        most = FASTEST_RAD_S / (2 * np.pi * harmonic * beat_hz)
        amplitude = np.clip(table[:, 1] * energy * rng.uniform(0.8, 1.2), -most, most)
        # The main angle beats with the music; the others follow it loosely.
        offsets = phase + i * apart + (0.12 * own if name not in ("jacks", "box", "drive", "swing") else 0 * own)
        bases.append([*base, curl])
        amplitudes.append([*amplitude, 0.05])
        phases.append([*offsets, phase])
        harmonics.append(harmonic)
    return Gesture(names, np.array(bases), np.array(amplitudes), np.array(phases), np.array(harmonics))


def arm_poses(angles: Float[np.ndarray, "side angle"]) -> tuple[ArmPose, ArmPose]:
    """Both arms at these angles."""
    left, right = (ArmPose(flexion=a[0], abduction=a[1], twist=a[2], elbow=a[3], curl=a[4]) for a in angles.tolist())
    return left, right


@dataclass(frozen=True)
class Motion:
    """A motion of one person; `stance` is a smooth, deterministic function of time."""

    score: Score
    gestures: tuple[Gesture, Gesture]
    bar_s: float
    """Rate at which the two gestures alternate."""
    center: tuple[float, float] = (0.0, 0.0)

    def stance(self, time_s: float) -> Stance:
        """The body at this time."""
        beats = self.score.beat_hz * time_s + float(self.score.amounts[7])
        base = GROUNDS[self.score.kind](self.score, time_s, beats)
        stance = self._arms(base, time_s, beats)
        glance = self.score.amounts
        look = 0.45 * np.sin(0.9 * time_s + 6 * glance[0]) * np.sin(0.37 * time_s + 6 * glance[1])
        nod = 0.10 * np.sin(0.7 * time_s + 6 * glance[2]) + (0.10 if self.score.tempo != "calm" else 0.03) * np.sin(
            2 * np.pi * beats
        )
        offset = np.array([self.center[0], 0.0, self.center[1]])
        left, right = (replace(foot, place=foot.place + offset) for foot in stance.feet)
        left_arm, right_arm = (a if a.target is None else replace(a, target=a.target + offset) for a in stance.arms)
        return replace(
            stance,
            look=float(look) - 0.5 * stance.twist,
            nod=stance.nod + float(nod) - 0.45 * (stance.bend + stance.lean),
            tilt=0.10 * float(np.sin(np.pi * beats)),
            pelvis=stance.pelvis + offset,
            feet=(left, right),
            arms=(left_arm, right_arm),
        )

    def gripping(self, side: str) -> "Motion":
        """The same motion with this hand closed round something."""
        i = SIDES.index(side)
        gestures = []
        for gesture in self.gestures:
            bases, amplitudes = gesture.bases.copy(), gesture.amplitudes.copy()
            bases[i, 4], amplitudes[i, 4] = 1.3, 0.0
            gestures.append(replace(gesture, bases=bases, amplitudes=amplitudes))
        return replace(self, gestures=(gestures[0], gestures[1]))

    def _arms(self, base: Stance, time_s: float, beats: float) -> Stance:
        if self.score.kind == "reach":
            return base
        bar = time_s / self.bar_s + float(self.score.amounts[6])
        # The distance from the middle of the second gesture's bar, in bars, goes up and down between 0 and 1.
        share = ease((0.7 - abs(bar % 2.0 - 1.0)) / 0.4)
        first, second = (gesture.angles(beats) for gesture in self.gestures)
        return replace(base, arms=arm_poses(first + share * (second - first)))


def sample_motion(
    rng: np.random.Generator,
    person: Physique,
    skeleton: Skeleton,
    tempo: Tempo,
    kind: str | None,
    bulk: float,
    center: tuple[float, float] = (0.0, 0.0),
) -> Motion:
    """Draw a motion of this tempo; `kind` fixes which."""
    chosen = kind or MOTIONS[tempo][int(rng.integers(len(MOTIONS[tempo])))]
    low, high = BEAT_HZ[tempo]
    beat = float(rng.uniform(low, high))
    if chosen in OWN_BEAT_HZ:
        beat = float(rng.uniform(*OWN_BEAT_HZ[chosen]))
    gestures = [sample_gesture(rng, GESTURES[chosen], bulk, ENERGY[tempo], beat) for _ in range(2)]
    path = 0.0
    if chosen in ("walk", "run"):
        path = float(rng.uniform(0.42, 0.65)) if rng.random() < 0.7 else 0.0
    if chosen == "sidestep":
        path = float(rng.uniform(0.12, 0.3))
    score = Score(
        chosen, tempo, beat, skeleton, person.height_m, float(rng.uniform(-np.pi, np.pi)), path, rng.uniform(0, 1, 8)
    )
    return Motion(score, (gestures[0], gestures[1]), float(rng.uniform(2.5, 5.0)), center)
