"""From masks to a proxy that gives depth."""

from dataclasses import replace

import pytest
import torch
from geometry.solids import around, ball_masks, camera_at, dome, is_closed, silhouette_iou, volume

from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import reconstruct

CONFIG = HullConfig(resolution=48)


def test_a_ball_comes_back():
    cameras = dome(12, width=160, height=140)
    masks = ball_masks(cameras)
    proxy = reconstruct(masks, cameras, around(0.8), CONFIG)
    assert volume(proxy.mesh) == pytest.approx(4 / 3 * torch.pi * 0.5**3, rel=0.12)
    assert proxy.mesh.vertices.norm(dim=1).min() > 0.5 - 0.02
    held = camera_at((1.0, 1.2, 2.0), width=160, height=140)
    depth = proxy.depth(held)
    assert silhouette_iou(depth[0], ball_masks(held)[0]) > 0.96
    assert float(depth[0, 70, 80]) == pytest.approx((1 + 1.44 + 4) ** 0.5 - 0.5, abs=0.06)
    assert torch.allclose(proxy.normals.norm(dim=1), torch.ones(len(proxy.normals)), atol=1e-4)


@pytest.mark.parametrize("bounds", [around(4.0), around(4.0, (2.0, 1.0, -2.0)), None])
def test_large_bounds_cost_no_detail(bounds):
    cameras = dome(8)
    masks = ball_masks(cameras)
    tight, loose = (
        reconstruct(masks, cameras, around(0.6), CONFIG),
        reconstruct(masks, cameras, bounds, CONFIG),
    )
    assert float(loose.bounds.size_m.max()) < 1.35 * float(tight.bounds.size_m.max())
    assert volume(loose.mesh) == pytest.approx(volume(tight.mesh), rel=0.03)


def test_faint_space_apart_from_the_subject_costs_no_detail():
    """Values below one half in all masks at another place, as phantoms leave them."""
    cameras = dome(8, fov=1.2)
    masks = ball_masks(cameras, radius=0.3)
    expected = reconstruct(masks, cameras, around(1.0), CONFIG)
    faint = ball_masks(cameras, center=(0.0, 0.8, 0.0), radius=0.12) // 255 * 100
    found = reconstruct(masks.maximum(faint), cameras, around(1.0), CONFIG)
    assert float(found.bounds.size_m.max()) <= float(expected.bounds.size_m.max())
    assert volume(found.mesh) == pytest.approx(volume(expected.mesh), rel=0.02)
    nothing_else = reconstruct(faint, cameras, around(1.0), CONFIG)
    assert len(nothing_else.mesh.vertices) == 0 and float(nothing_else.bounds.low[1]) > 0.5


def test_masks_that_contradict_give_an_empty_proxy():
    """Rendering must survive a moment at which nothing is left."""
    cameras = dome(4)
    masks = ball_masks(cameras, radius=0.3)
    masks[2] = 0
    masks[2, :3, :3] = 255
    proxy = reconstruct(masks, cameras, around(0.8), CONFIG)
    assert len(proxy.mesh.faces) == len(proxy.normals) == 0
    assert not proxy.depth(cameras).any()
    assert len(reconstruct(masks, cameras, around(0.8), replace(CONFIG, coarse_passes=0)).mesh.faces) == 0


def test_a_cropped_subject_is_closed_where_the_cameras_end():
    """Cameras that all look at the upper half leave a body that is capped below."""
    cameras = dome(8, target=(0.0, 0.5, 0.0), fov=0.35)
    masks = ball_masks(cameras)
    assert masks[:, -1].any()
    mesh = reconstruct(masks, cameras, None, CONFIG).mesh
    assert is_closed(mesh) and volume(mesh) > 0.1


def test_moving_to_a_device_keeps_everything():
    cameras = dome(4)
    moved = reconstruct(ball_masks(cameras), cameras, around(0.6), CONFIG).to("meta")
    assert (
        moved.mesh.vertices.device.type == moved.normals.device.type == moved.bounds.low.device.type == "meta"
    )


def test_real_captures_overlap_their_masks(shared):
    """Held-out silhouettes of a person, in decimetres, upside down: the default settings."""
    from viewmend.data.capture_folder import CaptureFolder

    frame = CaptureFolder(shared / "captures" / "wd2").read(0)
    assert frame.mask is not None
    held = frame.cameras.names[8]
    others = frame.without([held])
    assert others.mask is not None
    proxy = reconstruct(others.mask, others.cameras)
    assert silhouette_iou(proxy.depth(frame.cameras.select([held]))[0], frame.mask[8]) > 0.94
