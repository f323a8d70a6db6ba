"""Streams and their viewers: what is shared is computed once, the rest is separate."""

import copy
import itertools
from dataclasses import dataclass, replace
from inspect import unwrap

import numpy as np
import pytest
import torch
from reference.ball import camera_at, photograph, proxy, ring
from reference.forged import forged

from viewmend.frame_cache import WINDOW, cache_frame
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy
from viewmend.live.encoding import draw_mode
from viewmend.models.base import ContextProvider, Inpainter, RenderQuality, State
from viewmend.models.checkpoint import load_inpainter
from viewmend.models.classical import ReprojectionFill, Telea
from viewmend.models.paper.config import paper_small
from viewmend.models.paper.context import window_times
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.rendering.view import RenderConfig, render_view
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import CompletedView, IncompleteView, MultiViewFrame
from viewmend.utils.cancellation import CancelledError, cancellable

CONFIG = StreamConfig(hull=HullConfig(resolution=32))
SPARSE = ring(12)[[0, 1, 2, 4, 7, 9]]
A, B = camera_at(140, "a"), camera_at(250, "b")
TOLERANCE = 1e-4
"""Batches of different sizes round differently."""


@pytest.fixture(scope="module")
def model() -> PatchTransformer:
    torch.manual_seed(0)
    return PatchTransformer(
        replace(paper_small(), widths=(8,) * 9, dim=64, heads=4, k_w=2, n_w=1, n_c=2)
    ).eval()


@pytest.fixture
def encoded(monkeypatch):
    """Name and frame of every camera image that was encoded."""
    found, encode = [], PatchTransformer.encode_contexts

    def counting(self, many):
        found.extend((name, views.frame.time) for views in many for name in views.frame.cameras.names)
        return encode(self, many)

    monkeypatch.setattr(PatchTransformer, "encode_contexts", counting)
    return found


def walk(stream, times, *targets, quality=None):
    """The last images of viewers at `targets` that request each frame in turn."""
    viewers, images = [stream.viewer() for _ in targets], []
    for time in times:
        stream.add_frame(photograph(SPARSE, time))
        seen = [stream.view(t, v, time, quality) for t, v in zip(targets, viewers, strict=True)]
        viewers, images = [s.viewer for s in seen], [s.completed.rgb for s in seen]
    return images


def test_a_stream_equals_direct_steps(model):
    """`Stream` against direct calls of `step` with a provider that caches nothing."""
    at, state, config = {}, model.initial_state(), CONFIG
    provider = ContextProvider(lambda time, names: at[time].context(names) if time in at else None)
    for time in range(4):
        at[time] = cache_frame(photograph(SPARSE, time), None, config.hull)
        view, _ = render_view(at[time].frame, at[time].proxy, A, config.render)
        plain, state = model.step(view, provider, state)
    (image,) = walk(Stream(model, CONFIG), range(4), A)
    assert (plain.rgb - plain.view.rgb).abs().max() > 0.05
    assert (image - plain.rgb).abs().max() < TOLERANCE


@pytest.mark.parametrize("inpainter", ["model", "telea"])
def test_viewers_are_independent(model, inpainter):
    inpainter = model if inpainter == "model" else Telea()
    together = walk(Stream(inpainter, CONFIG), range(4), A, B, A)
    alone = [walk(Stream(inpainter, CONFIG), range(4), target)[0] for target in (A, B)]
    for image, other in zip(together, (*alone, alone[0]), strict=True):
        assert (image - other).abs().max() < TOLERANCE
    assert (together[0] - together[1]).abs().max() > 0.2


@pytest.mark.parametrize("name", ["model", "views"])
def test_a_view_can_be_cancelled_at_any_step(model, name):
    """A cancelled view ends early, and leaves nothing behind that changes the next one."""
    inpainter = model if name == "model" else load_inpainter("views")
    frame, fresh, steps = photograph(SPARSE), Stream(inpainter, CONFIG), []
    fresh.add_frame(frame)
    with cancellable(lambda: bool(steps.append(0))):
        expected = fresh.view(A).completed.rgb
    assert len(steps) >= 8
    for end in range(0, len(steps), 5):
        stream, count = Stream(inpainter, CONFIG), itertools.count()
        stream.add_frame(frame)
        with pytest.raises(CancelledError), cancellable(lambda count=count, end=end: next(count) >= end):
            stream.view(A)
        assert (stream.view(A).completed.rgb - expected).abs().max() < TOLERANCE


