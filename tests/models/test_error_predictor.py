"""Predicted errors, and which part of a view the default model re-synthesises because of them."""

from dataclasses import replace

import pytest
import torch

from viewmend.geometry.rim import rim_depth
from viewmend.models.base import ContextProvider, ErrorMap, RenderQuality, State
from viewmend.models.checkpoint import load_network
from viewmend.models.smooth_fill import fill
from viewmend.models.views import error_predictor
from viewmend.models.views.model import ViewSynthNet
from viewmend.rendering.crop import Crop
from viewmend.rendering.error_mask import attenuate_background, select_by_gain
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig


@pytest.fixture(scope="module")
def net(small_views):
    torch.manual_seed(4)
    return ViewSynthNet(replace(small_views, error_features=8))


def stream_of(inpainter, scene, **render):
    """A stream of this inpainter with the scene's frame."""
    cached = scene[0].cached_frame()
    stream = Stream(inpainter, StreamConfig(render=RenderConfig(**render)))
    stream.add_frame(cached.frame, cached.proxy)
    return stream


@torch.no_grad()
def test_errors_are_predicted_on_the_proxy_and_its_rim(scene, net):
    _, view, sources = scene
    found, there = net.errors(view, sources), rim_depth(view.depth) > 0
    for image in found:
        assert image.shape == view.mask.shape and not bool(image[~there].any())
        assert float(image[there].min()) > 0 and float(image.max()) < 1 and float(image[there].std()) > 1e-3
    assert not torch.equal(net.errors(replace(view, rgb=0 * view.rgb), sources).wrong, found.wrong)
    assert torch.equal(net.errors(replace(view, error=0 * view.error), sources).wrong, found.wrong), (
        "E is not an input"
    )


@torch.no_grad()
def test_a_large_subject_is_judged_at_half_the_resolution_if_nothing_is_predicted(scene, monkeypatch):
    _, view, sources = scene
    errors, there = load_network("views").errors, rim_depth(view.depth) > 0
    whole, nothing = errors(view, sources), RenderQuality(refine_fraction=0.0)
    assert torch.equal(errors.predict(view, sources, nothing).alpha, whole.alpha), "it is small"
    monkeypatch.setattr(error_predictor, "LARGE_PX", 8)
    assert torch.equal(errors.predict(view, sources, RenderQuality(refine_fraction=0.1)).alpha, whole.alpha)
    half = errors.predict(view, sources, nothing)
    for one, other in zip(half, whole, strict=True):
        assert not torch.equal(one, other) and not bool(one[~there].any()) and float(one[there].min()) > 0
    assert float(torch.stack([half.alpha[there], whole.alpha[there]]).corrcoef()[0, 1]) > 0.8


def test_holes_and_the_highest_gains_are_selected(scene):
    _, view, _ = scene
    gain = torch.rand(view.mask.shape, generator=torch.Generator().manual_seed(0)) * (
        rim_depth(view.depth) > 0
    )
    hull, holes = int((view.mask > 0).sum()), view.holes
    error = select_by_gain(view, gain, 0.3)
    chosen = error > 0
    assert int(holes.sum()) < 0.3 * hull and int(chosen.sum()) == int(0.3 * hull)
    assert bool(chosen[holes].all()) and float(gain[chosen & ~holes].min()) >= float(gain[~chosen].max())
    assert set(error.unique().tolist()) == {0.0, 1.0}
    assert torch.equal(select_by_gain(view, gain, 1e-6) > 0, holes), "though these are more"
    assert torch.equal(select_by_gain(view, 1e-5 * gain, 0.3) > 0, holes), (
        "pixels that hardly change are left"
    )


