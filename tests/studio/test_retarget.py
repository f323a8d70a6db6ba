from dataclasses import replace

import pytest
import torch
from studio.tiny_performer import BVH_JOINTS, JOINTS, write_character, write_motion

from viewmend.data.errors import CaptureError
from viewmend.studio.bvh import read_bvh
from viewmend.studio.gltf import load_character
from viewmend.studio.gltf_performer import ROAM_M, SLOW_S, GltfPerformer, _stage_shift
from viewmend.studio.retarget import (
    PARTS,
    REQUIRED,
    Retarget,
    family_table,
    find_parts,
    node_matrices,
    retarget,
)


def pose_at(body: Retarget, frame: int) -> torch.Tensor:
    """World matrices of the nodes in a frame."""
    hips = body.hips, body.hips_path[frame]
    return node_matrices(body.character, body.upright_from_file, body.driver, body.rotations[frame], hips)


FAMILIES = ("acclaim", "cgspeed", "humanik", "mixamo", "rigify", "mannequin")


def test_limbs_point_as_the_actors_do(character_file, motion_file):
    character, motion = load_character(character_file), read_bvh(motion_file)
    world = pose_at(retarget(character, motion), 3)
    at = {n.name: world[i, :3, 3] for i, n in enumerate(character.nodes)}
    offsets = {name: torch.tensor(o, dtype=torch.float32) for name, (_, o) in BVH_JOINTS.items()}
    for (start, end), (joint, child) in {
        ("LeftArm", "LeftForeArm"): ("LeftShoulder", "LeftElbow"),
        ("RightUpLeg", "RightLeg"): ("RightHip", "RightKnee"),
        ("RightLeg", "RightFoot"): ("RightKnee", "RightAnkle"),
    }.items():
        bone = motion.rotations[3, motion.names.index(joint)] @ offsets[child]
        a = torch.nn.functional.normalize(at[end] - at[start], dim=0)
        torch.testing.assert_close(a, bone / bone.norm(), atol=1e-4, rtol=0)
    for part, joint in (
        ("Hips", "Hips"),
        ("Spine", "lowerback"),
    ):  # they turn as a whole, from their rest pose
        node = [n.name for n in character.nodes].index(part)
        turn = torch.nn.functional.normalize(world[node, :3, :3], dim=0)
        torch.testing.assert_close(turn, motion.rotations[3, motion.names.index(joint)], atol=1e-4, rtol=0)


def test_hips_are_where_the_actors_are_in_the_size_of_the_character(character_file, motion_file):
    character, motion = load_character(character_file), read_bvh(motion_file)

    def legs(at, *parts):
        """Their length, and the middle between the hip joints."""
        sides = [[torch.as_tensor(at[side + part]) for part in parts] for side in ("Left", "Right")]
        return sum((a - b).norm() + (b - c).norm() for a, b, c in sides), (sides[0][0] + sides[1][0]) / 2

    body = retarget(character, motion)
    actor_cm, middle_cm = legs(dict(zip(motion.names, motion.rest, strict=True)), "Hip", "Knee", "Ankle")
    own_m, _ = legs({name: place for name, (_, place) in JOINTS.items()}, "UpLeg", "Leg", "Foot")
    for frame in (0, 1, 3):
        world = pose_at(body, frame)
        at = {n.name: world[i, :3, 3] for i, n in enumerate(character.nodes)}
        expected_cm = motion.root[frame] + motion.rotations[frame, 0] @ middle_cm
        found = (at["LeftUpLeg"] + at["RightUpLeg"]) / 2
        torch.testing.assert_close(found, expected_cm * own_m / actor_cm, atol=1e-4, rtol=0)


def test_other_axes_and_units_change_nothing(character_file, motion_file):
    """The same motion with z up and in another unit puts the character into the same pose."""
    character, motion = load_character(character_file), read_bvh(motion_file)
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    rest, root = 3 * motion.rest @ turn.T, 3 * motion.root @ turn.T
    other = replace(motion, rest=rest, rotations=turn @ motion.rotations @ turn.T, root=root)
    a, b = retarget(character, motion), retarget(character, other)
    torch.testing.assert_close(a.joint_matrices(2.0), b.joint_matrices(2.0), atol=1e-4, rtol=0)


@pytest.mark.parametrize("height_m", [0.45, 0.8, 1.4])
@pytest.mark.parametrize("per_m", [1, 10, 100, 1000])
def test_units_are_powers_of_ten_and_nobody_is_resized(character_file, motion_file, height_m, per_m):
    """Of a child, an adult and a giant, in metres to millimetres; by how far the hips are from the foot."""
    character, motion = load_character(character_file), read_bvh(motion_file)
    file = node_matrices(character, torch.eye(4))[:, :3, 3]
    parts = find_parts([n.name for n in character.nodes])
    place = {part: [n.name for n in character.nodes].index(name) for part, name in parts.items()}
    factor = height_m * per_m / float((file[place["Hips"]] - file[place["LeftFoot"]]).norm())
    nodes = [replace(n, translation=factor * n.translation) for n in character.nodes]
    body = retarget(replace(character, nodes=tuple(nodes)), motion)
    torch.testing.assert_close(body.upright_from_file[:3, :3].norm(dim=0), torch.full((3,), 1.0 / per_m))


