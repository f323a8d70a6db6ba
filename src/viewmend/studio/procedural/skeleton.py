"""The performers' skeleton: joints, forward kinematics, and two-bone inverse kinematics.

The bind pose is an A-pose that faces +z, left side at +x, arms `ARM_ANGLE_RAD` away from hanging straight down.
"""

from dataclasses import dataclass

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
JOINTS: tuple[str, ...] = (
    *SPINE,
    *(f"{side}_{name}" for side in SIDES for name in (*ARM, *LEG)),
    *(f"skirt{column}_{segment}" for column in range(SKIRT_COLUMNS) for segment in ("high", "low")),
    "tail",
)
INDEX: dict[str, int] = {name: i for i, name in enumerate(JOINTS)}


def _parent(name: str) -> int:
    if name == "pelvis":
        return -1
    if name in SPINE:
        return INDEX[SPINE[SPINE.index(name) - 1]]
    if name == "tail":
        return INDEX["head"]
    if name.startswith("skirt"):
        return INDEX["pelvis"] if name.endswith("high") else INDEX[name.replace("low", "high")]
    side, part = name.split("_")
    chain = ARM if part in ARM else LEG
    if part == chain[0]:
        return INDEX["upper"] if chain is ARM else INDEX["pelvis"]
    return INDEX[f"{side}_{chain[chain.index(part) - 1]}"]


PARENTS: tuple[int, ...] = tuple(_parent(name) for name in JOINTS)
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

    def place(self, joint: int, R: Rotation, world_from_bind: Transforms) -> None:
        """Set `joint` to the world rotation R at the place its parent carries it to."""
        parent = world_from_bind[PARENTS[joint]]
        origin = parent[:3, :3] @ self.positions[joint] + parent[:3, 3]
        world_from_bind[joint, :3, :3] = R
        world_from_bind[joint, :3, 3] = origin - R @ self.positions[joint]


def joint_origin(skeleton: Skeleton, name: str, world_from_bind: Transforms) -> Vector:
    """World position of a joint that is already placed."""
    motion = world_from_bind[INDEX[name]]
    return motion[:3, :3] @ skeleton.at(name) + motion[:3, 3]