def test_every_camera_image_is_encoded_once_for_all_viewers(model, encoded):
    stream = Stream(model, CONFIG)
    walk(stream, range(3), A, B, A, camera_at(145, "c"))
    assert len(encoded) == len(set(encoded)) and len(encoded) >= 3 * 3, "B has no holes"
    before = len(encoded)
    stream.view(camera_at(320, "d"), None, 2, RenderQuality(context_times=0))  # other cameras, no context
    for time in (0, 2, 1):  # seeking needs no new encoding
        assert stream.view(A, None, time).times.context == 0
    assert len(encoded) == before


@pytest.mark.parametrize("name", ["model", "views", "predicted"])
def test_the_first_view_of_a_frame_is_charged_for_shared_work(model, name):
    """`predicted`: the first to encode cameras is the prediction of errors."""
    render = (
        RenderConfig(error_rule="predicted", refine_fraction=0.5) if name == "predicted" else CONFIG.render
    )
    stream = Stream(model if name == "model" else load_inpainter("views"), replace(CONFIG, render=render))
    stream.add_frame(photograph(SPARSE, 0))
    first, second = stream.view(A).times, stream.view(A).times
    assert min(first.geometry, first.context, first.rendering, first.inpainting) > 0
    assert second.geometry == second.context == 0 and min(second.rendering, second.inpainting) > 0


def test_encoding_within_encoding_is_timed_once(monkeypatch):
    seconds = map(float, itertools.count())
    monkeypatch.setattr("viewmend.utils.timing.now_s", lambda device: next(seconds))
    monkeypatch.setattr("viewmend.models.base.now_s", lambda device: next(seconds))
    provider, cpu = ContextProvider(lambda *_: None), torch.device("cpu")

    def outer(names):
        return provider.remembered(0, "inner", names, lambda names: ["inner"], cpu)

    assert provider.remembered(0, "outer", ["c0"], outer, cpu) == ["inner"] and provider.encoding_ms == 3000
    provider.remembered(0, "outer", ["c1"], outer, cpu)
    assert provider.encoding_ms == 6000


@pytest.mark.parametrize("inpainter", ["model", "reprojection"])
def test_cameras_of_different_sizes_are_used(model, inpainter):
    sizes = torch.tensor([[48, 48], [40, 48], [48, 48], [48, 48], [48, 48], [52, 64]])
    whole = photograph(SPARSE)
    rgb, mask = (torch.nn.functional.pad(x, (0, 4, 0, 16)) for x in (whole.rgb, whole.mask))
    stream = Stream(model if inpainter == "model" else ReprojectionFill(3), CONFIG)
    stream.add_frame(MultiViewFrame(replace(SPARSE, size_px=sizes), rgb, mask, 0))
    seen = stream.view(A, None, exclude=("c9",))
    assert (
        seen.completed.view.source_views and (seen.completed.rgb - seen.completed.view.rgb).abs().max() > 0.05
    )


def test_a_cached_frame_is_not_replaced(model):
    stream = Stream(model, CONFIG)
    first = stream.add_frame(photograph(SPARSE))
    assert stream.add_frame(photograph(SPARSE[[0, 1]], 0)) is first
    assert stream.times == (0,) and first.frame.depth is None


def test_lower_quality_uses_less_context(model):
    stream = Stream(model, CONFIG)
    everything = walk(stream, range(4), A)[0]
    now = stream.view(A, None, 3, RenderQuality(context_times=1)).completed
    (lone,) = walk(Stream(model, CONFIG), [3], A)
    assert (now.rgb - lone).abs().max() < TOLERANCE
    assert not torch.equal(now.rgb, everything)
    assert not torch.equal(stream.view(A, None, 3, RenderQuality(top_k=4)).completed.rgb, everything)
    raw = stream.view(A, None, 3, RenderQuality(mend=False))
    assert torch.equal(raw.completed.rgb, raw.completed.view.rgb) and raw.times.inpainting == 0


def test_memory_is_bounded_and_the_newest_frame_is_kept(model):
    stream = Stream(model, replace(CONFIG, memory_mb=1.5))
    images = walk(stream, range(6), A)
    assert 1 <= len(stream.times) < 5 and stream.times[-1] == 5
    assert bool(images[0].isfinite().all())
    tiny = Stream(model, replace(CONFIG, memory_mb=0.0))
    walk(tiny, range(2), A)
    assert tiny.times == (1,)


