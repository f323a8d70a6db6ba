"""Retargets a motion to a character: each limb turns as the actor's does, whatever the two rest poses are."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.rigid import rigid
from viewmend.studio.bvh import Motion
from viewmend.studio.gltf import Character

SIDED = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
TRUNK = ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head")
PARTS = (*TRUNK, *(side + part for side in ("Left", "Right") for part in SIDED))
"""Parts of a body, parents before children: named as in HumanIK and Mixamo; Spine2 carries the collars."""

REQUIRED = (
    "Hips",
    *(side + part for side in ("Left", "Right") for part in ("Arm", "ForeArm", "UpLeg", "Leg", "Foot")),
)

_LEFT = " ".join("Left" + part for part in SIDED)
_FAMILIES = {
    # Trunk and left side in the order of PARTS, and what in a name makes it the right side's.
    "acclaim": (
        "root lowerback upperback thorax lowerneck head lclavicle lhumerus lradius lhand lfemur ltibia lfoot ltoes",
        *(r"^l", "r"),
    ),
    "cgspeed": (
        "Hips lowerback Chest Chest2 Neck Head "
        "LeftCollar LeftShoulder LeftElbow LeftWrist LeftHip LeftKnee LeftAnkle LeftToe",
        *(r"^Left", "Right"),
    ),
    "humanik": (f"Hips Spine Spine1 Spine3 Neck Head {_LEFT}", r"^Left", "Right"),
    "mixamo": (f"Hips Spine Spine1 Spine2 Neck Head {_LEFT}", r"^Left", "Right"),
    "rigify": (
        "DEF-hips DEF-spine.001 DEF-spine.002 DEF-spine.003 DEF-neck DEF-head "
        "DEF-shoulder.L DEF-upper_arm.L DEF-forearm.L DEF-hand.L DEF-thigh.L DEF-shin.L DEF-foot.L DEF-toe.L",
        *(r"\.L$", ".R"),
    ),
    "mannequin": (
        "pelvis spine_01 spine_02 spine_03 neck_01 head "
        "clavicle_l upperarm_l lowerarm_l hand_l thigh_l calf_l foot_l ball_l",
        *(r"_l$", "_r"),
    ),
}

_WORDS = (
    # First match wins: longer and more special words before the ones that they contain.
    ("ToeBase", ("toebase", "toe", "ball")),
    ("Foot", ("foot", "ankle")),
    ("UpLeg", ("upleg", "upperleg", "thigh", "femur", "leghip", "hip")),
    ("Leg", ("lowerleg", "leg", "knee", "calf", "shin", "tibia")),
    ("ForeArm", ("forearm", "lowerarm", "elbow", "radius")),
    ("Arm", ("upperarm", "uparm", "humerus", "arm")),
    ("Hand", ("hand", "wrist")),
    ("Shoulder", ("clavicle", "collar", "shoulder")),
)
_SIDE = re.compile(r"(?:^|[^a-z])(left|right|[lr])(?:[^a-z]|$)|^(left|right)|(left|right)$")
_SKIP = (
    "twist",
    "roll",
    "end",
    "nub",
    "thumb",
    "index",
    "middle",
    "ring",
    "pinky",
    "little",
    "finger",
    "helper",
    "ik",
)

_LIMBS = {"Arm": "ForeArm", "ForeArm": "Hand", "UpLeg": "Leg", "Leg": "Foot"}
"""Limbs whose rest directions are aligned, and the part that each points to; hands turn
with their forearms."""
Rest = Mapping[str, Float[Tensor, "3"]]
"""Part -> position of its joint in a rest pose."""


def family_table(family: str) -> dict[str, str]:
    """Part -> joint name of a known family: acclaim, cgspeed, humanik, mixamo, rigify or mannequin."""
    joined, pattern, replacement = _FAMILIES[family]
    left = joined.split()
    trunk = left[: len(TRUNK)]
    sided = left[len(TRUNK) :]
    right = [re.sub(pattern, replacement, name) for name in sided]
    return dict(zip(PARTS, [*trunk, *sided, *right], strict=True))


def find_parts(names: Sequence[str]) -> dict[str, str]:
    """Find the joint of each part in any skeleton, given with parents first; parts that it lacks are absent.

    A family's table is taken where its required parts are all there, under any common prefix such
    as `mixamorig:` (the family with the most parts wins); otherwise the parts are guessed from the
    words in the names.

    Raises:
        ValueError: a required part (hips, arms, legs) is found in neither way.
    """
    best: dict[str, str] = {}
    # What stands before the hips' name where joints have a namespace.
    found = {
        m.group(1) for name in names if (m := re.match(r"^(.+?[:_|.\- ])(?:hips|pelvis|root)$", name, re.I))
    }
    for prefix in ("", *sorted(found)):
        plain = {name[len(prefix) :].lower(): name for name in reversed(names) if name.startswith(prefix)}
        for family in _FAMILIES:
            joints = {part: plain.get(joint.lower()) for part, joint in family_table(family).items()}
            fitting = {part: joint for part, joint in joints.items() if joint is not None}
            if fitting.keys() >= set(REQUIRED) and len(fitting) > len(best):
                best = fitting
    best = best or _guess(names)
    missing = [part for part in REQUIRED if part not in best]
    if missing:
        raise ValueError(
            f"expected joints of a human skeleton, found none for {missing} among {list(names)[:60]}; "
            "rename the joints as in Mixamo (Hips, LeftUpLeg, LeftArm, ...)"
        )
    return best


def _words(name: str) -> str:
    """Split a name into lower-case words, also at camel case and separators."""
    split = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name)
    return re.sub(r"[^a-z0-9]+", " ", split.lower()).strip()


def _guess(names: Sequence[str]) -> dict[str, str]:
    """Guess parts by the words in the names: the joint nearest to the root wins a part."""
    found: dict[str, str] = {}
    trunk: list[str] = []
    for name in names:
        words = _words(name)
        tight = words.replace(" ", "")
        side = _SIDE.search(words)
        if any(skip in words.split() or (len(skip) > 3 and skip in tight) for skip in _SKIP):
            continue
        if side is None:
            trunk.append(name)
            continue
        label = "Left" if next(g for g in side.groups() if g).startswith("l") else "Right"
        part = next((part for part, keys in _WORDS if any(key in tight for key in keys)), None)
        if part is not None:
            found.setdefault(label + part, name)
    return found | _guess_trunk(trunk)


def _guess_trunk(trunk: Sequence[str]) -> dict[str, str]:
    """Guess hips, spine, neck and head among the joints without a side."""

    def first(*keys: str) -> str | None:
        return next((n for key in keys for n in trunk if key in _words(n).replace(" ", "")), None)

    spine = [n for n in trunk if re.search(r"spine|chest|torso|abdomen|lowerback|upperback|thorax", n, re.I)]
    chosen = {"Hips": first("hips", "pelvis", "hip", "root"), "Neck": first("neck"), "Head": first("head")}
    if spine:
        # The last joint of the back carries the collars; what lies between acts through its rotation.
        picks = [("Spine", spine[0]), ("Spine2", spine[-1]), ("Spine1", spine[len(spine) // 2])][: len(spine)]
        chosen |= {part: name for part, name in picks if name not in chosen.values()}
    return {part: name for part, name in chosen.items() if name is not None}


@dataclass(frozen=True)
class Retarget:
    """A motion prepared for a character: R_j(t) = G_s(j)(t) A_j R0_j for each mapped joint j.

    Both are first brought upright (y up, facing +z, metres): by a turn to the nearest axes, from
    where the hips, the head and the two sides lie in the rest poses, and the character by a power
    of ten where it is no one's height.
    """

    character: Character
    upright_from_file: Float[Tensor, "4 4"]
    """The motion that brings the character upright."""
    driver: tuple[int, ...]
    """Index into `rotations` of the joint that turns each node of the character; -1 for nodes that
    none turns."""
    rotations: Float[Tensor, "frame driver 3 3"]
    """G_s(j)(t) A_j R0_j of the driven nodes."""
    hips: int
    """Node of the hips."""
    hips_path: Float[Tensor, "frame 3"]
    """World positions of the hips, metres."""

    def joint_matrices(self, frame: float) -> Float[Tensor, "joint 4 4"]:
        """world_from_bind of every joint, at a frame or between two."""
        before = min(max(int(frame), 0), len(self.hips_path) - 1)
        after = min(before + 1, len(self.hips_path) - 1)
        fraction = frame - before
        turns = _orthonormal(torch.lerp(self.rotations[before], self.rotations[after], fraction))
        position = torch.lerp(self.hips_path[before], self.hips_path[after], fraction)
        world = node_matrices(
            self.character, self.upright_from_file, self.driver, turns, (self.hips, position)
        )
        return world[self.character.node_of_joint] @ self.character.joint_from_bind


def retarget(character: Character, motion: Motion) -> Retarget:
    """Retarget a motion to a character.

    Raises:
        ValueError: one of the skeletons has no hips, arms or legs by any known name.
    """
    names = [n.name for n in character.nodes]
    node_of = {part: names.index(name) for part, name in find_parts(names).items()}
    joint_of = {part: motion.names.index(name) for part, name in find_parts(motion.names).items()}
    file_rest = node_matrices(character, torch.eye(4))[:, :3, 3]
    upright = torch.eye(4)
    upright[:3, :3] = _upright({p: file_rest[n] for p, n in node_of.items()})
    height = float(file_rest[node_of["Hips"]].sub(file_rest[node_of["LeftFoot"]]).norm())
    # Hips are 0.6 to 1 m above the ankles of an adult; a file in centimetres is 100 times that.
    upright[:3, :3] *= 10.0 ** -round(float(torch.tensor(height / 0.8).log10()))
    rest = file_rest @ upright[:3, :3].T
    turn = _upright({p: motion.rest[j] for p, j in joint_of.items()})
    own = {p: rest[n] for p, n in node_of.items()}
    actor = {p: (motion.rest @ turn.T)[j] for p, j in joint_of.items()}
    rotations = turn @ motion.rotations @ turn.T

    parts = [p for p in PARTS if p in node_of and p in joint_of]
    rest_turns: list[Tensor] = []  # R0: global rest rotations, scale removed
    for node in character.nodes:
        above = upright[:3, :3] / upright[0, :3].norm() if node.parent < 0 else rest_turns[node.parent]
        rest_turns.append(above @ node.rotation)
    driven = [rotations[:, joint_of[p]] @ _alignment(p, own, actor) @ rest_turns[node_of[p]] for p in parts]
    driver = [-1] * len(names)
    for place, part in enumerate(parts):
        driver[node_of[part]] = place
    # s (p + G_root o_b) - G_root o_a, scaled by leg length: the middle of the hip joints moves as
    # the actor's.
    hips = _joint_path(motion, joint_of["Hips"]) @ turn.T
    hips_turn = rotations[:, joint_of["Hips"]]
    scale = _leg_length(own) / _leg_length(actor)
    path = scale * (hips + hips_turn @ _hip_middle(actor)) - hips_turn @ _hip_middle(own)
    return Retarget(character, upright, tuple(driver), torch.stack(driven, 1), node_of["Hips"], path)


def node_matrices(
    character: Character,
    upright_from_file: Float[Tensor, "4 4"],
    driver: tuple[int, ...] = (),
    turns: Float[Tensor, "driver 3 3"] | None = None,
    hips: tuple[int, Float[Tensor, "3"]] | None = None,
) -> Float[Tensor, "node 4 4"]:
    """Compute world matrices of the nodes; driven ones have the global rotations `turns`.

    Local translations and scales stay those of the file, but the hips' node (if given) is
    put at its position.
    """
    start = upright_from_file[:3, :3]
    unit = start / start[0].norm()
    linear: list[Tensor] = []
    turned: list[Tensor] = []
    moved: list[Tensor] = []
    for n, node in enumerate(character.nodes):
        parent = node.parent
        above, above_turn = (start, unit) if parent < 0 else (linear[parent], turned[parent])
        origin = upright_from_file[:3, 3] if parent < 0 else moved[parent]
        local = node.rotation if turns is None or driver[n] < 0 else above_turn.T @ turns[driver[n]]
        turned.append(above_turn @ local)
        linear.append((above @ local) * node.scale)
        moved.append(hips[1] if hips is not None and hips[0] == n else above @ node.translation + origin)
    return rigid(torch.stack(linear), torch.stack(moved))


def _upright(rest: Rest) -> Float[Tensor, "3 3"]:
    """Find the rotation by right angles that brings a rest pose to y up and its left side to +x."""

    def nearest_axis(v: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
        axis = torch.zeros(3)
        n = int(v.abs().argmax())
        axis[n] = v[n].sign()
        return axis

    up = nearest_axis(
        (rest["LeftUpLeg"] + rest["RightUpLeg"]) / 2 - (rest["LeftFoot"] + rest["RightFoot"]) / 2
    )
    left = rest["LeftUpLeg"] - rest["RightUpLeg"]
    side = nearest_axis(left - (left @ up) * up)
    return torch.stack([side, up, torch.linalg.cross(side, up)])


def _alignment(part: str, own: Rest, actor: Rest) -> Float[Tensor, "3 3"]:
    """A_j: the smallest rotation from the character's bone direction at rest to the motion's."""
    side = "Left" if part.startswith("Left") else "Right"
    limb = "ForeArm" if part == side + "Hand" else part.removeprefix(side)
    start = side + limb
    end = side + _LIMBS.get(limb, "")
    if not all(p in own and p in actor for p in (start, end)):
        return torch.eye(3)
    a, b = ((rest[end] - rest[start]) / (rest[end] - rest[start]).norm() for rest in (own, actor))
    cosine = float(a @ b)
    if cosine < -1 + 1e-6:
        # Opposite: any half turn.
        axis = torch.linalg.cross(a, torch.eye(3)[int(a.abs().argmin())])
        axis = axis / axis.norm()
        return 2 * torch.outer(axis, axis) - torch.eye(3)
    v = torch.linalg.cross(a, b)
    zero = torch.zeros(())
    skew = torch.stack([zero, -v[2], v[1], v[2], zero, -v[0], -v[1], v[0], zero]).reshape(3, 3)
    return torch.eye(3) + skew + skew @ skew / (1 + cosine)


def _joint_path(motion: Motion, joint: int) -> Float[Tensor, "frame 3"]:
    """World positions of a joint of the motion."""
    path = motion.root
    while (parent := motion.parents[joint]) >= 0:
        path = path + motion.rotations[:, parent] @ (motion.rest[joint] - motion.rest[parent])
        joint = parent
    return path


def _hip_middle(rest: Rest) -> Float[Tensor, "3"]:
    return (rest["LeftUpLeg"] + rest["RightUpLeg"]) / 2 - rest["Hips"]


def _leg_length(rest: Rest) -> float:
    sides = [[rest[side + part] for part in ("UpLeg", "Leg", "Foot")] for side in ("Left", "Right")]
    return sum(float((knee - hip).norm() + (foot - knee).norm()) / 2 for hip, knee, foot in sides)


def _orthonormal(matrices: Float[Tensor, "batch 3 3"]) -> Float[Tensor, "batch 3 3"]:
    """Find the rotations nearest to blends of two close rotations (Gram-Schmidt; exact for rotations)."""
    x = torch.nn.functional.normalize(matrices[..., 0], dim=-1)
    y = matrices[..., 1] - (matrices[..., 1] * x).sum(-1, keepdim=True) * x
    y = torch.nn.functional.normalize(y, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)
