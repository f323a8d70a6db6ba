"""Patches lifted by the proxy and carried into the novel view."""

from dataclasses import replace

import torch
from inpainting.plates import (
    DISTANCE_M,
    FOCAL_PX,
    HEIGHT,
    NAMES,
    OFFSETS_M,
    WIDTH,
    camera,
    context,
    encode,
    patches,
    tiny,
    view,
)

from viewmend.inpainting.assembly import Target, assemble
from viewmend.inpainting.coordinates import patch_depths, relative_depth, reproject


def test_a_centre_without_depth_takes_the_median_of_the_foreground():
    depth = torch.zeros(1, 28, 44)
    foreground = torch.zeros(1, 28, 44, dtype=torch.bool)
    depth[0, 0, :5] = torch.tensor([1.0, 2.0, 5.0, 9.0, 9.0])
    foreground[0, 0, :3] = True
    assert patch_depths(depth, foreground).tolist() == [[[2.0, 0.0]]]
    depth[0, 14, 30] = 7.0
    assert patch_depths(depth, foreground).tolist() == [[[2.0, 7.0]]]


def test_a_context_patch_lands_where_the_plate_is_seen():
    frames = encode(tiny(), context(0))
    for frame in frames:
        uv, counts = reproject(frame.points_world, frame.valid, camera("novel"))
        shift_px = (OFFSETS_M[frame.name] - OFFSETS_M["novel"]) * FOCAL_PX / DISTANCE_M
        expected = frame.uv_px + torch.tensor([shift_px, 0.0])
        assert counts.all() and frame.uv_px.shape[0] > 5
        assert torch.allclose(uv * torch.tensor([WIDTH, HEIGHT]), expected, atol=1e-3)


def test_points_behind_the_view_or_without_depth_do_not_count():
    points = torch.tensor([[0.0, 0, 2], [0, 0, -2], [5, 0, 2], [0, 0, 3]])
    uv, counts = reproject(points, torch.tensor([True, True, True, False]), camera("novel"))
    assert counts.tolist() == [True, False, True, False]
    assert uv[2, 0] > 1, "outside of the image is an honest distance"


def test_relative_depth_forgets_the_rig_and_the_scale(rng):
    depth = torch.rand(2, 9, 9, generator=rng) + 1
    depth[:, :3] = 0
    shown = relative_depth(depth)
    assert torch.allclose(shown, relative_depth(depth * 1000), atol=1e-5)
    assert not shown[:, :3].any() and abs(float(shown[0, 3:].median())) < 1e-6
    assert not relative_depth(torch.zeros(1, 4, 4)).any()


def carried(past_geometry, past_depth):
    """(u, v, s) and presence of a frame three steps back, whose proxy then stood at `past_depth` metres."""
    net = tiny(past_geometry=past_geometry)
    then = context(2)
    then = replace(then, depth=then.depth / DISTANCE_M * past_depth)
    past, now = encode(net, then)[0], encode(net, context(5))[0]
    none = torch.zeros(0, 64)
    target = Target(
        view=view(5),
        places=torch.zeros(0, 3, dtype=torch.long),
        tokens=none,
        shown=torch.zeros(6, HEIGHT, WIDTH),
        incomplete=torch.zeros(0, dtype=torch.bool),
    )
    batch = assemble([target], [[past, now]], [past.keys_values[:, :, :0]], net.config)
    n = len(past.tokens)
    return past, batch.context_at.uvs[0, :n], batch.context_at.present[0, :n]


def test_past_patches_are_carried_by_the_geometry_asked_for():
    focal = FOCAL_PX / WIDTH * (OFFSETS_M["left"] - OFFSETS_M["novel"])
    past, own, own_counts = carried("own", 4.0)
    past_u = past.uv_px[:, 0] / past.camera.size_px[0, 0]
    assert torch.allclose(own[:, 0], past_u + focal / 4.0, atol=1e-4) and own_counts.all()
    _, current, counts = carried("current", 4.0)
    assert torch.allclose(current[counts, 0], (past_u + focal / DISTANCE_M)[counts], atol=1e-4)
    assert counts.float().mean() > 0.7
    assert torch.allclose(own[:, 2], torch.tensor(3 / 8)), "s = (t - tau) / (k_w n_w)"


def test_a_patch_without_depth_is_dropped():
    past, _, counts = carried("own", 0.0)
    assert not past.valid.any() and not counts.any()


def test_the_views_own_complete_patches_join_the_context_where_they_are():
    net, incomplete = tiny(), view(5)
    with torch.no_grad():
        (target,) = patches(net)._encode_targets([incomplete], [incomplete.rgb])
    batch = assemble([target], [[]], [torch.zeros(4, 2, int((~target.incomplete).sum()), 64)], net.config)
    centres = (target.places[:, [2, 1]] * 16 + 14) / torch.tensor([WIDTH, HEIGHT])
    assert torch.allclose(batch.at.uvs[0, :, :2], centres[target.incomplete])
    assert torch.allclose(batch.context_at.uvs[0, :, :2], centres[~target.incomplete])
    assert not batch.context_at.uvs[..., 2].any() and batch.context_at.present.all()
    for place, is_input in zip(target.places.tolist(), target.incomplete.tolist(), strict=True):
        rows, cols = slice(place[1] * 16, place[1] * 16 + 28), slice(place[2] * 16, place[2] * 16 + 28)
        assert bool((incomplete.error[rows, cols] > 0).any()) == is_input
    assert set(NAMES) == set(incomplete.source_views)
