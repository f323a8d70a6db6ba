"""What is read along rays, and the fill that is made of it."""

from dataclasses import replace

import pytest
import torch
from inpainting.plates import Rig, camera, context, look, tiny, view
from reference.rays_twin import far_twin, rays_twin

from viewmend.geometry.cameras import Cameras
from viewmend.inpainting._ray_sampling_numba import sample_numba
from viewmend.inpainting._ray_sampling_torch import sample_torch
from viewmend.inpainting.coarse_fill import fill
from viewmend.inpainting.decoder import blend
from viewmend.inpainting.ray_blend_net import PIXELS_STEP, RADIUS_PX, look_around
from viewmend.inpainting.ray_sampling import (
    CELLS,
    CELLS_AROUND,
    FAR,
    NEAR,
    OFFSETS,
    OUTLINE,
    PATCH,
    RayFeatures,
    multi_scale_context,
    sample_along_rays,
    windows,
)
from viewmend.views import Silhouettes


def turned(cameras: Cameras, angle: float) -> Cameras:
    """The cameras turned about their own vertical axis, so that their z-depths differ."""
    turn = torch.eye(4)
    c, s = torch.tensor(angle).cos(), torch.tensor(angle).sin()
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = c, s, -s, c
    return replace(cameras, camera_from_world=turn @ cameras.camera_from_world)


@pytest.mark.parametrize("implementation", [sample_numba, sample_torch])
def test_following_equals_its_twin(rng, implementation, monkeypatch):
    monkeypatch.setattr("viewmend.inpainting._ray_sampling_numba.sample_numba", implementation)
    incomplete = view(5)
    ray_views = context(5, ("left", "third", "right"))
    depth = ray_views.depth + 0.2 * torch.rand(ray_views.depth.shape, generator=rng) * (ray_views.depth > 0)
    own = (torch.rand(depth.shape, generator=rng) * 256).byte()  # not what the proxy covers
    frame = replace(ray_views.frame, cameras=turned(ray_views.frame.cameras, 0.55), mask=own)
    ray_views = replace(ray_views, frame=frame, depth=depth)
    rig = context(5, ("left", "third", "right", "novel")).frame
    masks = (torch.rand(rig.rgb[:, 0].shape, generator=rng) * 64).byte()
    incomplete = replace(incomplete, silhouettes=Silhouettes(masks, turned(rig.cameras, 0.55)))
    pixels = torch.nonzero(incomplete.error > 0)
    pixels = pixels[torch.randperm(len(pixels), generator=rng)[:25]]
    samples = sample_along_rays(incomplete, pixels, ray_views)
    features, occupancy = rays_twin(incomplete, pixels, ray_views, OFFSETS, NEAR, FAR, OUTLINE, PATCH)
    assert 0 < samples.features.in_view.mean() < 1, "some points are out of view"
    assert torch.allclose(samples.features.stack().double(), torch.from_numpy(features), atol=2e-3)
    assert torch.allclose(samples.consistency.stack().double(), torch.from_numpy(occupancy), atol=2e-3)
    assert 0.05 < (samples.consistency.second < 0.5).float().mean() < 0.95
    again = RayFeatures.unstack(samples.features.stack())
    assert all(torch.equal(a, b) for a, b in zip(again, samples.features, strict=True))
    alone = samples.features.stack()[:, OFFSETS.index(0.09)]
    one = sample_along_rays(incomplete, pixels, ray_views, offsets=(0.09,)).features
    assert torch.allclose(one.stack()[:, 0], alone, atol=1e-6)


