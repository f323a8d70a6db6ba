"""Many viewers of one stream: what is shared is computed once, what is not stays apart."""

from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, photograph, proxy, ring

from viewmend.baselines.classical import Telea
from viewmend.baselines.reprojection_fill import ReprojectionFill
from viewmend.geometry.hull import HullConfig
from viewmend.inpainting.chain import Chain
from viewmend.inpainting.config import small
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.protocol import ContextProvider, RenderQuality
from viewmend.inpainting.temporal_accumulation import TemporalAccumulation
from viewmend.observation import observe
from viewmend.rendering.view import render_view
from viewmend.stream import Stream, StreamConfig
from viewmend.views import IncompleteView, MultiViewFrame

CONFIG = StreamConfig(hull=HullConfig(resolution=32))


SPARSE = ring(12)[[0, 1, 2, 4, 7, 9]]


A, B = camera_at(140, "a"), camera_at(250, "b")


TOLERANCE = 1e-4
"""Batches of another size round differently."""


@pytest.fixture(scope="module")
def model() -> TemporalAccumulation:
    torch.manual_seed(0)
    return TemporalAccumulation(Chain(replace(small(), widths=(8,) * 9, dim=64, k_w=2, n_w=1, n_c=2)).eval(), 0.7)


@pytest.fixture
def encoded(monkeypatch):
    """Camera and time of all that was encoded."""
    found, encode = [], PatchTransformer.encode_contexts

    def counting(self, many):
        found.extend((name, views.frame.time) for views in many for name in views.frame.cameras.names)
        return encode(self, many)

    monkeypatch.setattr(PatchTransformer, "encode_contexts", counting)
    return found


def frames(count):
    return [photograph(SPARSE, time) for time in range(count)]


def walk(stream, times, *targets, quality=None):
    """The last images of viewers that look from `targets` at each time in turn."""
    viewers, images = [stream.viewer() for _ in targets], []
    for time in times:
        stream.push(photograph(SPARSE, time))
        seen = [stream.view(t, v, time, quality) for t, v in zip(targets, viewers, strict=True)]
        viewers, images = [s.viewer for s in seen], [s.completed.rgb for s in seen]
    return images


def test_a_stream_gives_what_steps_give(model):
    """Push, render and mend, against the inpainter's own steps with a provider that asks observations anew."""
    at, state, config = {}, model.initial_state(), CONFIG
    provider = ContextProvider(lambda time, names: at[time].context(names) if time in at else None)
    for frame in frames(4):
        at[frame.time] = observe(frame, None, config.hull)
        view = render_view(frame, at[frame.time].proxy, A, config.render)
        plain, state = model.step(view, provider, state)
    (image,) = walk(Stream(model, CONFIG), range(4), A)
    assert (plain.rgb - plain.view.rgb).abs().max() > 0.05
    assert (image - plain.rgb).abs().max() < TOLERANCE


@pytest.mark.parametrize("inpainter", ["model", "telea"])
def test_viewers_do_not_feel_each_other(model, inpainter):
    inpainter = model if inpainter == "model" else Telea()
    together = walk(Stream(inpainter, CONFIG), range(4), A, B, A)
    alone = [walk(Stream(inpainter, CONFIG), range(4), target)[0] for target in (A, B)]
    assert (together[0] - alone[0]).abs().max() < TOLERANCE
    assert (together[1] - alone[1]).abs().max() < TOLERANCE
    assert (together[2] - alone[0]).abs().max() < TOLERANCE
    assert (together[0] - together[1]).abs().max() > 0.2


def test_every_camera_image_is_encoded_once_whoever_looks(model, encoded):
    stream = Stream(model, CONFIG)
    walk(stream, range(3), A, B, A, camera_at(145, "c"))
    assert len(encoded) == len(set(encoded)) and len(encoded) >= 3 * 4
    before = len(encoded)
    stream.view(camera_at(320, "d"), None, 2, RenderQuality(context_times=0))  # other cameras, no context
    for time in (0, 2, 1):  # seeking back and forth finds everything there
        assert stream.view(A, None, time).times.context == 0
    assert len(encoded) == before


@pytest.mark.parametrize("count", [1, 5])
def test_other_numbers_of_context_cameras_are_encoded_once_too(count, encoded):
    torch.manual_seed(0)
    config = replace(small(), widths=(8,) * 9, dim=64, k_w=2, n_w=1, n_c=2, context_cameras=count)
    walk(Stream(Chain(config).eval(), CONFIG), range(3), A, A)
    assert len(encoded) == len(set(encoded)) == 3 * count


def test_the_first_view_pays_for_what_all_share(model):
    stream = Stream(model, CONFIG)
    stream.push(photograph(SPARSE, 0))
    first, second = stream.view(A).times, stream.view(A).times
    assert min(first.geometry, first.context, first.rendering, first.inpainting) > 0
    assert second.geometry == second.context == 0 and min(second.rendering, second.inpainting) > 0


