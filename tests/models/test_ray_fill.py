"""The ray fill: its inputs, and that it only fills holes, with colours of its candidates."""

from dataclasses import replace

import pytest
import torch
from models.plates import Rig, context, tiny_rays, view
from reference.rays_reference import neighbourhoods_reference

from viewmend.models.base import ContextProvider
from viewmend.models.compositing import blend
from viewmend.models.smooth_fill import fill
from viewmend.models.views import ray_fill
from viewmend.models.views.config import CONTRAST
from viewmend.models.views.pyramids import SceneScale, SourceCameras
from viewmend.models.views.ray_fill import (
    CELLS,
    CELLS_AROUND,
    PIXELS_STEP,
    RADIUS_PX,
    gather_ray_inputs,
    multi_scale_context,
    sample_behind_proxy,
)
from viewmend.models.views.sampler import CameraFeatures

SOURCES = SourceCameras.of(context(5), None)


def smooth(view):
    return fill(view.rgb, view.error > 0, view.mask > 0)


def test_neighbourhoods_equal_the_reference(rng):
    incomplete = view(5)
    ripples = 0.3 * torch.rand(incomplete.depth.shape, generator=rng)
    holed = (incomplete.depth + ripples) * (torch.rand(incomplete.depth.shape, generator=rng) > 0.1)
    incomplete, guess = replace(incomplete, depth=holed), torch.rand(incomplete.rgb.shape, generator=rng)
    corners = torch.tensor([[0, 0], [3, incomplete.rgb.shape[2] - 1]])
    pixels = torch.cat([torch.nonzero(incomplete.error > 0)[::60], corners])
    expected = neighbourhoods_reference(incomplete, guess, pixels, CELLS, CELLS_AROUND)
    found, index = multi_scale_context(incomplete, guess, pixels)
    assert torch.allclose(found[index].double(), torch.from_numpy(expected), atol=1e-4)
    again, where = multi_scale_context(incomplete, guess, pixels.repeat(2, 1))
    assert torch.equal(again, found) and torch.equal(where, index.repeat(2)), "pixels of one cell share it"


def test_exported_neighbourhoods_are_the_same_and_as_few(monkeypatch):
    incomplete = view(5)
    incomplete = replace(incomplete, mask=torch.ones_like(incomplete.mask))  # cells of several pixels
    guess = smooth(incomplete)
    corners = torch.tensor([[0, 0], [3, incomplete.rgb.shape[2] - 1]])
    pixels = torch.cat([torch.nonzero(incomplete.error > 0), corners])
    found, index = multi_scale_context(incomplete, guess, pixels)
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    exported, exported_index = multi_scale_context(incomplete, guess, pixels)
    assert torch.allclose(exported[exported_index], found[index], atol=1e-6)
    assert len(exported) == len(found) < 0.5 * len(pixels)


@torch.no_grad()
def test_known_pixels_stay_and_a_step_blends_the_rest():
    net, incomplete, missing = tiny_rays(), view(5), view(5).error > 0
    filled = net(incomplete, SourceCameras.of(context(5, ("left", "right", "third")), None))
    assert torch.equal(filled[:, ~missing], incomplete.rgb[:, ~missing])
    assert (
        float(filled.min()) >= 0 and float(filled.max()) <= 1 and not torch.equal(filled, smooth(incomplete))
    )
    candidates = replace(incomplete, candidate_views=("third", "left", "novel", "right"))
    rig = Rig()
    completed, _ = net.step(candidates, rig, net.initial_state())
    assert rig.asked[0] == (5, ("left", "right", "third")), "the source views, then the closest others"
    assert torch.equal(
        completed.rgb, blend(incomplete.rgb, incomplete.error, filled, torch.ones_like(incomplete.mask))
    )
    whole, rig = view(5, hole=None), Rig()
    assert net.step(whole, rig, net.initial_state())[0].rgb is whole.rgb and not rig.asked


@torch.no_grad()
def test_depth_in_holes_is_optional():
    """It is taken from the surroundings; without any depth the smooth fill decides."""
    net, incomplete = tiny_rays(), view(5)
    holed = replace(incomplete, depth=incomplete.depth * (incomplete.error == 0))
    flat = replace(incomplete, depth=torch.zeros_like(incomplete.depth))
    maskless = replace(incomplete, mask=0 * incomplete.mask, depth=2.0 * (incomplete.depth > 0))
    assert torch.allclose(net(incomplete, SOURCES), net(holed, SOURCES), atol=1e-3), "the plate is flat"
    assert torch.equal(net(flat, SOURCES), smooth(incomplete))
    for odd in (flat, maskless):
        assert net.step(odd, Rig(), net.initial_state())[0].rgb.isfinite().all()
    blind = net.step(incomplete, ContextProvider(lambda *_: None), net.initial_state())[0]
    assert torch.allclose(
        blind.rgb, net(incomplete, None) * incomplete.error + (1 - incomplete.error) * incomplete.rgb
    )