def test_views_of_another_renderer_are_completed(model):
    """A frame without masks, with a custom geometry and a view rendered elsewhere."""
    frame = replace(photograph(SPARSE), mask=None)
    stream = Stream(model, CONFIG)
    stream.add_frame(frame, proxy(24))
    truth = photograph(A)
    rgb, mask, depth = truth.rgb[0] / 255, truth.mask[0] / 255, truth.depth[0]
    error = torch.zeros_like(mask)
    error[20:28, 20:28] = 1
    names = ("c4", "c7", "c2")
    view = IncompleteView(
        A, rgb * (1 - error), mask, error, depth, names, torch.ones(3, 48, 48) / 3, 0, names
    )
    mended = stream.mend(view)
    assert torch.equal(mended.completed.rgb[:, error == 0], view.rgb[:, error == 0])
    assert (mended.completed.rgb - view.rgb)[:, error > 0].abs().mean() > 0.01
    with pytest.raises(ValueError, match=r"cameras among .* got \['x'\]"):
        stream.mend(replace(view, candidate_views=("x",)))


class Sensors:
    """A geometry that provides only depth."""

    def depth(self, cameras):
        return photograph(cameras).depth


def test_impossible_requests_are_refused(model):
    stream = Stream(model, CONFIG)
    with pytest.raises(ValueError, match="expected a capture with masks"):
        stream.add_frame(replace(photograph(SPARSE), mask=None))
    with pytest.raises(ValueError, match="add its frame first"):
        stream.view(A)
    stream.add_frame(photograph(SPARSE), Sensors())
    with pytest.raises(ValueError, match="expected a GeometryProxy to render, got Sensors"):
        stream.view(A)
    with pytest.raises(ValueError, match=r"expected the time of a cached frame, \(0,\), got 7"):
        stream.view(A, time=7)


def test_the_least_recently_used_frame_is_evicted_first():
    stream = Stream(Telea(), replace(CONFIG, memory_mb=None))
    walk(stream, [0], A)
    seen = Stream(Telea(), replace(CONFIG, memory_mb=3.5e-6 * stream.cached_frame().size))
    walk(seen, range(3), A)
    assert seen.times == (0, 1, 2)
    seen.view(A, time=0)
    walk(seen, [3], A)
    assert seen.times == (0, 2, 3)
    seen.add_frame(photograph(SPARSE, 2))  # cached already, now recently used
    walk(seen, [4], A)
    assert seen.times == (2, 3, 4)


