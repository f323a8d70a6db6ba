"""Many viewers of one stream: what is shared is computed once, what is not stays apart."""

from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, photograph, proxy, ring

from viewmend.baselines.classical import Telea
from viewmend.baselines.reprojection_fill import ReprojectionFill
from viewmend.geometry.hull import HullConfig
from viewmend.inpainting.config import small
from viewmend.inpainting.inpainter import Inpainter
from viewmend.pipeline import PipelineConfig, StreamState, mend_view, observe
from viewmend.stream import RenderQuality, Stream
from viewmend.views import IncompleteView, MultiViewFrame

CONFIG = PipelineConfig(hull=HullConfig(resolution=32))
SPARSE = ring(12)[[0, 1, 2, 4, 7, 9]]
A, B = camera_at(140, "a"), camera_at(250, "b")
TOLERANCE = 1e-4
"""Batches of another size round differently."""


@pytest.fixture(scope="module")
def model() -> Inpainter:
    torch.manual_seed(0)
    return Inpainter(replace(small(), widths=(8,) * 9, dim=64, k_w=2, n_w=1, n_c=2)).eval()


class Counting(Inpainter):
    """Counts what it encodes."""

    def __init__(self, config):
        super().__init__(config)
        self.encoded = []

    def encode_contexts(self, many):
        self.encoded += [(name, views.frame.time) for views in many for name in views.frame.cameras.names]
        return super().encode_contexts(many)


def frames(count):
    return [photograph(SPARSE, time) for time in range(count)]


def walk(stream, times, *targets, effort=None):
    """The last images of viewers that look from `targets` at each time in turn."""
    viewers, images = [stream.viewer() for _ in targets], []
    for time in times:
        stream.push(photograph(SPARSE, time))
        seen = [stream.view(t, v, time, effort) for t, v in zip(targets, viewers, strict=True)]
        viewers, images = [s.viewer for s in seen], [s.completed.rgb for s in seen]
    return images


def test_a_stream_gives_what_the_pipeline_gives(model):
    state = StreamState(model.initial_state())
    for frame in frames(4):
        plain = mend_view(observe(frame, None, CONFIG), A, state, model, CONFIG)
        state = plain.state
    (image,) = walk(Stream(model, CONFIG), range(4), A)
    assert (plain.completed.rgb - plain.completed.view.rgb).abs().max() > 0.05
    assert (image - plain.completed.rgb).abs().max() < TOLERANCE


@pytest.mark.parametrize("inpainter", ["model", "telea"])
def test_viewers_do_not_feel_each_other(model, inpainter):
    inpainter = model if inpainter == "model" else Telea()
    together = walk(Stream(inpainter, CONFIG), range(4), A, B, A)
    alone = [walk(Stream(inpainter, CONFIG), range(4), target)[0] for target in (A, B)]
    assert (together[0] - alone[0]).abs().max() < TOLERANCE
    assert (together[1] - alone[1]).abs().max() < TOLERANCE
    assert (together[2] - alone[0]).abs().max() < TOLERANCE
    assert (together[0] - together[1]).abs().max() > 0.2


def test_every_camera_image_is_encoded_once_whoever_looks():
    torch.manual_seed(0)
    model = Counting(replace(small(), widths=(8,) * 9, dim=64, k_w=2, n_w=1, n_c=2)).eval()
    stream = Stream(model, CONFIG)
    walk(stream, range(3), A, B, A, camera_at(145, "c"))
    assert len(model.encoded) == len(set(model.encoded)) and len(model.encoded) >= 3 * 4
    before = len(model.encoded)
    stream.view(camera_at(320, "d"), None, 2, RenderQuality(context_times=0))  # other cameras, no context
    for time in (0, 2, 1):  # seeking back and forth finds everything there
        stream.view(A, None, time)
    assert len(model.encoded) == before


@pytest.mark.parametrize("count", [1, 5])
def test_other_numbers_of_context_cameras_are_encoded_once_too(count):
    torch.manual_seed(0)
    config = replace(small(), widths=(8,) * 9, dim=64, k_w=2, n_w=1, n_c=2, context_cameras=count)
    model = Counting(config).eval()
    walk(Stream(model, CONFIG), range(3), A, A)
    assert len(model.encoded) == len(set(model.encoded)) == 3 * count


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


def test_effort_takes_less_of_the_context(model):
    stream = Stream(model, CONFIG)
    everything = walk(stream, range(4), A)[0]
    now = stream.view(A, None, 3, RenderQuality(context_times=1)).completed
    lone = Stream(model, CONFIG)
    lone.push(photograph(SPARSE, 3))
    assert (now.rgb - lone.view(A).completed.rgb).abs().max() < TOLERANCE
    assert not torch.equal(now.rgb, everything)
    assert not torch.equal(stream.view(A, None, 3, RenderQuality(top_k=4)).completed.rgb, everything)
    raw = stream.view(A, None, 3, RenderQuality(mend=False))
    assert torch.equal(raw.completed.rgb, raw.completed.view.rgb) and raw.stage_ms.inpainting == 0


def test_memory_is_bounded_and_the_newest_time_stays(model):
    stream = Stream(model, CONFIG, memory_mb=1.5)
    images = walk(stream, range(6), A)
    assert 1 <= len(stream.times) < 5 and stream.times[-1] == 5
    assert bool(images[0].isfinite().all())
    tiny = Stream(model, CONFIG, memory_mb=0.0)
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
