from dataclasses import replace

import numpy as np
import pytest
import torch
from data.synthetic.tiny_performer import BVH_JOINTS, JOINTS, write_character, write_motion
from reference.retarget_twin import retarget_twin

from viewmend.data.errors import CaptureError
from viewmend.data.synthetic.bvh import read_bvh
from viewmend.data.synthetic.gltf import load_character
from viewmend.data.synthetic.gltf_performer import GltfPerformer
from viewmend.data.synthetic.retarget import (
    PARTS,
    REQUIRED,
    family_table,
    find_parts,
    node_matrices,
    retarget,
    smallest_rotation,
)

FAMILIES = ("acclaim", "cgspeed", "humanik", "mixamo", "rigify", "mannequin")


@pytest.mark.parametrize("frame", [0, 1, 3])
def test_equals_its_twin(character_file, motion_file, frame):
    character, motion = load_character(character_file), read_bvh(motion_file)
    body = retarget(character, motion)
    world = retarget_twin(character, motion, frame)
    expected = world[character.node_of_joint.numpy()] @ character.joint_from_bind.numpy()
    # float32 rounding of metres.
    np.testing.assert_allclose(body.joint_matrices(float(frame)).numpy(), expected, atol=2e-5)


def test_limbs_point_as_the_actors_do(character_file, motion_file):
    character, motion = load_character(character_file), read_bvh(motion_file)
    body = retarget(character, motion)
    turns = body.rotations[3]
    world = node_matrices(character, body.upright_from_file, body.driver, turns, (body.hips, body.hips_path[3]))
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


def test_other_axes_and_units_change_nothing(character_file, motion_file):
    """The same motion with z up and in another unit puts the character into the same pose."""
    character, motion = load_character(character_file), read_bvh(motion_file)
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    other = type(motion)(
        motion.names,
        motion.parents,
        3 * motion.rest @ turn.T,
        turn @ motion.rotations @ turn.T,
        3 * motion.root @ turn.T,
        motion.seconds_per_frame,
    )
    a, b = retarget(character, motion), retarget(character, other)
    torch.testing.assert_close(a.joint_matrices(2.0), b.joint_matrices(2.0), atol=1e-4, rtol=0)


@pytest.mark.parametrize("height_m", [0.45, 0.8, 1.4])
@pytest.mark.parametrize("per_m", [1, 10, 100, 1000])
def test_units_are_powers_of_ten_and_nobody_is_resized(character_file, motion_file, height_m, per_m):
    """Of a child, an adult and a giant, in metres to millimetres; by how far the hips are from the foot."""
    character, motion = load_character(character_file), read_bvh(motion_file)
    file = node_matrices(character, torch.eye(4), (-1,) * len(character.nodes), torch.zeros(0, 3, 3), None)[:, :3, 3]
    parts = find_parts([n.name for n in character.nodes], [n.parent for n in character.nodes])
    place = {part: [n.name for n in character.nodes].index(name) for part, name in parts.items()}
    factor = height_m * per_m / float((file[place["Hips"]] - file[place["LeftFoot"]]).norm())
    nodes = [replace(n, translation=factor * n.translation) for n in character.nodes]
    body = retarget(replace(character, nodes=tuple(nodes)), motion)
    torch.testing.assert_close(body.upright_from_file[:3, :3].norm(dim=0), torch.full((3,), 1.0 / per_m))


def test_between_frames_is_between(character_file, tmp_path):
    motion = write_motion(tmp_path / "slow.bvh", {"Hips": (10, 20, 40), "LeftShoulder": (80, 10, -30)}, frames=30)
    body = retarget(load_character(character_file), read_bvh(motion))
    before, middle, after = (body.joint_matrices(f) for f in (7.0, 7.5, 8.0))
    assert float((after - before).abs().max()) > 0.02
    # The chord of 5 degrees is within a thousandth of its arc.
    torch.testing.assert_close(middle, (before + after) / 2, atol=2e-3, rtol=0)
    R = middle[0, :3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3), atol=1e-4, rtol=0)


def test_smallest_rotation():
    generator = torch.Generator().manual_seed(1)
    for a, b in torch.randn(20, 2, 3, generator=generator):
        R = smallest_rotation(a, b)
        torch.testing.assert_close(R @ (a / a.norm()), b / b.norm(), atol=1e-5, rtol=0)
        torch.testing.assert_close(R @ R.T, torch.eye(3), atol=1e-5, rtol=0)
        axis = torch.linalg.cross(a, b)
        torch.testing.assert_close(R @ axis, axis, atol=1e-4, rtol=1e-4)
    x = torch.tensor([1.0, 0, 0])
    torch.testing.assert_close(smallest_rotation(x, -x) @ x, -x)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("prefix", ["", "mixamorig:"])
