"""Which joint of a skeleton plays which part: tables of known families, and names read for the others."""

import re
from collections.abc import Sequence

SIDED = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
TRUNK = ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head")
PARTS = (*TRUNK, *(side + part for side in ("Left", "Right") for part in SIDED))
"""Parts of a body, parents before children: named as in HumanIK and Mixamo; Spine2 carries the collars."""

REQUIRED = ("Hips", *(side + part for side in ("Left", "Right") for part in ("Arm", "ForeArm", "UpLeg", "Leg", "Foot")))

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
_SKIP = ("twist", "roll", "end", "nub", "thumb", "index", "middle", "ring", "pinky", "little", "finger", "helper", "ik")


def family_table(family: str) -> dict[str, str]:
    """Part -> joint name of a known family: acclaim, cgspeed, humanik, mixamo, rigify or mannequin."""
    joined, pattern, replacement = _FAMILIES[family]
    left = joined.split()
    trunk, sided = left[: len(TRUNK)], left[len(TRUNK) :]
    right = [re.sub(pattern, replacement, name) for name in sided]
    return dict(zip(PARTS, [*trunk, *sided, *right], strict=True))


def find_parts(names: Sequence[str], parents: Sequence[int]) -> dict[str, str]:
    """Part -> joint name of any skeleton; parts that it lacks are absent.

    A family's table is taken where its required parts are all there, under any common prefix such as `mixamorig:`
    (the family with the most parts wins); otherwise the parts are guessed from the words in the names.

    Args:
        names: joints, parents before children.
        parents: position of each joint's parent, -1 for a root.

    Raises:
        ValueError: a required part (hips, arms, legs) is found in neither way.
    """
    best: dict[str, str] = {}
    for prefix in _prefixes(names):
        plain = {name[len(prefix) :].lower(): name for name in reversed(names) if name.startswith(prefix)}
        for family in _FAMILIES:
            table = family_table(family)
            found = {part: plain[joint.lower()] for part, joint in table.items() if joint.lower() in plain}
            if all(part in found for part in REQUIRED) and len(found) > len(best):
                best = found
    best = best or _guess(names, parents)
    missing = [part for part in REQUIRED if part not in best]
    if missing:
        raise ValueError(
            f"expected joints of a human skeleton, found none for {missing} among {list(names)[:60]}; "
            "rename the joints as in Mixamo (Hips, LeftUpLeg, LeftArm, ...)"
        )
    return best


def _prefixes(names: Sequence[str]) -> list[str]:
    """The empty prefix, and what stands before the hips' name where joints have a namespace."""
    found = {m.group(1) for name in names if (m := re.match(r"^(.+?[:_|.\- ])(?:hips|pelvis|root)$", name, re.I))}
    return ["", *sorted(found)]


def _words(name: str) -> str:
    """Lower case, camel case split by blanks, other separators as blanks."""
    split = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name)
    return re.sub(r"[^a-z0-9]+", " ", split.lower()).strip()


def _guess(names: Sequence[str], parents: Sequence[int]) -> dict[str, str]:
    """Parts by the words in the names: the joint nearest to the root wins a part."""
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
    return found | _guess_trunk(trunk, names, parents)


def _guess_trunk(trunk: Sequence[str], names: Sequence[str], parents: Sequence[int]) -> dict[str, str]:
    """Hips, spine, neck and head among the joints without a side."""

    def first(*keys: str) -> str | None:
        return next((n for key in keys for n in trunk if key in _words(n).replace(" ", "")), None)

    spine = [n for n in trunk if re.search(r"spine|chest|torso|abdomen|lowerback|upperback|thorax", n, re.I)]
    chosen = {"Hips": first("hips", "pelvis", "hip", "root"), "Neck": first("neck"), "Head": first("head")}
    if spine:
        # The last joint of the back carries the collars; what lies between acts through its rotation.
        picks = {"Spine": spine[0], "Spine2": spine[-1], "Spine1": spine[len(spine) // 2]}
        chosen |= {part: name for part, name in picks.items() if name not in chosen.values()}
        if len(spine) < 3:
            chosen.pop("Spine1", None)
        if len(spine) < 2:
            chosen.pop("Spine2", None)
    return {part: name for part, name in chosen.items() if name is not None}
