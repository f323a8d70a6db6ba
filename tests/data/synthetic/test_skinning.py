import torch

from viewmend.data.synthetic.performer import skin, skin_with_normals
from viewmend.geometry.rigid import rigid, rotation_from_axis_angle


def random_case(rng: torch.Generator, vertices: int = 50, joints: int = 5):
    weights = torch.rand(vertices, 4, generator=rng)
    weights = weights / weights.sum(1, keepdim=True)
    index = torch.randint(0, joints, (vertices, 4), generator=rng)
    turns = rotation_from_axis_angle(torch.randn(joints, 3, generator=rng))
    motions = rigid(turns, torch.randn(joints, 3, generator=rng))
    return torch.randn(vertices, 3, generator=rng), index, weights, motions


def test_skin_is_the_weighted_mean_of_rigid_motions(rng):
    points, joints, weights, motions = random_case(rng)
    expected = torch.zeros_like(points)
    for v in range(len(points)):
        for slot in range(4):
            motion = motions[joints[v, slot]]
            expected[v] += weights[v, slot] * (motion[:3, :3] @ points[v] + motion[:3, 3])
    torch.testing.assert_close(skin(points, joints, weights, motions), expected)


def test_one_joint_moves_rigidly_and_turns_the_normals(rng):
    points, joints, weights, motions = random_case(rng)
    joints = torch.full_like(joints, 2)
    normals = torch.nn.functional.normalize(torch.randn(len(points), 3, generator=rng), dim=-1)
    moved, turned = skin_with_normals(points, normals, joints, weights, motions)
    torch.testing.assert_close(moved, points @ motions[2, :3, :3].T + motions[2, :3, 3])
    torch.testing.assert_close(turned, normals @ motions[2, :3, :3].T)
    torch.testing.assert_close(moved, skin(points, joints, weights, motions))
