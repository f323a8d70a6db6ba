"""The performers' skeleton: joints, forward kinematics, and two-bone inverse kinematics.

The bind pose is an A-pose that faces +z, left side at +x, arms `ARM_ANGLE_RAD` away from hanging straight down.
"""

import itertools
import tomllib
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

ARM_ANGLE_RAD = np.radians(48.0)
SKIRT_COLUMNS = 8

SPINE = ("pelvis", "spine", "chest", "upper", "neck", "head")
ARM = ("clavicle", "upperarm", "forearm", "hand", "fingers")
LEG = ("thigh", "shin", "foot", "toe")
SIDES = ("left", "right")
_CHAINS = (
    SPINE,
    *(
        (root, *(f"{side}_{name}" for name in limb))
        for side in SIDES
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


def rotation(axis: int, angle_rad: float) -> Rotation:
    """Rotation about coordinate axis 0, 1 or 2."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def unit(v: Points) -> Points:
    """`v` at length one."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def hinge_frame(along: Vector, hinge: Vector) -> Rotation:
    """Rotation whose -y axis is `along` (a bone) and whose x axis is as near `hinge` as that allows."""
    y = -unit(along)
    z = unit(np.cross(hinge, y))
    return np.stack([np.cross(y, z), y, z], axis=1)


def two_bone(
    start: Vector, target: Vector, lengths: tuple[float, float], pole: Vector
) -> tuple[Vector, Vector, Vector]:
    """Directions of a limb's two bones from `start` to `target`, its middle joint bent towards `pole`, and the hinge.

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

    def moved(self, name: str, motion: Float[np.ndarray, "4 4"]) -> Vector:
        """Where a motion from the bind pose takes this joint, world metres."""
        return motion[:3, :3] @ self.at(name) + motion[:3, 3]

    def place(self, name: str, R: Rotation, world_from_bind: Transforms) -> None:
        """Set a joint to the world rotation R at the place its parent carries it to."""
        joint = INDEX[name]
        origin = self.moved(name, world_from_bind[PARENTS[joint]])
        world_from_bind[joint, :3, :3] = R
        world_from_bind[joint, :3, 3] = origin - R @ self.at(name)


TABLES: dict[str, Any] = tomllib.loads((files("viewmend.data.synthetic.procedural") / "tables.toml").read_text())
"""Name -> rows; the file's comments name the columns."""


@dataclass(frozen=True, kw_only=True)
class Physique:
    """A person's build. Lengths elsewhere are fractions of `height_m` unless their names end in _m."""

    height_m: float
    femininity: float
    """0 masculine, 1 feminine: shoulders, hips, waist, bust, neck, jaw."""
    weight: float
    """-1 thin, 0 average, 1.6 heavy."""
    muscle: float
    """0 to 1."""
    leg_share: float
    """Length of the legs relative to the average."""
    skin_rgb: tuple[float, float, float]
    """sRGB."""
    face: tuple[float, ...]
    """Eight numbers in [-1, 1]: the features' individual sizes and places."""


SKIN_RGB = np.array(TABLES["skin"])


def sample_physique(rng: np.random.Generator) -> Physique:
    """Draw a person."""
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
    """Bind positions of the joints of this person."""
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
        x, z = np.sin(2 * np.pi * column / SKIRT_COLUMNS), np.cos(2 * np.pi * column / SKIRT_COLUMNS)
        places[f"skirt{column}_high"] = (0.07 * x, 0.57, 0.045 * z)
        places[f"skirt{column}_low"] = (0.09 * x, 0.40, 0.07 * z)
    positions = np.array([places[name] for name in JOINTS], dtype=np.float64)
    trunk = np.array([not name.endswith(ARM) for name in JOINTS])
    positions[trunk, 1] = leg_stretch(positions[trunk, 1], person.leg_share)
    return Skeleton(positions * person.height_m)


def leg_stretch(y: Values, share: float) -> Values:
    """Heights (fractions) after the legs take `share` of their length; ankles, shoulders and head stay."""
    return np.interp(y, [0.0, 0.043, 0.522, 0.797, 1.0], [0.0, 0.043, 0.522 * share, 0.797, 1.0])