def test_background_is_attenuated_and_not_predicted(scene):
    """E is 1 where a view is predicted, and elsewhere the background fraction of the colour."""
    stream, view, _ = scene
    rng = torch.Generator().manual_seed(0)
    rest, alpha = (torch.rand(view.mask.shape, generator=rng) for _ in range(2))
    rest, alpha = rest * (rim_depth(view.depth) > 0), torch.where(alpha < 0.3, 1.0, alpha)
    part, hull = attenuate_background(view, ErrorMap(rest, rest, alpha, rest), 0.3), view.mask > 0
    chosen = part.refine_mask
    assert torch.equal(chosen, select_by_gain(view, rest, 0.3) > 0) and bool((part.error[chosen] == 1).all())
    left = hull & ~chosen
    assert torch.equal(part.error[left], torch.where(alpha < 0.98, 1 - alpha, 0.0)[left])
    assert not bool(part.error[~hull & ~part.refine_mask].any())
    completed = stream.mend(part).completed
    assert torch.equal(completed.rgb[:, left & (alpha == 1)], view.rgb[:, left & (alpha == 1)])
    torch.testing.assert_close(completed.rgb[:, left], ((1 - part.error) * view.rgb)[:, left])
    torch.testing.assert_close(completed.alpha[left], 1 - part.error[left])
    alone = stream.mend(replace(view, error=part.refine_mask.float())).completed
    assert torch.equal(completed.rgb[:, part.refine_mask], alone.rgb[:, part.refine_mask])
    assert float((completed.rgb - view.rgb)[:, part.refine_mask].abs().mean()) > 0.01
    faded = replace(view, error=part.fade, fade=part.fade)
    dark, _ = stream.inpainter.step(faded, ContextProvider(lambda *_: None), State())
    torch.testing.assert_close(dark.rgb, (1 - part.fade) * view.rgb)
    assert dark.alpha is not None and torch.equal(dark.alpha, (1 - part.fade) * view.mask)
    half = attenuate_background(
        replace(view, error=0.5 * view.error), ErrorMap(rest, rest, 0 * alpha, rest), 0.3
    )
    assert float(half.error.max()) == 0.5, "never more than E"
    crop = Crop(16, 16, 80, 83)
    around = crop.uncropped(crop.of_view(part), view.camera)
    assert torch.equal(around.fade[16:, 16:80], part.fade[16:, 16:80]) and not bool(around.fade[:16].any())


def test_the_rule_predicted_uses_the_inpainters_own_prediction(scene, net, small_views):
    _, view, _ = scene
    own = stream_of(net, scene, error_rule="predicted", refine_fraction=0.5)
    chosen, hull = own.render(view.camera).refine_mask, int((view.mask > 0).sum())
    assert bool(chosen[view.holes].all()) and not bool(chosen[view.error == 0].any())
    assert int(view.holes.sum()) < int(chosen.sum()) <= int(0.5 * hull)
    completed = own.view(view.camera).completed
    same = completed.view.error == 0
    assert torch.equal(completed.rgb[:, same], view.rgb[:, same])
    with pytest.raises(ValueError, match="a model that predicts errors"):
        stream_of(ViewSynthNet(small_views), scene, error_rule="predicted").render(view.camera)


def test_a_quality_limits_the_predicted_part(scene, net):
    _, view, _ = scene
    hull, holes = int((view.mask > 0).sum()), int(view.holes.sum())

    def completed(rule, fraction, **more):
        own = stream_of(net, scene, error_rule=rule, refine_fraction=0.5)
        quality = RenderQuality(refine_fraction=fraction, **more)
        return [
            one.completed.view
            for one in (own.view(view.camera, quality=quality), own.mend(view, quality=quality))
        ]

    for rule, allowed, most in [("all", 0.4, 0.4), ("predicted", 0.4, 0.4), ("predicted", 0.9, 0.5)]:
        rendered, given = (int(one.refine_mask.sum()) for one in completed(rule, allowed))
        assert holes < rendered <= most * hull < 1.1 * rendered
        assert given <= allowed * hull < 1.1 * given, "E of other renderers is restricted, too"
    assert int((completed("holes", 0.4)[0].error > 0).sum()) == holes
    assert torch.equal(completed("all", 0.4, mend=False)[0].error, view.error)


def test_if_nothing_is_predicted_holes_are_filled_from_their_surroundings(scene, net, monkeypatch):
    _, view, _ = scene
    own = stream_of(net, scene)
    monkeypatch.setattr(net, "forward", lambda *given, **more: pytest.fail("nothing is to be predicted"))
    completed = own.view(view.camera, quality=RenderQuality(refine_fraction=0.0)).completed
    part, filled, rest = completed.view, fill(view.rgb, view.holes, view.mask > 0), ~view.holes
    assert part.fade is not None and completed.confidence is not None and int((part.fade > 0).sum()) > 20
    assert torch.equal(part.refine_mask, view.holes) and bool(view.holes.any())
    torch.testing.assert_close(completed.rgb[:, view.holes], filled[:, view.holes], atol=1e-3, rtol=0)
    torch.testing.assert_close(
        completed.rgb[:, rest], ((1 - part.error) * view.rgb)[:, rest], atol=1e-5, rtol=0
    )
    torch.testing.assert_close(completed.opacity[rest], ((1 - part.error) * view.mask)[rest])
    assert not bool(completed.confidence[view.holes].any())
    assert bool((completed.confidence[rest] == view.mask[rest]).all())