@pytest.mark.parametrize("part", ["rgb", "alpha", "confidence", "depth"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_non_finite_results_are_refused(part, value):
    class Broken(Telea):
        def step(self, view, context, state):
            completed, state = super().step(view, context, state)
            image = (completed.rgb if part == "rgb" else view.mask.float()).clone()
            image[..., 20, 20] = value
            return replace(completed, **{part: image}), state

    stream = Stream(Broken(), CONFIG)
    stream.add_frame(photograph(SPARSE, 0))
    for look in (stream.view, lambda camera: stream.mend(stream.render(camera))):
        with pytest.raises(
            ValueError, match=rf"Broken: expected `step` .* numbers in {part} that are not finite"
        ):
            look(A)


def with_rgb(view, rgb):
    """A completed view with any object as its colours, past the type checks of tests."""
    completed = CompletedView(view, view.rgb)
    vars(completed)["rgb"] = rgb
    return completed


@pytest.mark.parametrize(
    ("returned", "got"),
    [
        (lambda view, state: CompletedView(view, view.rgb), "a CompletedView alone"),
        (lambda view, state: view.rgb, "a Tensor alone"),
        (lambda view, state: (view.rgb, state), r"\(Tensor, State\)"),
        (
            lambda view, state: (with_rgb(view, (255 * view.rgb).byte()), state),
            r"rgb as torch\.uint8 of shape \(3, ",
        ),
        (lambda view, state: (with_rgb(view, 255 * view.rgb), state), r"rgb from 0 to \d\d"),
        (lambda view, state: (with_rgb(view, view.rgb - 1), state), "rgb from -1 to"),
        (
            lambda view, state: (with_rgb(view, view.rgb.movedim(0, -1)), state),
            r"rgb as .* of shape \(\d+, \d+, 3\)",
        ),
        (lambda view, state: (with_rgb(view, view.rgb.numpy()), state), "rgb as ndarray"),
        (lambda view, state: (with_rgb(view, None), state), "rgb as NoneType"),
        (
            lambda view, state: (CompletedView(view, view.rgb, alpha=2 * view.mask), state),
            "alpha from 0 to 2",
        ),
    ],
)
def test_what_a_step_returns_is_checked(returned, got):
    class Own(Inpainter):
        def step(self, view, context, state):
            return returned(view, state)

    stream = Stream(Own(), CONFIG)
    stream.add_frame(photograph(SPARSE, 0))
    with pytest.raises(
        ValueError, match=rf"Own: expected `step` to return \(CompletedView, State\), .* got {got}.*; "
    ):
        stream.view(A)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_a_step_may_round_and_return_any_floats(dtype):
    class Rounding(Inpainter):
        def step(self, view, context, state):
            completed = CompletedView(
                view, (view.rgb + 0.001).to(dtype), view.mask.to(dtype), view.mask.to(dtype)
            )
            return completed, state

    stream = Stream(Rounding(), CONFIG)
    stream.add_frame(photograph(SPARSE, 0))
    completed = stream.view(A).completed
    assert float(completed.rgb.max()) > 0 and {image.dtype for image in completed.images.values()} == {
        torch.float32
    }
    assert draw_mode(completed, "confidence", "ff0000").any(), "NumPy has no bfloat16"


class Learnt(Inpainter):
    """Its colour has a gradient, and it marks all of the view as missing before it looks at it."""

    def __init__(self):
        self.colour = torch.nn.Parameter(torch.tensor(0.5))

    def step(self, view, context, state):
        """Its colour in what is missing."""
        prepared = replace(view, error=torch.ones_like(view.error), mask=torch.ones_like(view.mask))
        return CompletedView(prepared, torch.lerp(view.rgb, self.colour, view.error)), state


@pytest.mark.parametrize("background", ["black", "white"])
def test_a_step_may_change_its_copy_of_the_view_and_need_not_stop_gradients(background):
    """Holes, and what is scored in them, are the renderer's; the past of a viewer is not kept by gradients."""
    stream = Stream(Learnt(), replace(CONFIG, background=background))
    stream.add_frame(photograph(SPARSE))
    made, rendered = stream.view(A).completed, stream.render(A)
    assert bool(rendered.holes.any()) and torch.equal(made.view.holes, rendered.holes)
    assert torch.equal(made.view.error, rendered.error) and torch.equal(made.view.rgb, rendered.rgb)
    assert not made.rgb.requires_grad


def test_a_state_may_be_empty():
    @dataclass(frozen=True)
    class Seen(State):
        times: tuple[int, ...] = ()

        def __len__(self):
            return len(self.times)

    given = []

    class Own(Inpainter):
        def step(self, view, context, state):
            given.append(state)
            return CompletedView(view, view.rgb), carried

    carried, stream = Seen(), Stream(Own(), CONFIG)
    stream.add_frame(photograph(SPARSE))
    stream.view(A, stream.view(A).viewer)
    assert given[1] is carried


# The context that a stream gives an inpainter: cameras, past frames, and no excluded camera.


class Requester(Inpainter):
    """An inpainter that paints E white and requests `wanted`: (frames back, camera names)."""

    def __init__(self, *wanted):
        self.wanted = wanted
        self.given = {}

    def step(self, view, context, state):
        for back, names in self.wanted:
            self.given[back] = context(view.time - back, names)
        return CompletedView(view, torch.where(view.error > 0, torch.ones_like(view.rgb), view.rgb)), state


def test_a_view_is_rendered_and_completed():
    stream, truth = Stream(Requester(), CONFIG), photograph(A)
    stream.add_frame(photograph(SPARSE, 0))
    completed = stream.view(A).completed
    view, rgb, known = completed.view, completed.rgb, completed.view.error == 0
    assert view.source_views == ("c4", "c7", "c2")
    assert 50 < view.error.sum() < 0.7 * view.mask.sum()
    assert bool((rgb[:, ~known] == 1).all()) and torch.equal(rgb[:, known], view.rgb[:, known])
    right = (view.mask > 0) & known & (truth.mask[0] > 0)
    # A hull from six cameras is off by centimetres, so colours are; another camera's would be off by 0.2.
    assert (rgb - truth.rgb[0] / 255)[:, right].abs().mean() < 0.05


def test_past_frames_are_kept_as_far_back_as_windows_reach():
    requester = Requester(
        (0, ("c4",)), (2, ("c9", "c0")), (WINDOW, ("c1",)), (WINDOW + 1, ("c1",)), (-1, ("c1",))
    )
    stream = Stream(requester, replace(CONFIG, memory_mb=None))
    for time in (0, 1, WINDOW - 1, WINDOW + 1):
        stream.add_frame(photograph(SPARSE, time))
    stream.view(camera_at(165, "t"))
    past = requester.given[2]
    assert past.frame.time == WINDOW - 1 and past.frame.cameras.names == ("c9", "c0")
    assert past.depth.shape == past.frame.rgb[:, 0].shape
    covered = (past.depth > 0) == (past.frame.mask > 127)
    assert covered.float().mean() > 0.97
    assert requester.given[0].frame.time == WINDOW + 1 and requester.given[WINDOW].frame.time == 1
    assert requester.given[WINDOW + 1] is None and requester.given[-1] is None
    assert stream.times == (1, WINDOW - 1, WINDOW + 1)


def test_a_camera_without_an_image_is_not_in_the_context():
    requester = Requester((0, ("c4", "c7")), (1, ("c7",)))
    stream = Stream(requester, CONFIG)
    stream.add_frame(photograph(SPARSE, 0).without(["c7"]))
    stream.add_frame(photograph(SPARSE, 1))
    stream.view(camera_at(165, "t"))
    assert requester.given[0].frame.cameras.names == ("c4", "c7")
    assert requester.given[1] is None


def test_excluded_cameras_reach_neither_renderer_nor_inpainter():
    requester = Requester((0, ("c4", "c7")), (1, ("c4",)))
    stream = Stream(requester, CONFIG)
    stream.add_frame(photograph(SPARSE))
    mended = stream.view(camera_at(120, "t"), exclude=("c4",))
    assert "c4" not in mended.completed.view.source_views + mended.completed.view.candidate_views
    assert requester.given[0].frame.cameras.names == ("c7",)
    assert requester.given[1] is None


def test_a_string_as_exclude_is_refused():
    requester = Requester((0, ("c4",)))
    stream = Stream(requester, CONFIG)
    stream.add_frame(photograph(SPARSE))
    view = stream.render(A)
    for look in (stream.view, stream.render, lambda _, exclude: stream.mend(view, exclude=exclude)):
        with pytest.raises(
            ValueError, match=r"exclude as a list of names, got the string 'c4'; write \['c4'\]"
        ):
            look(A, exclude="c4")
    assert not requester.given


def test_a_camera_that_has_no_image_in_this_frame_may_be_excluded():
    stream = Stream(Requester((0, ("c4", "c7"))), CONFIG)
    for time in range(2):
        stream.add_frame(photograph(SPARSE, time).without(["c4"] * time))
    assert stream.view(A, exclude=("c4",)).completed.view.time == 1


def test_viewers_share_the_depth_of_the_cameras(monkeypatch):
    rendered, own = [], GeometryProxy.depth
    monkeypatch.setattr(GeometryProxy, "depth", lambda self, at: rendered.extend(at.names) or own(self, at))
    stream = Stream(Requester((0, ("c0", "c1", "c2"))), CONFIG)
    stream.add_frame(photograph(SPARSE))
    for angle in (30, 32, 65):
        stream.view(camera_at(angle, "t"))
    assert sorted(rendered) == ["c0", "c1", "c2", "c4"]


def test_settings_may_be_numbers_of_numpy():
    forged(RenderConfig(), cameras=np.int64(3)).__post_init__()


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: RenderQuality(refine_fraction=-1.0), "refine_fraction from 0 to 1 or None, got -1.0"),
        (lambda: RenderQuality(refine_fraction=2.0), "refine_fraction from 0 to 1 or None, got 2.0"),
        (lambda: RenderConfig(cameras=0), "source cameras, at least 1, got 0"),
        (lambda: RenderConfig(cameras=-1), "source cameras, at least 1, got -1"),
        (forged(RenderConfig(), cameras=2.5).__post_init__, "source cameras, at least 1, got 2.5"),
        (
            forged(StreamConfig(), background="grey").__post_init__,
            "background 'black' or 'white', got 'grey'",
        ),
        (lambda: StreamConfig(memory_mb=-5.0), "memory_mb of 0 or more, or None for no limit, got -5.0"),
        (
            lambda: unwrap(Stream.__init__)(object.__new__(Stream), "views"),
            "expected an inpainter, got 'views'; make one",
        ),
        (
            lambda: unwrap(Stream.__init__)(object.__new__(Stream), Telea),
            "expected an inpainter, got <class .*; make one",
        ),
    ],
)
def test_settings_out_of_range_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_target_is_one_camera():
    stream = Stream(Telea(), CONFIG)
    stream.add_frame(photograph(SPARSE))
    for look in (stream.view, stream.render):
        with pytest.raises(ValueError, match="expected the camera of one view, got 6; choose one"):
            look(SPARSE)


