"""The retarget rule, joint by joint and frame by frame, in plain numpy."""

import numpy as np

from viewmend.data.synthetic.bvh import Motion
from viewmend.data.synthetic.gltf import Character
from viewmend.data.synthetic.retarget import find_parts

LIMB_ENDS = {"Arm": "ForeArm", "ForeArm": "Hand", "UpLeg": "Leg", "Leg": "Foot"}


def rest_pose(character: Character) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World matrices, and pure rotations, of the nodes at rest; positions."""
    matrices, turns = [], []
    for node in character.nodes:
        local = np.eye(4)
        local[:3, :3] = node.rotation.numpy() @ np.diag(node.scale.numpy())
        local[:3, 3] = node.translation.numpy()
        above = np.eye(4) if node.parent < 0 else matrices[node.parent]
        turn = np.eye(3) if node.parent < 0 else turns[node.parent]
        matrices.append(above @ local)
        turns.append(turn @ node.rotation.numpy())
    return np.array(matrices), np.array(turns), np.array(matrices)[:, :3, 3]


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation from direction a to direction b, by axis and angle."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    if np.linalg.norm(axis) < 1e-9:
        return np.eye(3)
    angle = np.arctan2(np.linalg.norm(axis), a @ b)
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def retarget_twin(character: Character, motion: Motion, frame: int) -> np.ndarray:
    """World matrices of the character's nodes in one frame."""
    names = [n.name for n in character.nodes]
    at = {p: names.index(n) for p, n in find_parts(names, [n.parent for n in character.nodes]).items()}
    drive = {p: motion.names.index(n) for p, n in find_parts(motion.names, motion.parents).items()}
    _, rest_turns, rest = rest_pose(character)
    source = motion.rest.numpy()
    G = motion.rotations[frame].numpy()

    def leg(points: np.ndarray, index: dict[str, int]) -> float:
        return sum(
            np.linalg.norm(points[index[s + "Leg"]] - points[index[s + "UpLeg"]])
            + np.linalg.norm(points[index[s + "Foot"]] - points[index[s + "Leg"]])
            for s in ("Left", "Right")
        )

    def middle(points: np.ndarray, index: dict[str, int]) -> np.ndarray:
        return (points[index["LeftUpLeg"]] + points[index["RightUpLeg"]]) / 2 - points[index["Hips"]]

    s = leg(rest, at) / leg(source, drive)
    root = G[drive["Hips"]]
    hips = s * (motion.root[frame].numpy() + root @ middle(source, drive)) - root @ middle(rest, at)
    part_at = {index: part for part, index in at.items() if part in drive}
    matrices, turns = [], []
    for n, node in enumerate(character.nodes):
        above = np.eye(4) if node.parent < 0 else matrices[node.parent]
        above_turn = np.eye(3) if node.parent < 0 else turns[node.parent]
        turn = above_turn @ node.rotation.numpy()
        if n in part_at:
            part = part_at[n]
            side = "Left" if part.startswith("Left") else "Right" if part.startswith("Right") else ""
            limb = part[len(side) :].replace("Hand", "ForeArm") if side else ""
            A = np.eye(3)
            if limb in LIMB_ENDS:
                start, end = side + limb, side + LIMB_ENDS[limb]
                A = between(rest[at[end]] - rest[at[start]], source[drive[end]] - source[drive[start]])
            turn = G[drive[part]] @ A @ rest_turns[n]
        local = np.eye(4)
        local[:3, :3] = above_turn.T @ turn @ np.diag(node.scale.numpy())
        local[:3, 3] = node.translation.numpy()
        world = above @ local
        if n == at["Hips"]:
            world[:3, 3] = hips
        matrices.append(world)
        turns.append(turn)
    return np.array(matrices)