def test_farther_surroundings_equal_their_twin(rng):
    incomplete = view(5)
    ripples = 0.3 * torch.rand(incomplete.depth.shape, generator=rng)
    holed = (incomplete.depth + ripples) * (torch.rand(incomplete.depth.shape, generator=rng) > 0.1)
    incomplete = replace(incomplete, depth=holed)
    guess = torch.rand(incomplete.rgb.shape, generator=rng)
    pixels = torch.cat(
        [torch.nonzero(incomplete.error > 0)[::60], torch.tensor([[0, 0], [3, incomplete.rgb.shape[2] - 1]])]
    )
    expected = far_twin(incomplete, guess, pixels, CELLS, CELLS_AROUND)
    far, place = multi_scale_context(incomplete, guess, pixels)
    assert torch.allclose(far[place].double(), torch.from_numpy(expected), atol=1e-4)
    again, where = multi_scale_context(incomplete, guess, pixels.repeat(2, 1))
    assert torch.equal(again, far) and torch.equal(where, place.repeat(2)), "same cells are there once"


def test_without_silhouettes_the_nearby_masks_count():
    incomplete, ray_views = view(5), context(5)
    assert ray_views.frame.mask is not None
    pixels = torch.nonzero(incomplete.error > 0)[::20]
    told = replace(incomplete, silhouettes=Silhouettes(ray_views.frame.mask, ray_views.frame.cameras))
    without, with_them = (sample_along_rays(v, pixels, ray_views).consistency.stack() for v in (incomplete, told))
    assert torch.equal(without, with_them)


def test_cameras_agree_on_the_colour_of_a_point_on_the_surface():
    incomplete = view(5)
    pixels = torch.tensor([[30, 40], [25, 33]])
    on_surface = sample_along_rays(incomplete, pixels, context(5), offsets=(0.0,)).features
    truth = look(camera("novel"), 5)[0][:, pixels[:, 0], pixels[:, 1]].T[:, None, None]
    assert torch.allclose(on_surface.colour, truth.expand_as(on_surface.colour), atol=0.05)
    for behind in (on_surface.depth_difference, on_surface.coarse_depth_difference):
        assert torch.allclose(behind, torch.zeros_like(behind), atol=1e-4), "at the proxy, not behind it"


@pytest.mark.parametrize("unit", [1.0, 0.001, 10.0])
def test_the_unit_of_length_does_not_matter(unit):
    incomplete, ray_views = view(5), context(5)
    pixels = torch.nonzero(incomplete.error > 0)[::40]

    def scaled(cameras):
        pose = cameras.camera_from_world.clone()
        pose[:, :3, 3] *= unit
        return replace(cameras, camera_from_world=pose)

    other = replace(incomplete, camera=scaled(incomplete.camera), depth=incomplete.depth * unit)
    frame = replace(ray_views.frame, cameras=scaled(ray_views.frame.cameras))
    seen = sample_along_rays(other, pixels, replace(ray_views, frame=frame, depth=ray_views.depth * unit))
    before = sample_along_rays(incomplete, pixels, ray_views)
    assert torch.allclose(seen.features.stack(), before.features.stack(), atol=1e-3)


def test_windows_are_what_lies_around():
    image = torch.arange(2 * 5 * 6.0).reshape(2, 5, 6)
    corner, middle = windows(image, torch.tensor([[0, 0], [2, 3]]), 1)
    assert torch.equal(middle, image[:, 1:4, 2:5])
    assert torch.equal(corner[:, 1:, 1:], image[:, :2, :2]) and not corner[:, 0].any() and not corner[:, :, 0].any()


def test_the_fill_keeps_what_is_known_and_stays_within_its_candidates():
    reader, incomplete = tiny().coarse, view(5)
    with torch.no_grad():
        (filled,) = reader([incomplete], [context(5)])
    missing = incomplete.error > 0
    assert torch.equal(filled[:, ~missing], incomplete.rgb[:, ~missing])
    assert float(filled.min()) >= 0 and float(filled.max()) <= 1
    assert not torch.equal(filled, fill(incomplete.rgb, missing, incomplete.mask > 0))


def test_only_the_asked_pixels_are_read():
    reader, incomplete = tiny().coarse, view(5)
    missing = torch.nonzero(incomplete.error > 0)
    guess = fill(incomplete.rgb, incomplete.error > 0, incomplete.mask > 0)
    with torch.no_grad():
        (everywhere,) = reader([incomplete], [context(5)])
        (some,) = reader([incomplete], [context(5)], [missing[:7]])
    read, left = (tuple(pixels.unbind(1)) for pixels in (missing[:7], missing[7:]))
    assert torch.allclose(some[:, *read], everywhere[:, *read], atol=1e-6)
    assert torch.equal(some[:, *left], guess[:, *left])