class Wall:
    """A geometry of which `change` changes the depth."""

    def __init__(self, change):
        self.change = change

    def depth(self, cameras):
        return self.change(photograph(cameras).depth)


@pytest.mark.parametrize(
    "change, message",
    [
        (
            lambda depth: torch.where(depth > 0, depth, torch.inf),
            "expected finite numbers in {}, .*; use 0 where",
        ),
        (
            lambda depth: torch.where(depth > 0, depth, torch.nan),
            "expected finite numbers in {}, .*; use 0 where",
        ),
        (lambda depth: depth - 1, r"expected {} in \[0, inf\], got values from -1 to .*; use 0 where"),
        (
            lambda depth: (1000 * depth).int(),
            r"expected {} as torch.float32, got torch.int32; .*\(\), in metres",
        ),
        (
            lambda depth: depth.half(),
            r"expected {} as torch.float32, got torch.float16; convert it with \.float\(\)",
        ),
        (
            lambda depth: depth[:, :40],
            r"expected {} of shape \(2, 48, 48\) or larger images, got \(2, 40, 48\)",
        ),
        (
            lambda depth: depth[:, None],
            r"expected {} of shape .*, got \(2, 1, 48, 48\); give one image per camera",
        ),
        (lambda depth: depth[:1], r"expected {} of shape .*, got \(1, 48, 48\); give one image per camera"),
        (
            lambda depth: depth.numpy(),
            "expected {} as a tensor, got ndarray; convert it with torch.as_tensor",
        ),
    ],
)
def test_a_wrong_depth_of_a_provider_is_refused(change, message):
    cached = Stream(Telea(), CONFIG).add_frame(photograph(SPARSE), Wall(change))
    for look in (cached.context, cached.depth):
        with pytest.raises(ValueError, match=message.format("the depth of Wall")):
            look(("c0", "c4"))


