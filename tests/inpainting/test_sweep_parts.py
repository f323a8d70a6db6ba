"""Which part of a view a reader of whole views reads: what is wrong, what a quality allows, what a stream asks for."""

import time
from dataclasses import replace

import pytest
import torch

from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.inpainting.protocol import ContextProvider, RenderQuality, State
from viewmend.inpainting.sweep.cells import rim_depth
from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.inpainting.sweep.error_net import ErrorMap, faded, most_wrong
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.rendering.crop import Crop
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig

SMALL = SweepConfig(num_views=4, width=8, place_channels=4, features=8, fine_features=8)


@pytest.fixture(scope="module")
def teller():
    torch.manual_seed(4)
    return SweepNet(replace(SMALL, error_features=8))


@torch.no_grad()
def test_errors_are_told_on_the_proxy_and_its_rim(scene, teller):
    _, view, rig = scene
    found = teller.errors(view, rig)
    there = rim_depth(view.depth) > 0
    for image in found:
        assert image.shape == view.mask.shape and not bool(image[~there].any())
        assert float(image[there].min()) > 0 and float(image.max()) < 1 and float(image[there].std()) > 1e-3
    blank = replace(view, rgb=0 * view.rgb)
    assert not torch.equal(teller.errors(blank, rig).wrong, found.wrong)
    other = replace(view, error=0 * view.error)
    assert torch.equal(teller.errors(other, rig).wrong, found.wrong), "E is what it is for"


def test_most_is_gained_first_and_holes_always(scene):
    _, view, _ = scene
    gain = torch.rand(view.mask.shape, generator=torch.Generator().manual_seed(0)) * (rim_depth(view.depth) > 0)
    hull, holes = int((view.mask > 0).sum()), view.holes
    error = most_wrong(view, gain, 0.3)
    chosen = error > 0
    assert int(holes.sum()) < 0.3 * hull and int(chosen.sum()) == int(0.3 * hull)
    assert bool(chosen[holes].all()) and float(gain[chosen & ~holes].min()) >= float(gain[~chosen].max())
    assert set(error.unique().tolist()) == {0.0, 1.0}
    assert torch.equal(most_wrong(view, gain, 1e-6) > 0, holes), "though that is more"
    nothing = most_wrong(view, 1e-5 * gain, 0.3) > 0
    assert torch.equal(nothing, holes), "what hardly changes is left"


def test_what_is_background_fades_and_is_not_read(scene, teller):
    """E is 1 where a view is read, and elsewhere how much of the colour goes; nothing else changes."""
    stream, view, _ = scene
    random = torch.Generator().manual_seed(0)
    rest, alpha = (torch.rand(view.mask.shape, generator=random) for _ in range(2))
    rest, alpha = rest * (rim_depth(view.depth) > 0), torch.where(alpha < 0.3, 1.0, alpha)
    part = faded(view, ErrorMap(rest, rest, alpha, rest), 0.3)
    hull = view.mask > 0
    assert torch.equal(part.read, most_wrong(view, rest, 0.3) > 0) and bool((part.error[part.read] == 1).all())
    left = hull & ~part.read
    assert torch.equal(part.error[left], torch.where(alpha < 0.98, 1 - alpha, 0.0)[left])
    assert not bool(part.error[~hull & ~part.read].any())
    mended = stream.mend(part).completed
    assert torch.equal(mended.rgb[:, left & (alpha == 1)], view.rgb[:, left & (alpha == 1)])
    torch.testing.assert_close(mended.rgb[:, left], ((1 - part.error) * view.rgb)[:, left])
    torch.testing.assert_close(mended.alpha[left], 1 - part.error[left])
    alone = stream.mend(replace(view, error=part.read.float())).completed
    assert torch.equal(mended.rgb[:, part.read], alone.rgb[:, part.read])
    assert float((mended.rgb - view.rgb)[:, part.read].abs().mean()) > 0.01
    nothing = replace(view, error=part.fade, fade=part.fade)
    dark, _ = stream.inpainter.step(nothing, ContextProvider(lambda *_: None), State())
    torch.testing.assert_close(dark.rgb, (1 - part.fade) * view.rgb)
    assert dark.alpha is not None and torch.equal(dark.alpha, (1 - part.fade) * view.mask)
    half = faded(replace(view, error=0.5 * view.error), ErrorMap(rest, rest, 0 * alpha, rest), 0.3)
    assert float(half.error.max()) == 0.5, "never more than was asked"
    whole, crop = Crop(16, 16, 80, 83), view.camera
    around = whole.uncropped(whole.of_view(part), crop)
    assert torch.equal(around.fade[16:, 16:80], part.fade[16:, 16:80]) and not bool(around.fade[:16].any())


def test_the_rule_wrong_asks_the_inpainter_or_the_shipped_model(scene, teller):
    """E of a stream: what the model that fills takes for wrong; where it cannot tell, the model for whole views."""
    stream, view, _ = scene
    frame = stream.observation().frame
    config = StreamConfig(render=RenderConfig(error_rule="wrong", wrong_fraction=0.5))
    own = Stream(teller, config)
    own.push(frame, stream.observation().proxy)
    narrowed = own.render(view.camera)
    chosen = narrowed.read
    hull = int((view.mask > 0).sum())
    assert bool(chosen[view.holes].all()) and not bool(chosen[view.error == 0].any())
    assert int(view.holes.sum()) < int(chosen.sum()) <= int(0.5 * hull)
    mended = own.view(view.camera).completed
    same = mended.view.error == 0
    assert torch.equal(mended.rgb[:, same], view.rgb[:, same])
    with pytest.raises(ValueError, match="a model that predicts errors"):
        silent = Stream(SweepNet(SMALL), config)
        silent.push(frame, stream.observation().proxy)
        silent.render(view.camera)