def test_between_frames_is_between(character_file, tmp_path):
    motion = write_motion(
        tmp_path / "slow.bvh", {"Hips": (10, 20, 40), "LeftShoulder": (80, 10, -30)}, frames=30
    )
    body = retarget(load_character(character_file), read_bvh(motion))
    before, middle, after = (body.joint_matrices(f) for f in (7.0, 7.5, 8.0))
    assert float((after - before).abs().max()) > 0.02
    # The chord of 5 degrees is within a thousandth of its arc.
    torch.testing.assert_close(middle, (before + after) / 2, atol=2e-3, rtol=0)
    R = middle[0, :3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3), atol=1e-4, rtol=0)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("prefix", ["", "mixamorig:"])
def test_families_are_recognised(family, prefix):
    table = family_table(family)
    assert tuple(table) == PARTS
    names = [prefix + n for n in table.values()]
    assert find_parts(names) == {part: prefix + name for part, name in table.items()}


def test_right_sides_mirror_left_ones():
    feet = {f: family_table(f)["RightFoot"] for f in FAMILIES}
    assert feet == {
        "acclaim": "rfoot", "cgspeed": "RightAnkle", "humanik": "RightFoot", "mixamo": "RightFoot",
        "rigify": "DEF-foot.R", "mannequin": "foot_r",
    }  # fmt: skip


def test_other_names_are_read():
    sided = ("UpperLeg", "LowerLeg", "Foot", "Toes", "Shoulder", "UpperArm", "LowerArm", "Hand", "Thumb1")
    names = [
        "J_Bip_C_Hips",
        "J_Bip_C_Spine",
        "J_Bip_C_Chest",
        "J_Bip_C_UpperChest",
        "J_Bip_C_Neck",
        "J_Bip_C_Head",
    ]
    names += [f"J_Bip_{side}_{part}" for side in "LR" for part in sided]
    found = find_parts(names)
    assert set(REQUIRED) <= set(found)
    expected = {
        "Hips": "J_Bip_C_Hips", "Spine": "J_Bip_C_Spine", "Spine2": "J_Bip_C_UpperChest", "Head": "J_Bip_C_Head",
        "LeftUpLeg": "J_Bip_L_UpperLeg", "RightLeg": "J_Bip_R_LowerLeg", "LeftForeArm": "J_Bip_L_LowerArm",
        "RightArm": "J_Bip_R_UpperArm", "LeftShoulder": "J_Bip_L_Shoulder", "LeftHand": "J_Bip_L_Hand",
        "LeftToeBase": "J_Bip_L_Toes",
    }  # fmt: skip
    assert {part: found[part] for part in expected} == expected


def test_a_table_is_no_person(tmp_path, motion_file):
    with pytest.raises(ValueError, match="human skeleton"):
        find_parts(["Table", "leg_front_left"])
    broken = write_character(tmp_path / "x.glb", prefix="bone_q")
    broken.write_bytes(broken.read_bytes().replace(b"LeftUpLeg", b"LeftXXXXX"))
    with pytest.raises(CaptureError, match=r"x\.glb with .*wave\.bvh"):
        GltfPerformer(broken, motion_file)


def test_a_pose_is_a_function_of_time_and_seed(character_file, motion_file):
    a = GltfPerformer(character_file, motion_file, seed=5)
    b = GltfPerformer(character_file, motion_file, seed=5)
    b.pose(0.09)
    assert torch.equal(a.pose(0.04).mesh.vertices, b.pose(0.04).mesh.vertices)
    c = GltfPerformer(character_file, motion_file, seed=6)
    assert not torch.equal(a.pose(0.04).mesh.vertices, c.pose(0.04).mesh.vertices)


def test_a_clip_runs_back_and_forth_past_its_end(character_file, motion_file):
    performer = GltfPerformer(character_file, motion_file)
    step = performer.motion.seconds_per_frame
    turned = performer.pose(4 * step).mesh.vertices
    torch.testing.assert_close(turned, performer.pose(2 * step).mesh.vertices, atol=1e-5, rtol=0)


def test_a_path_of_any_length_is_smoothed(motion_file):
    motion = replace(read_bvh(motion_file), seconds_per_frame=1 / 60)
    path = torch.cumsum(0.02 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), 0)
    for count in (1, 2, 40, 500):
        flat = path[:count].double() * torch.tensor([1.0, 0.0, 1.0])
        times_s = torch.arange(count) / 60.0
        weights = torch.exp(-0.5 * ((times_s[:, None] - times_s) / SLOW_S) ** 2).double()
        slow = weights @ flat / weights.sum(1, keepdim=True)
        away = slow - slow[count // 2]
        distance = away.norm(dim=1, keepdim=True).clamp(min=1e-6)
        expected = away / distance * ROAM_M * torch.tanh(distance / ROAM_M) - slow
        found = _stage_shift(path[:count], motion, count // 2 / 60)
        torch.testing.assert_close(found, expected.float(), atol=1e-6, rtol=1e-6)
    hour = _stage_shift(torch.zeros(216_000, 3), motion, 0.0)  # a matrix of all pairs would take 187 GB
    assert not hour.any()


def test_a_performer_stands_on_the_floor_near_the_centre(character_file, tmp_path):
    far = write_motion(tmp_path / "far.bvh", frames=150, travel_cm=900)
    performer = GltfPerformer(character_file, far, seed=2)
    for t in (0.0, 0.05, 2.1, 4.0, 5.5, 7.0):
        vertices = performer.pose(t).mesh.vertices
        assert float(vertices[:, [0, 2]].mean(0).norm()) < 1.2
        assert abs(float(vertices[:, 1].min())) < 0.05
