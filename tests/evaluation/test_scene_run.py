"""One scene through several methods: truth, history and background of each frame."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import pytest
import torch

from viewmend.contrib.baselines.online import OnlineConfig, OnlineInpainter
from viewmend.evaluation import scene_run
from viewmend.evaluation.scene_run import RunSettings, evaluate_scene
from viewmend.fused_geometry import FusedFrame
from viewmend.geometry.fusion import FusionConfig
from viewmend.models.base import ContextProvider, State
from viewmend.models.checkpoint import build
from viewmend.models.classical import Telea
from viewmend.models.compositing import composite
from viewmend.models.paper.config import paper_small
from viewmend.models.paper.context import window_times
from viewmend.scenes.held_out import LeaveOneOutScene
from viewmend.scenes.studio_scenes import lengthen, procedural_set, turning_set
from viewmend.stream import Stream, StreamConfig


@pytest.fixture
def scored(monkeypatch):
    """The arguments of each call of `score_view`."""
    calls, score = [], scene_run.score_view
    monkeypatch.setattr(scene_run, "score_view", lambda *given: (calls.append(given), score(*given))[1])
    return calls


def test_each_frame_is_compared_with_its_truth_and_the_previous_frame(small_scenes, scored):
    scene = replace(small_scenes[0], config=replace(small_scenes[0].config, frames=3))
    assert evaluate_scene(scene, ("nearest",), RunSettings()).runs[0].error is None
    assert len(scored) == 3 and scored[0][3] is None
    for (completed, truth, *_), (*_, previous) in pairwise(scored):
        assert torch.equal(previous.truth, truth.rgb) and torch.equal(previous.rgb, completed.rgb)
    assert [completed.view.time for completed, *_ in scored] == [0, 1, 2]


@dataclass(frozen=True, kw_only=True)
class Precomputed(LeaveOneOutScene):
    """A scene whose frames are given."""

    made: list
    definition = "precomputed"

    def frames(self):
        yield from self.made


@pytest.fixture(scope="module")
def turning() -> Precomputed:
    """A turning person, three cameras besides the held-out one, and five frames, of which the last two are scored."""
    scene = turning_set(64)[3]
    config = replace(scene.config, cameras=4, frames=5, samples_per_side=1, fps=6)
    scene = replace(scene, config=config, held="cam00", scored_from=3)
    kind = {name: getattr(scene, name) for name in ("name", "set", "rig", "style", "held", "scored_from")}
    return Precomputed(made=list(scene.frames()), **kind)


def test_fused_geometry_follows_the_last_frame(small_scenes, monkeypatch):
    surfaces = []
    find = FusedFrame.surface_for

    def surface_for(last, frame):
        surfaces.append((last.cached.frame.time, frame.time, find(last, frame)))
        return surfaces[-1][2]

    monkeypatch.setattr(FusedFrame, "surface_for", surface_for)
    fusion = FusionConfig(resolution=32, max_views=5, view_px=48)
    settings = RunSettings(stream=StreamConfig(geometry="fused", fusion=fusion, memory_mb=None))
    assert evaluate_scene(small_scenes[0], ("nearest",), settings).runs[0].error is None
    ((last, now, surface),) = surfaces
    assert (last, now) == (0, 1)
    assert surface is not None


def test_a_scene_without_frames_fails(turning):
    run = evaluate_scene(replace(turning, made=[]), ("telea",), RunSettings()).runs[0]
    assert run.error.endswith(
        "expected frames with a subject and an image of the held-out camera, got none; evaluate more frames"
    )


def test_long_sets_are_the_same_scenes_with_a_full_window_before_the_scored_frames():
    short, long = procedural_set(), lengthen(procedural_set())
    assert [s.name for s in long[:2]] == ["P-long-10000", "P-long-10001"] and {s.set for s in long} == {
        "P-long"
    }
    for one, other in zip(short, long, strict=True):
        assert replace(other.config, frames=one.config.frames) == one.config and other.held == one.held
        assert len(window_times(other.scored_from, paper_small())) == 7
        assert other.config.frames - other.scored_from == 10 and one.definition != other.definition
    assert len(turning_set()) == 24 and {s.config.frames for s in turning_set()} == {41}


def test_surface_visible_only_in_the_past_is_known(turning):
    frames = list(turning.frames())
    assert [f.seen is not None for f in frames] == [False, False, False, True, True]
    last = frames[-1]
    names = last.inputs.cameras.names
    assert last.seen.names == names and last.seen.seen.shape[0] == 4, "this frame, and three before"
    alone = last.seen.origins(names).past
    surface = last.truth.depth[0] > 0
    assert 0 < int(alone.sum()) < int(surface.sum()) and not (alone & ~surface).any()
    assert torch.equal(alone, last.seen.seen[1:].any((0, 1)) & ~last.seen.seen[0].any(0))
    assert not replace(last.seen, seen=last.seen.seen[[0, 0]]).origins(names).past.any(), "nothing moved"


def test_each_pixel_of_the_surface_has_one_origin(turning):
    last = list(turning.frames())[-1]
    source, *rest = last.inputs.cameras.names
    found = last.seen.origins([source])
    seen = last.seen.seen
    height, width = seen.shape[2:]
    for row in range(0, height, 3):
        for column in range(0, width, 3):
            point = seen[:, :, row, column]
            now = {name for name, by in zip(last.seen.names, point[0].tolist(), strict=True) if by}
            before = bool(point[1:, last.seen.names.index(source)].any())
            expected = (source in now, source not in now and bool(now & set(rest)), before and not now)
            here = (found.sources, found.others, found.past)
            assert tuple(bool(mask[row, column]) for mask in here) == expected
            assert bool(found.sources_past[row, column]) == (before and source not in now)
    assert all(bool(mask.any()) for mask in (found.sources, found.others))


class Counts(Telea):
    """Telea that counts its steps and the past frames that it could encode."""

    steps, past = 0, 0

    def step(self, view, context, state):
        type(self).steps += 1
        return super().step(view, context, state)

    def encode_history(self, view, context):
        type(self).past += sum(context(time, view.source_views) is not None for time in range(view.time))


class Stateful(Counts):
    def initial_state(self):
        return OwnState()


class OwnState(State):
    pass


@pytest.mark.parametrize(("kind", "steps"), [(Counts, 3), (Stateful, 6)])
def test_only_stateful_methods_run_on_frames_that_are_not_scored(turning, monkeypatch, kind, steps):
    kind.steps = kind.past = 0
    monkeypatch.setattr(scene_run, "make_method", lambda name, *how: kind())
    run = evaluate_scene(turning, ("telea",), RunSettings()).runs[0]
    assert run.error is None and [f.time for f in run.frames] == [3, 4]
    assert kind.steps == steps, "the first scored frame is computed twice"
    assert kind.past == 3 + 3 + 4, "the whole past can be encoded"
    assert all(f.past_px > 0 for f in run.frames)


def test_a_scored_view_is_what_a_stream_of_all_frames_gives(turning, monkeypatch):
    torch.manual_seed(0)
    net = build(replace(paper_small(), widths=(8,) * 9, dim=32, heads=2, blocks=1, n_w=1, k_w=4)).eval()
    monkeypatch.setattr(scene_run, "make_method", lambda name, *how: net)
    scenes = turning, replace(turning, scored_from=0)
    late, every = (evaluate_scene(scene, ("x",), RunSettings(background="white")).runs[0] for scene in scenes)
    assert late.error is None and every.error is None
    for one, other in zip(late.frames, every.frames[-2:], strict=True):
        assert one.hole_px == other.hole_px and one.psnr_holes == pytest.approx(other.psnr_holes, abs=1e-3)


class Mean:
    """A network that fills with the mean of its input, and records the number of past frames."""

    def __init__(self):
        self.past = []

    def check_size(self, height, width):
        pass

    def complete_clip(self, clip):
        self.past.append(len(clip.neighbours))
        mean = torch.stack([frames[0] for frames in (clip.now, *clip.neighbours)]).mean((0, 2, 3))
        return mean[:, None, None].expand(3, 48, 48)


@pytest.mark.parametrize("background", ["black", "white"])
def test_a_network_whose_state_is_its_input_runs_on_scored_frames_only(turning, monkeypatch, background):
    def run(scene):
        network = Mean()
        inpainter = OnlineInpainter(network, OnlineConfig(size_px=(48, 48)))
        monkeypatch.setattr(scene_run, "make_method", lambda name, *how: inpainter)
        done = evaluate_scene(scene, ("x",), RunSettings(background=background)).runs[0]
        assert done.error is None
        return done.frames, network.past

    late, past = run(turning)
    assert past == [3, 3, 3], "of two scored frames; the first is computed twice"
    every, past = run(replace(turning, scored_from=0))
    assert past == [0, 0, 1, 2, 3, 3]
    for one, other in zip(late, every[-2:], strict=True):
        assert one.psnr_holes == other.psnr_holes and one.psnr_whole == other.psnr_whole


class LooksBack(Telea):
    """Remembers the true images that are revealed."""

    truths: ClassVar[list] = []

    def initial_state(self):
        return OwnState()

    def reveal_truth(self, state, truth):
        self.truths.append(truth)
        return state


def test_the_truth_of_past_frames_is_revealed(small_scenes, scored, monkeypatch):
    monkeypatch.setattr(scene_run, "make_method", lambda name, *how: LooksBack())
    evaluate_scene(small_scenes[0], ("x",), RunSettings())
    assert len(LooksBack.truths) == 2
    assert all(torch.equal(truth, call[1].rgb) for truth, call in zip(LooksBack.truths, scored, strict=True))


def test_classical_fills_get_white_views_and_keep_known_pixels(small_scenes):
    frame = next(small_scenes[0].frames())
    stream = Stream(Telea())
    stream.add_frame(frame.inputs)
    view, nothing = stream.render(frame.truth.cameras), ContextProvider(lambda *_: None)
    done, _ = Telea().step_on("white", view, nothing, State())
    holes = view.error > 0
    assert holes.sum() > 50 and torch.equal(done.rgb[:, ~holes], view.rgb[:, ~holes])
    white = replace(view, rgb=torch.where(view.mask > 0, view.rgb, 1.0))
    expected = Telea().step(white, nothing, State())[0].rgb
    torch.testing.assert_close(composite("white", done.rgb, done.opacity), expected)
    assert (expected[:, holes].mean() - Telea().step(view, nothing, State())[0].rgb[:, holes].mean()) > 0.02


def test_a_predicted_mask_is_given_to_all_methods(small_scenes, scored):
    scene = replace(small_scenes[0], config=replace(small_scenes[0].config, frames=1))
    run = evaluate_scene(scene, ("telea", "nearest"), RunSettings(protocol="predicted-mask"))
    assert [one.error for one in run.runs] == [None, None]
    masks = [completed.view.target_mask for completed, *_ in scored]
    assert torch.equal(masks[0], masks[1]) and 0 < float(masks[0].mean()) < 1
    truth = scored[0][1].mask
    overlap = ((masks[0] > 0.5) & truth).sum() / ((masks[0] > 0.5) | truth).sum()
    assert float(overlap) > 0.8


def test_the_number_of_kept_tokens_reaches_the_model(small_scenes):
    class Asked(Telea):
        top_k: ClassVar[list[int | None]] = []

        def step(self, view, context, state):
            self.top_k.append(context.quality.top_k)
            return super().step(view, context, state)

    scene = replace(small_scenes[0], config=replace(small_scenes[0].config, frames=1))
    for top_k in (None, 64):
        Asked.top_k.clear()
        run = evaluate_scene(scene, ("asked",), RunSettings(top_k=top_k), {"asked": Asked()})
        assert run.runs[0].error is None and set(Asked.top_k) == {top_k}