@pytest.mark.parametrize("fraction", [0.0, -1.0, 1.5, float("nan")])
def test_an_impossible_fraction_is_refused(fraction):
    with pytest.raises(ValueError, match="expected a wrong_fraction above 0"):
        RenderConfig(wrong_fraction=fraction)


def test_a_stream_asks_for_what_its_inpainter_is_made_for(scene):
    stream, view, _ = scene
    asked = {}
    for name, inpainter, rule in [
        ("reader", stream.inpainter, None),
        ("fill", SmoothFill(), None),
        ("told", SmoothFill(), "all"),
        ("held", stream.inpainter, "unseen"),
    ]:
        own = Stream(inpainter, StreamConfig(render=RenderConfig(error_rule=rule)))
        own.push(stream.observation().frame, stream.observation().proxy)
        asked[name] = own.render(view.camera).error
        assert torch.equal(own.view(view.camera).completed.view.error, asked[name])
    assert torch.equal(asked["reader"], view.error) and torch.equal(asked["told"], view.error)
    assert torch.equal(asked["fill"] > 0, view.holes) and torch.equal(asked["held"] > 0, view.holes)
    assert int(view.holes.sum()) > 0


def test_a_part_is_read_with_a_quick_guess(scene, monkeypatch):
    stream, view, _ = scene
    net = SweepNet(replace(SMALL, coarse_fill="rays", error_features=8)).eval()
    own, asked = Stream(net, StreamConfig()), []
    own.push(stream.observation().frame, stream.observation().proxy)
    monkeypatch.setattr(net.coarse, "forward", lambda *given: asked.append(given) or [view.rgb])
    own.view(view.camera, quality=RenderQuality(read_fraction=0.3))
    assert asked == []
    own.view(view.camera)
    assert len(asked) == 1


def test_a_quality_may_allow_only_a_part(scene, teller):
    stream, view, _ = scene
    hull, holes = int((view.mask > 0).sum()), int(view.holes.sum())

    def mended_px(rule, fraction, wrong_fraction=0.5, **more):
        render = RenderConfig(error_rule=rule, wrong_fraction=wrong_fraction)
        own = Stream(teller, StreamConfig(render=render))
        own.push(stream.observation().frame, stream.observation().proxy)
        quality = RenderQuality(read_fraction=fraction, **more)
        return [own.view(view.camera, quality=quality), own.mend(view, quality=quality)]

    for rule, allowed, most in [("all", 0.4, 0.4), ("wrong", 0.4, 0.4), ("wrong", 0.9, 0.5)]:
        seen, given = (int(one.completed.view.read.sum()) for one in mended_px(rule, allowed))
        assert holes < seen <= most * hull < 1.1 * seen
        assert given <= allowed * hull < 1.1 * given, "what other renderers ask for is narrowed, too"
    assert int((mended_px("unseen", 0.4)[0].completed.view.error > 0).sum()) == holes
    untouched = mended_px("all", 0.4, mend=False)[0].completed.view
    assert torch.equal(untouched.error, view.error), "nobody was to look"


def test_where_nothing_is_to_be_read_background_fades_and_holes_are_filled_from_around(scene, teller, monkeypatch):
    stream, view, _ = scene
    own = Stream(teller, StreamConfig())
    own.push(stream.observation().frame, stream.observation().proxy)
    monkeypatch.setattr(teller, "forward", lambda *given, **more: pytest.fail("nothing is read"))
    mended = own.view(view.camera, quality=RenderQuality(read_fraction=0.0)).completed
    assert mended.view.fade is not None and mended.confidence is not None
    part, filled = mended.view, SmoothFill()([replace(view, error=view.holes.float())], [None])[0]
    assert torch.equal(part.read, view.holes) and bool(view.holes.any())
    assert int((mended.view.fade > 0).sum()) > 20
    torch.testing.assert_close(mended.rgb[:, view.holes], filled[:, view.holes], atol=1e-3, rtol=0)
    rest = ~view.holes
    torch.testing.assert_close(mended.rgb[:, rest], ((1 - part.error) * view.rgb)[:, rest], atol=1e-5, rtol=0)
    torch.testing.assert_close(mended.opacity[rest], ((1 - part.error) * view.mask)[rest])
    assert not bool(mended.confidence[view.holes].any()) and bool((mended.confidence[rest] == view.mask[rest]).all())


def test_finding_what_is_wrong_is_paid_by_inpainting(scene, teller, monkeypatch):
    stream, view, _ = scene
    own = Stream(teller, StreamConfig())
    own.push(stream.observation().frame, stream.observation().proxy)
    own.view(view.camera, quality=RenderQuality(read_fraction=0.3))
    whole = teller.error_map
    monkeypatch.setattr(teller, "error_map", lambda *given: time.sleep(1.0) or whole(*given))
    times = own.view(view.camera, quality=RenderQuality(read_fraction=0.3)).times
    assert times.inpainting > 1000 > times.rendering