def test_a_providers_images_may_be_padded():
    cached = Stream(Telea(), CONFIG).add_frame(
        photograph(SPARSE), Wall(lambda depth: torch.nn.functional.pad(depth, (0, 9)))
    )
    assert torch.equal(cached.depth(("c4",)), photograph(SPARSE).depth[3:4])


@pytest.mark.parametrize(
    "geometry", [photograph(SPARSE).depth, lambda cameras: None, Wall, photograph(SPARSE)]
)
def test_a_geometry_that_provides_no_depth_is_refused(geometry):
    add_frame = unwrap(Stream.add_frame)  # without the checks of types
    with pytest.raises(
        ValueError, match=r"expected a geometry with a method depth\(cameras\), got .*; pass an object"
    ):
        add_frame(Stream(Telea(), CONFIG), photograph(SPARSE), geometry)


def test_a_frame_of_another_stream_is_adopted_with_all_that_was_computed(model, encoded):
    first = Stream(model, CONFIG)
    cached = first.add_frame(photograph(SPARSE, 0))
    expected = first.view(A).completed.rgb
    other = Stream(model, CONFIG)
    known = set(encoded)
    encoded.clear()
    own = other.adopt(cached)
    assert other.times == (0,) and own is not cached and own.proxy is cached.proxy
    assert all(own.depths[name] is depth for name, depth in cached.depths.items())
    assert torch.equal(other.view(A).completed.rgb, expected) and known and not encoded
    # What is computed later belongs to one stream alone.
    other.view(camera_at(320, "d"))
    assert own.depths.keys() > cached.depths.keys()