def test_a_pixel_without_depth_takes_it_from_its_surroundings():
    incomplete = view(5)
    scale = SceneScale.of(incomplete)
    pixels = torch.nonzero(incomplete.error > 0)
    holed = replace(incomplete, depth=incomplete.depth * (incomplete.error == 0))
    expected = sample_behind_proxy(incomplete, pixels, SOURCES, scale=scale)
    found = sample_behind_proxy(holed, pixels, SOURCES, scale=scale)
    assert torch.allclose(found.features, expected.features, atol=0.02), "the plate is flat"


@torch.no_grad()
def test_chunks_of_pixels_give_the_same_in_few_sizes(monkeypatch):
    """Layers are compiled and kept for each size: many sizes would fragment the memory of a server."""
    net, incomplete, sizes = tiny_rays(), view(5), set()
    whole = net(incomplete, SOURCES)
    monkeypatch.setattr(ray_fill, "PIXELS_AT_ONCE", 7)
    assert torch.allclose(whole, net(incomplete, SOURCES), atol=1e-6)
    for layer in net.modules():
        if not list(layer.children()):
            layer.register_forward_hook(lambda _, given, __: sizes.add(len(given[0])))
    missing = torch.nonzero(incomplete.error > 0)
    for pixels in (1, 7, 65, len(missing)):
        net.mix(gather_ray_inputs(incomplete, SOURCES, missing[:pixels]))
    assert len(missing) > 65 and sizes and all(size % PIXELS_STEP == 0 for size in sizes)


@torch.no_grad()
def test_cameras_are_compared_as_by_one_layer_on_all_inputs():
    net, incomplete = tiny_rays(), view(5)
    sources = SourceCameras.of(context(5, ("left", "third", "right")), None)
    inputs = gather_ray_inputs(incomplete, sources, torch.nonzero(incomplete.error > 0)[:40])
    expected_colours, expected = points_reference(net, inputs.features, inputs.smallest_masks)
    colours, features = net._points(inputs.features, inputs.smallest_masks)
    torch.testing.assert_close(colours, expected_colours, atol=1e-5, rtol=0)
    torch.testing.assert_close(features, expected, atol=1e-4, rtol=0)


def points_reference(net, features, smallest_masks):
    """`RayFill._points` with every input repeated for every camera."""
    at = CameraFeatures.unstack(features)
    colours = torch.cat([at.colour, at.mean_colour, at.mean_coverage], -1)
    prior = at.in_view * (4 * at.viewing_cosine).exp() * (-4 * at.depth_difference).sigmoid()
    prior = prior / (prior.sum(2, keepdim=True) + 1e-6)
    mean = (prior * colours).sum(2, keepdim=True)
    variance = CONTRAST * (prior * (colours - mean) ** 2).sum(2, keepdim=True)
    own = torch.cat([*at[:7], at.mean_mask, at.mean_colour, at.mean_coverage], -1)
    looked = net.look(own)
    together = looked + (prior * looked).sum(2, keepdim=True)
    smallest = smallest_masks[:, :, None, ::2].expand(*prior.shape[:-1], -1)
    repeated = [own, mean.expand_as(colours), variance.expand_as(colours), together, smallest, prior]
    compared = net.compare(torch.cat(repeated, -1))
    scores = net.trust(compared) + (prior + 1e-4).log()
    trust = at.in_view * scores.masked_fill(at.in_view == 0, -1e4).softmax(2)
    agreed = (trust * colours).sum(2)
    spread = CONTRAST * (trust * (colours - agreed[:, :, None]) ** 2).sum(2)
    point = [(trust * compared).sum(2), agreed, spread, smallest_masks, (trust**2).sum(2)]
    return agreed[..., :3], net.point(torch.cat(point, -1))


@torch.no_grad()
def test_a_point_that_no_camera_sees_is_no_candidate():
    """Whatever its weight: such a point has no colour, and would be black."""
    net, incomplete = tiny_rays(), view(5)
    inputs = gather_ray_inputs(incomplete, SOURCES, torch.nonzero(incomplete.error > 0))
    net.choose.weight.zero_()
    net.choose.bias.zero_()
    net.choose.bias[:-2], net.choose.bias[-2] = 100, 50  # points, then the smooth fill, then black
    guess = inputs.window[:, -3:, RADIUS_PX, RADIUS_PX]
    assert float(guess.mean()) > 0.1
    assert torch.allclose(net.mix(inputs._replace(features=0 * inputs.features)), guess, atol=1e-3)
    assert not torch.allclose(net.mix(inputs), guess, atol=1e-2)


@pytest.mark.parametrize("views", [0, 2])
def test_inputs_of_several_views_are_padded_to_the_same_cameras(views):
    pixels = torch.nonzero(view(5).error > 0)[:3]
    one = gather_ray_inputs(view(5), SOURCES if views else None, pixels)
    three = gather_ray_inputs(view(5), SourceCameras.of(context(5, ("left", "third", "right")), None), pixels)
    both = ray_fill.RayInputs.cat([one, three])
    assert both.features.shape[2] == 3 and not bool(both.features[:3, :, views:].any())
    last = both.neighbourhoods[both.neighbourhood_index[3:]]
    assert torch.equal(last, three.neighbourhoods[three.neighbourhood_index])
