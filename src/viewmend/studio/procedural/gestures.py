"""What arms do: families of oscillating joint angles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.stance import ArmPose
from viewmend.studio.procedural.tables import TABLES

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