def test_a_frame_that_is_cached_takes_over_what_it_lacks(model):
    first = Stream(model, CONFIG)
    second = Stream(model, CONFIG)
    cached = first.add_frame(photograph(SPARSE, 0))
    own = second.add_frame(photograph(SPARSE, 0))
    own.depth(["c0"])
    cached.depth(["c0", "c1"])
    before = own.depths["c0"]
    assert (
        second.adopt(cached) is own and own.depths["c0"] is before and own.depths["c1"] is cached.depths["c1"]
    )


def test_models_of_different_weights_share_a_memory(model):
    """Each finds its own encodings there, whatever their size: in one memory, and in frames that are adopted."""
    torch.manual_seed(1)
    twin = PatchTransformer(model.config).eval()
    wide = PatchTransformer(replace(model.config, dim=128)).eval()
    first = Stream(model, CONFIG)
    cached = first.add_frame(photograph(SPARSE, 0))
    first.view(A)
    for other in (twin, wide):
        alone = Stream(other, CONFIG)
        alone.add_frame(photograph(SPARSE, 0))
        sharing = Stream(other, CONFIG)
        sharing.adopt(cached)
        assert torch.equal(sharing.view(A).completed.rgb, alone.view(A).completed.rgb)


def test_changed_weights_get_new_encodings(model):
    changed = copy.deepcopy(model)
    before = changed.encoding_kind
    assert before == model.encoding_kind
    with torch.no_grad():
        changed.tokeniser.linear.bias += 1
    assert changed.encoding_kind != before


def test_the_default_memory_holds_the_window_at_512_pixels_and_8_cameras():
    """Of `paper-small`, with the depths and encodings of all cameras, as a moving viewer makes them."""
    torch.manual_seed(0)
    inpainter = PatchTransformer(paper_small()).eval()
    frame = Studio(StudioConfig(cameras=8, frames=1, size_px=512)).read(0)
    stream = Stream(inpainter, StreamConfig(hull=CONFIG.hull))
    cached = stream.add_frame(frame)
    views = cached.context(frame.cameras.names)
    inpainter.encode_cameras(views, stream.context_provider())
    reached = 100 - min(window_times(100, inpainter.config))
    assert inpainter.window_frames == reached == 30
    assert len(cached.depths) == len(cached.encoded) == 8
    assert (1 + reached) * cached.size < 1e6 * StreamConfig().memory_mb


def test_frames_of_the_window_are_dropped_last_and_once_with_a_warning(model, caplog):
    """The window of `model` reaches back two frames."""
    alone = Stream(model, CONFIG)
    walk(alone, [0], A)
    size_mb = 1e-6 * alone.cached_frame().size
    enough = Stream(model, replace(CONFIG, memory_mb=3.5 * size_mb))
    walk(enough, range(5), A)
    enough.view(A, time=2)
    walk(enough, [5], A)
    assert enough.times == (3, 4, 5) and not caplog.records
    short = Stream(model, replace(CONFIG, memory_mb=2.5 * size_mb))
    walk(short, range(5), A)
    assert short.times == (3, 4)
    (record,) = caplog.records
    assert "raise StreamConfig.memory_mb" in record.getMessage() and "2 frames" in record.getMessage()


@pytest.mark.parametrize("window_frames", [0, 2 * WINDOW])
def test_without_a_limit_frames_beyond_any_window_are_dropped_in_both_directions(window_frames):
    """An orbit may play a motion backwards."""
    inpainter = Telea()
    inpainter.window_frames = window_frames
    stream = Stream(inpainter, replace(CONFIG, memory_mb=None))
    frame = photograph(SPARSE)
    reach = max(WINDOW, window_frames)
    kept = []
    for time in (*range(0, 3 * WINDOW, 10), *reversed(range(0, 3 * WINDOW, 10))):
        stream.add_frame(replace(frame, time=time), Sensors())
        kept.append(time - stream.times[0])
        assert all(abs(other - time) <= reach for other in stream.times)
        assert time in stream.times
    assert max(kept) == reach // 10 * 10


def test_a_mask_is_predicted_whatever_the_view_attenuates():
    shown = []

    class Shown(Telea):
        predicts_errors = True

        def step(self, view, context, state):
            shown.append(view.fade)
            return super().step(view, context, state)

    stream = Stream(Telea(), replace(CONFIG, predict_mask=True), error_model=Shown())
    stream.add_frame(photograph(SPARSE))
    view = stream.render(A)
    expected = stream.predict_mask(view)
    assert torch.equal(stream.predict_mask(replace(view, fade=0.9 * view.mask)), expected)
    assert shown == [None, None]
