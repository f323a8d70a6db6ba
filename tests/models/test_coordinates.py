"""Patches lifted by the proxy and carried into the novel view (section 5)."""

from dataclasses import replace

import torch
from models.plates import DISTANCE_M, FOCAL_PX, HEIGHT, OFFSETS_M, WIDTH, camera, context, encode, tiny, view
from reference.ball import camera_at

from viewmend.geometry.cameras import unproject
from viewmend.models.paper.context import ContextFrame, Target, collate
from viewmend.models.paper.patches import patch_depths, reproject


def test_depth_of_a_patch_is_the_mean_at_its_centre_or_the_median_of_its_foreground():
    depth = torch.zeros(1, 28, 60)
    foreground = torch.zeros(1, 28, 60, dtype=torch.bool)
    depth[0, 0, :5] = torch.tensor([1.0, 2.0, 5.0, 9.0, 9.0])
    foreground[0, 0, :3] = True
    depth[0, 13, 29] = 3.0
    depth[0, 14, 30] = 7.0
    assert patch_depths(depth, foreground).tolist() == [[[2.0, 5.0, 0.0]]]


def test_a_context_patch_lands_on_the_same_point_of_the_plate():
    for frame in encode(tiny(), context(0)):
        uv, valid = reproject(frame.points_world, frame.valid, camera("novel"))
        shift_px = (OFFSETS_M[frame.camera.names[0]] - OFFSETS_M["novel"]) * FOCAL_PX / DISTANCE_M
        expected = frame.uv_px + torch.tensor([shift_px, 0.0])
        assert valid.all() and frame.uv_px.shape[0] > 5
        assert torch.allclose(uv * torch.tensor([WIDTH, HEIGHT]), expected, atol=1e-3)


def test_points_behind_the_view_or_without_depth_are_invalid():
    points = torch.tensor([[0.0, 0, 2], [0, 0, -2], [5, 0, 2], [0, 0, 3]])
    uv, valid = reproject(points, torch.tensor([True, True, True, False]), camera("novel"))
    assert valid.tolist() == [True, False, True, False]
    assert uv[2, 0] > 1, "coordinates outside of the image are kept"


def carry(now_depth):
    """A frame of three frames ago and its positions, if its camera now has the proxy at `now_depth` metres."""
    net, now = tiny(), context(5)
    now = replace(now, depth=now.depth / DISTANCE_M * now_depth)
    past, now = encode(net, context(2))[0], encode(net, now)[0]
    none = torch.zeros(0, 3, dtype=torch.long)
    target = Target(
        view=view(5), places=none, tokens=torch.zeros(0, 64), incomplete=torch.zeros(0, dtype=torch.bool)
    )
    batch = collate([target], [[past, now]], [past.keys_values[:, :, :0]], net.config)
    n = len(past.tokens)
    return past, batch.context_at.uvs[0, :n], batch.context_at.present[0, :n]


def test_past_patches_are_carried_by_the_current_geometry():
    focal = FOCAL_PX / WIDTH * (OFFSETS_M["left"] - OFFSETS_M["novel"])
    past, uvs, present = carry(4.0)
    past_u = past.uv_px[:, 0] / past.camera.size_px[0, 0]
    assert torch.allclose(uvs[present, 0], (past_u + focal / 4.0)[present], atol=1e-4)
    assert present.float().mean() > 0.7
    assert torch.allclose(uvs[:, 2], torch.tensor(3 / 8)), "s = (t - tau) / (k_w n_w)"
    assert not carry(0.0)[2].any(), "patches without depth are dropped"


def test_a_frame_lifted_by_another_has_points_only_where_that_one_has_depth():
    places, uv = torch.tensor([[0, 0], [0, 1], [1, 0], [5, 5]]), torch.rand(4, 2) * 40
    at, valid, memory = camera_at(10, "c"), torch.ones(4, dtype=torch.bool), torch.zeros(1, 2, 4, 8)
    older = ContextFrame(
        at, 3, places, uv, torch.zeros(4, 3), valid, torch.ones(6, 6), torch.zeros(4, 8), memory
    )
    now = replace(older, time=4, depths=torch.tensor([[2.0, 0.0], [1.5, 3.0]]))
    points, lifted = older.lifted_by(now)
    assert lifted.tolist() == [True, False, True, False]
    torch.testing.assert_close(points[[0, 2]], unproject(uv[None, [0, 2]], torch.tensor([[2.0, 1.5]]), at)[0])


def test_complete_patches_of_the_view_join_the_context():
    net, incomplete = tiny(), view(5)
    with torch.no_grad():
        (target,) = net.encode_targets([incomplete])
        batch = net.collate([target], [[]])
    centres = (target.places[:, [2, 1]] * 16 + 14) / torch.tensor([WIDTH, HEIGHT])
    assert torch.allclose(batch.at.uvs[0, :, :2], centres[target.incomplete])
    assert torch.allclose(batch.context_at.uvs[0, :, :2], centres[~target.incomplete])
    assert not batch.context_at.uvs[..., 2].any() and batch.context_at.present.all()
    for place, is_input in zip(target.places.tolist(), target.incomplete.tolist(), strict=True):
        rows, cols = slice(place[1] * 16, place[1] * 16 + 28), slice(place[2] * 16, place[2] * 16 + 28)
        assert bool((incomplete.error[rows, cols] > 0).any()) == is_input