@pytest.mark.parametrize("inpainter", ["model", "reprojection"])
def test_cameras_of_different_sizes_are_looked_at(model, inpainter):
    sizes = torch.tensor([[48, 48], [40, 48], [48, 48], [48, 48], [48, 48], [52, 64]])
    whole = photograph(SPARSE)
    rgb, mask = (torch.nn.functional.pad(x, (0, 4, 0, 16)) for x in (whole.rgb, whole.mask))
    stream = Stream(model if inpainter == "model" else ReprojectionFill(3), CONFIG)
    stream.push(MultiViewFrame(replace(SPARSE, size_px=sizes), rgb, mask, 0))
    seen = stream.view(A, None, exclude=("c9",))
    assert seen.completed.view.source_views and (seen.completed.rgb - seen.completed.view.rgb).abs().max() > 0.05


def test_a_time_is_carved_once_and_stays(model):
    stream = Stream(model, CONFIG)
    first = stream.push(frames(1)[0])
    assert stream.push(photograph(SPARSE[[0, 1]], 0)) is first
    assert stream.times == (0,) and first.frame.depth is None


def test_a_look_back_sees_no_later_time(model):
    stream = Stream(model, CONFIG)
    walk(stream, range(4), A)
    back = stream.view(A, None, 1).completed.rgb
    (then,) = walk(Stream(model, CONFIG), range(2), A)
    assert (back - then).abs().max() < TOLERANCE


def test_quality_takes_less_of_the_context(model):
    stream = Stream(model, CONFIG)
    everything = walk(stream, range(4), A)[0]
    now = stream.view(A, None, 3, RenderQuality(context_times=1)).completed
    lone = Stream(model, CONFIG)
    lone.push(photograph(SPARSE, 3))
    assert (now.rgb - lone.view(A).completed.rgb).abs().max() < TOLERANCE
    assert not torch.equal(now.rgb, everything)
    assert not torch.equal(stream.view(A, None, 3, RenderQuality(top_k=4)).completed.rgb, everything)
    raw = stream.view(A, None, 3, RenderQuality(mend=False))
    assert torch.equal(raw.completed.rgb, raw.completed.view.rgb) and raw.times.inpainting == 0


def test_memory_is_bounded_and_the_newest_time_stays(model):
    stream = Stream(model, replace(CONFIG, memory_mb=1.5))
    images = walk(stream, range(6), A)
    assert 1 <= len(stream.times) < 5 and stream.times[-1] == 5
    assert bool(images[0].isfinite().all())
    tiny = Stream(model, replace(CONFIG, memory_mb=0.0))
    walk(tiny, range(2), A)
    assert tiny.times == (1,)


def test_views_of_another_renderer_are_mended(model):
    """A frame without masks, a geometry that is not ours, a view rendered elsewhere."""
    frame = replace(photograph(SPARSE), mask=None)
    stream = Stream(model, CONFIG)
    stream.push(frame, proxy(24))
    truth = photograph(A)
    rgb, mask, depth = truth.rgb[0] / 255, truth.mask[0] / 255, truth.depth[0]
    error = torch.zeros_like(mask)
    error[20:28, 20:28] = 1
    names = ("c4", "c7", "c2")
    view = IncompleteView(A, rgb * (1 - error), mask, error, depth, names, torch.ones(3, 48, 48) / 3, 0, names)
    mended = stream.mend(view)
    assert torch.equal(mended.completed.rgb[:, error == 0], view.rgb[:, error == 0])
    assert (mended.completed.rgb - rgb)[:, error > 0].abs().mean() < 0.5 * rgb[:, error > 0].mean()
    with pytest.raises(ValueError, match=r"cameras among .* got \['x'\]"):
        stream.mend(replace(view, candidate_views=("x",)))


class Sensors:
    """A geometry that knows depth alone."""

    def depth(self, cameras):
        return photograph(cameras).depth


def test_what_cannot_be_asked_for_is_said(model):
    stream = Stream(model, CONFIG)
    with pytest.raises(ValueError, match="push its frame first"):
        stream.view(A)
    stream.push(photograph(SPARSE), Sensors())
    with pytest.raises(ValueError, match="expected a GeometryProxy to render, got Sensors"):
        stream.view(A)
    with pytest.raises(ValueError, match=r"among those at hand, \(0,\), got 7"):
        stream.view(A, time=7)


def test_the_time_looked_at_longest_ago_is_forgotten_first():
    stream = Stream(Telea(), replace(CONFIG, memory_mb=None))
    walk(stream, [0], A)
    seen = Stream(Telea(), replace(CONFIG, memory_mb=3.5e-6 * stream.observation().size))
    walk(seen, range(3), A)
    assert seen.times == (0, 1, 2)
    seen.view(A, time=0)
    walk(seen, [3], A)
    assert seen.times == (0, 2, 3)
    seen.push(photograph(SPARSE, 2))  # at hand already: somebody wants it
    walk(seen, [4], A)
    assert seen.times == (2, 3, 4)


@pytest.mark.parametrize("part", ["rgb", "alpha", "confidence", "depth"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_never_leave_a_stream(part, value):
    class Broken(Telea):
        def step(self, view, context, state):
            completed, state = super().step(view, context, state)
            image = (completed.rgb if part == "rgb" else view.mask.float()).clone()
            image[..., 20, 20] = value
            return replace(completed, **{part: image}), state

    stream = Stream(Broken(), CONFIG)
    stream.push(photograph(SPARSE, 0))
    for look in (stream.view, lambda camera: stream.mend(stream.render(camera))):
        with pytest.raises(ValueError, match="expected finite colours from Broken, got others"):
            look(A)