def test_families_are_recognised(family, prefix):
    table = family_table(family)
    assert tuple(table) == PARTS
    names = [prefix + n for n in table.values()]
    if prefix and not names[0].lower().endswith(("hips", "pelvis", "root")):
        pytest.skip("a namespace is found by the hips' name")
    parents = range(-1, len(names) - 1)
    assert find_parts(names, list(parents)) == {part: prefix + name for part, name in table.items()}


def test_right_sides_mirror_left_ones():
    feet = {f: family_table(f)["RightFoot"] for f in FAMILIES}
    assert feet == {
        "acclaim": "rfoot", "cgspeed": "RightAnkle", "humanik": "RightFoot", "mixamo": "RightFoot",
        "rigify": "DEF-foot.R", "mannequin": "foot_r",
    }  # fmt: skip


def test_other_names_are_read():
    sided = ("UpperLeg", "LowerLeg", "Foot", "Toes", "Shoulder", "UpperArm", "LowerArm", "Hand", "Thumb1")
    names = ["J_Bip_C_Hips", "J_Bip_C_Spine", "J_Bip_C_Chest", "J_Bip_C_UpperChest", "J_Bip_C_Neck", "J_Bip_C_Head"]
    names += [f"J_Bip_{side}_{part}" for side in "LR" for part in sided]
    found = find_parts(names, list(range(-1, len(names) - 1)))
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
        find_parts(["Table", "leg_front_left"], [-1, 0])
    broken = write_character(tmp_path / "x.glb", prefix="bone_q")
    text = broken.read_bytes().replace(b"LeftUpLeg", b"LeftXXXXX")
    broken.write_bytes(text)
    with pytest.raises(CaptureError, match=r"x\.glb with .*wave\.bvh"):
        GltfPerformer(broken, motion_file)


def test_a_prefix_changes_nothing(tmp_path, motion_file, character_file):
    plain = GltfPerformer(character_file, motion_file, seed=3)
    named = GltfPerformer(write_character(tmp_path / "n.glb", prefix="mixamorig:"), motion_file, seed=3)
    torch.testing.assert_close(plain.pose(0.05).mesh.vertices, named.pose(0.05).mesh.vertices)


class TestPerformer:
    def test_is_a_function_of_time_and_seed(self, character_file, motion_file):
        a = GltfPerformer(character_file, motion_file, seed=5)
        b = GltfPerformer(character_file, motion_file, seed=5)
        b.pose(0.09)
        assert torch.equal(a.pose(0.04).mesh.vertices, b.pose(0.04).mesh.vertices)
        c = GltfPerformer(character_file, motion_file, seed=6)
        assert not torch.equal(a.pose(0.04).mesh.vertices, c.pose(0.04).mesh.vertices)

    def test_runs_back_and_forth_past_its_end(self, character_file, motion_file):
        performer = GltfPerformer(character_file, motion_file)
        step = performer.motion.seconds_per_frame
        turned = performer.pose(4 * step).mesh.vertices
        torch.testing.assert_close(turned, performer.pose(2 * step).mesh.vertices, atol=1e-5, rtol=0)

    def test_stands_on_the_floor_near_the_centre(self, character_file, tmp_path):
        far = write_motion(tmp_path / "far.bvh", frames=150, travel_cm=900)
        performer = GltfPerformer(character_file, far, seed=2)
        for t in (0.0, 0.05, 2.1, 4.0, 5.5, 7.0):
            vertices = performer.pose(t).mesh.vertices
            assert float(vertices[:, [0, 2]].mean(0).norm()) < 1.2
            assert abs(float(vertices[:, 1].min())) < 0.05

    def test_left_is_red_and_at_plus_x_before_the_turn(self, character_file, tmp_path):
        performer = GltfPerformer(character_file, write_motion(tmp_path / "still.bvh"), seed=1)
        performer._stage_from_motion = torch.eye(3)
        vertices = performer.pose(0.0).mesh.vertices.reshape(len(JOINTS), 8, 3).mean(1)
        names = list(JOINTS)
        assert float(vertices[names.index("LeftArm"), 0]) > float(vertices[names.index("RightArm"), 0]) + 0.3
