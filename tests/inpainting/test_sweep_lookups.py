"""Places along rays are looked up as slow twins do, and cameras are trusted at them."""

import pytest
import torch

from viewmend.inpainting.ray_sampling import sample_along_rays, subject_size_m
from viewmend.inpainting.sweep import _lookup_torch, lookup
from viewmend.inpainting.sweep._lookup_numba import look_up_numba
from viewmend.inpainting.sweep.cells import nearest_depth, rim_depth
from viewmend.inpainting.sweep.config import OFFSETS
from viewmend.inpainting.sweep.lookup import Rays, Scale, look_up
from viewmend.inpainting.sweep.place_net import PlaceNet
from viewmend.inpainting.sweep.pyramids import halved, silhouette_pyramids
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.views import Silhouettes


def rays_of(view):
    pixels = torch.nonzero(view.mask > 0)
    z = view.depth[tuple(pixels.T)][:, None] + float(subject_size_m(view)) * torch.tensor(OFFSETS)
    return pixels, Rays(view.camera, pixels.flip(1).double() + 0.5, z)


def test_lookups_are_what_a_ray_reader_sees_at_the_finest_scale(scene, monkeypatch):
    """At full resolution colours, masks, angles and silhouettes are those of `sample_along_rays`."""
    _, view, rig = scene
    monkeypatch.setattr(lookup, "_eyes", finest(lookup._eyes))
    pixels, rays = rays_of(view)
    found = look_up(rays, rig, view.source_views, 1.0, Scale.of(view)).features
    wanted = sample_along_rays(view, pixels, rig.views, OFFSETS)
    assert len(pixels) > 500
    seen = wanted.features
    close = {"atol": 0.011, "rtol": 0}  # products with the mask are rounded to bytes
    torch.testing.assert_close(found[..., :3], seen.colour, **close)
    torch.testing.assert_close(found[..., 3:4], seen.mask, atol=1e-4, rtol=0)
    torch.testing.assert_close(found[..., 6:7], seen.viewing_cosine, atol=1e-4, rtol=0)
    torch.testing.assert_close(found[..., 7:8], seen.is_source, atol=0, rtol=0)
    torch.testing.assert_close(found[..., 8:9], seen.in_view, atol=0, rtol=0)
    least = look_up(rays, rig, view.source_views, 1.0, Scale.of(view)).stats[..., 6:8]
    torch.testing.assert_close(least, torch.cat(wanted.consistency[:2], -1), atol=1e-4, rtol=0)


def finest(eyes):
    def made(cameras, pyramids, step_m, middle):
        found = eyes(cameras, pyramids, step_m, middle)
        return found._replace(fine=tuple(lookup.Level(p.levels[0], 1.0) for p in pyramids))

    return made


def test_lookups_are_as_exact_where_layers_compute_in_bfloat16(scene):
    _, view, rig = scene
    _, rays = rays_of(view)
    found = look_up(rays, rig, view.source_views, 2.0, Scale.of(view))
    with torch.autocast("cpu", torch.bfloat16):
        again = look_up(rays, rig, view.source_views, 2.0, Scale.of(view))
    assert all(torch.equal(one, other) for one, other in zip(found, again, strict=True))


@pytest.mark.parametrize("step_px", [1.0, 5.0])
def test_both_kernels_find_the_same(scene, step_px, monkeypatch):
    _, view, rig = scene
    _, rays = rays_of(view)
    rays = rays._replace(z_m=torch.where(torch.rand(rays.z_m.shape) < 0.1, 0.0, rays.z_m))
    fast = look_up(rays, rig, view.source_views, step_px, Scale.of(view))
    used = []

    def slow_kernel(*told):
        used.append(told)
        return _lookup_torch.look_up_torch(*told)

    monkeypatch.setattr("viewmend.inpainting.sweep._lookup_numba.look_up_numba", slow_kernel)
    slow = look_up(rays, rig, view.source_views, step_px, Scale.of(view))
    assert used and look_up_numba is not slow_kernel
    scales = {level.scale for level in (*used[0][1].fine, *used[0][1].wide)}
    assert max(scales) == {1.0: 1.0, 5.0: 0.25}[step_px], "levels follow the rays"
    for name, one, other in zip(fast._fields, fast, slow, strict=True):
        off = (one - other).abs()
        flips = (off > 1e-3).float().mean()  # the proxy's nearest pixel, where a position is between two
        assert float(flips) < 2e-3, name
        assert float(off.median()) < 1e-6, name
    assert float(fast.prior.sum(2).max()) <= 1 + 1e-5 and float(fast.stats[..., 3:6].max()) > 0.1


def test_levels_are_means_and_black_around():
    image = torch.zeros(7, 9, 1, dtype=torch.uint8)
    image[1:-1, 1:-1, 0] = torch.randint(0, 256, (5, 7), dtype=torch.uint8)
    half = halved(image)
    assert half.shape == (5, 6, 1) and int(half[0].sum() + half[-1].sum() + half[:, 0].sum() + half[:, -1].sum()) == 0
    inner = image[..., 0].int()
    assert int(half[1, 1, 0]) == (int(inner[1:3, 1:3].sum()) + 2) // 4
    assert int(half[3, 4, 0]) == (int(inner[5, 7]) + 2) // 4, "an odd side is made up for by black"


def test_the_subjects_size_is_measured_at_a_coarse_level():
    mask = torch.zeros(1, 64, 64, dtype=torch.uint8)
    mask[0, 8:40, 16:48] = 255
    cameras = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).cameras.select(["cam00"])
    (pyramid,) = silhouette_pyramids(Silhouettes(mask, cameras))
    assert pyramid.subject_px == pytest.approx(32)
    assert [pyramid.level(px) for px in (0.3, 1.0, 1.5, 4.0, 1e9)] == [0, 0, 1, 2, len(pyramid.levels) - 1]


def test_trust_adds_up_and_blind_cameras_get_none(scene):
    _, view, rig = scene
    _, rays = rays_of(view)
    torch.manual_seed(0)
    places = look_up(rays, rig, view.source_views, 1.0, Scale.of(view))
    places.features[..., 1, :] = 0
    with torch.no_grad():
        weighed = PlaceNet(8, 4)(places)
    total, anyone = weighed.trust.sum(2), places.features[..., 8].sum(2) > 0
    torch.testing.assert_close(total, anyone.float())
    assert float(weighed.trust[..., 1].abs().max()) == 0
    mean = (weighed.trust[..., None] * places.features).sum(2)
    torch.testing.assert_close(weighed.colour, mean[..., :3])
    torch.testing.assert_close(weighed.mask, mean[..., 3:4])


def test_cells_have_the_nearest_depth():
    depth = torch.tensor([[0.0, 3.0, 0.0], [2.0, 5.0, 0.0], [0.0, 0.0, 4.0]])
    assert nearest_depth(depth).tolist() == [[2.0, 0.0], [0.0, 4.0]]


def test_the_rim_is_as_far_as_what_is_nearest_to_the_viewer_there():
    depth = torch.zeros(9, 12)
    depth[4, 4], depth[4, 5] = 3.0, 2.0
    rim = rim_depth(depth)
    assert rim[4, 4] == 3 and rim[4, 5] == 2, "what has a depth keeps it"
    assert rim[2, 2] == 3 and rim[6, 7] == 2 and rim[4, 3] == 2, "two pixels about the proxy"
    assert int((rim > 0).sum()) == 5 * 6