def test_a_renderer_without_depth_in_holes_is_served_too():
    """Its depth is taken from around; without any depth the surroundings decide."""
    net, incomplete = tiny(), view(5)
    holed = replace(incomplete, depth=incomplete.depth * (incomplete.error == 0))
    flat = replace(incomplete, depth=torch.zeros_like(incomplete.depth))
    with torch.no_grad():
        full, from_around = net.coarse([incomplete, holed], [context(5), context(5)])
        (without,) = net.coarse([flat], [context(5)])
    assert torch.allclose(full, from_around, atol=1e-3), "the plate is flat"
    assert torch.equal(without, fill(incomplete.rgb, incomplete.error > 0, incomplete.mask > 0))
    maskless = replace(incomplete, mask=0 * incomplete.mask, depth=2.0 * (incomplete.depth > 0))
    for odd in (flat, maskless):
        completed, _ = net.step(odd, Rig(), net.initial_state())
        assert completed.rgb.isfinite().all() and net.coarse([odd], [context(5)])[0].isfinite().all()


def test_a_step_reads_the_chosen_cameras_and_then_the_nearest():
    net, rig = tiny(num_ray_views=3), Rig()
    net.step(replace(view(0), candidate_views=("third", "left", "novel", "right")), rig, net.initial_state())
    assert rig.asked[0] == (0, ("left", "right", "third"))


def test_many_pixels_at_once_equal_few(monkeypatch):
    net, incomplete = tiny(), view(5)
    with torch.no_grad():
        whole = net.coarse([incomplete], [context(5)])[0]
        monkeypatch.setattr("viewmend.inpainting.ray_blend_net.PIXELS_AT_ONCE", 7)
        parts = net.coarse([incomplete], [context(5)])[0]
    assert torch.allclose(whole, parts, atol=1e-6)


def test_layers_see_few_sizes():
    """Each size that they meet is compiled and kept: a server would be slow, and its heap full of holes."""
    reader, incomplete, met = tiny().coarse, view(5), set()
    for layer in reader.modules():
        if not list(layer.children()):
            layer.register_forward_hook(lambda _, given, __: met.add(len(given[0])))
    missing = torch.nonzero(incomplete.error > 0)
    with torch.no_grad():
        for pixels in (1, 7, 65, len(missing)):
            reader([incomplete], [context(5)], [missing[:pixels]])
    assert len(missing) > 65 and met and all(size % PIXELS_STEP == 0 for size in met)


def test_the_reader_alone_completes_a_view():
    net, incomplete = tiny().coarse, view(5)
    completed, _ = net.step(incomplete, Rig(), net.initial_state())
    with torch.no_grad():
        (filled,) = net([incomplete], [context(5)])
    expected = blend(incomplete.rgb, incomplete.error, filled, torch.ones_like(incomplete.mask))
    assert torch.equal(completed.rgb, expected)
    whole, rig = view(5, hole=None), Rig()
    assert net.step(whole, rig, net.initial_state())[0].rgb is whole.rgb and not rig.asked


def test_a_point_that_no_camera_sees_is_no_candidate():
    """However much the network wants it: such a point has no colour, and would be black."""
    reader, incomplete = tiny().coarse, view(5)
    missing = torch.nonzero(incomplete.error > 0)
    told = look_around(incomplete, context(5), missing)
    blind = told._replace(features=torch.zeros_like(told.features))
    last = [layer for layer in reader.choose.modules() if isinstance(layer, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.zero_()
        last.bias[:-2], last.bias[-2] = 100, 50  # points, then what the surroundings suggest, then black
        guess = told.window[:, -3:, RADIUS_PX, RADIUS_PX]
        assert float(guess.mean()) > 0.1
        assert torch.allclose(reader.mix(blind), guess, atol=1e-3)
        assert not torch.allclose(reader.mix(told), guess, atol=1e-2)
