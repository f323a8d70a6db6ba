"""Sets with a whole past: what is scored, what is not made, and what only the past shows."""

from dataclasses import dataclass, replace

import pytest
import torch

from viewmend.baselines.classical import Telea
from viewmend.baselines.online import OnlineConfig, OnlineInpainter
from viewmend.evaluation import scene_run
from viewmend.evaluation.records import records
from viewmend.evaluation.scene_run import RunSettings, evaluate_scene
from viewmend.inpainting.chain import build
from viewmend.inpainting.config import paper_small
from viewmend.inpainting.context import window_times
from viewmend.inpainting.protocol import State
from viewmend.leave_one_out.scenes import LeaveOneOutScene
from viewmend.leave_one_out.studio_scenes import lengthened, procedural_set, turning_set


@dataclass(frozen=True, kw_only=True)
class Remembered(LeaveOneOutScene):
    """Frames that were made once."""

    made: list
    definition = "remembered"

    def frames(self, device):
        yield from self.made


@pytest.fixture(scope="module")
def turning() -> Remembered:
    """A turning person and three cameras beside the one that is left out, five frames, of which the last two count."""
    scene = turning_set(64)[3]
    config = replace(scene.config, cameras=4, frames=5, samples_per_side=1, fps=6)
    scene = replace(scene, config=config, held="cam00", scored_from=3)
    kind = {name: getattr(scene, name) for name in ("name", "set", "rig", "style", "held", "scored_from")}
    return Remembered(made=list(scene.frames("cpu")), **kind)


def test_long_sets_are_the_same_scenes_and_the_first_that_is_scored_has_a_whole_window():
    short, long = procedural_set(), lengthened(procedural_set())
    assert [s.name for s in long[:2]] == ["P-long-10000", "P-long-10001"] and {s.set for s in long} == {"P-long"}
    for one, other in zip(short, long, strict=True):
        assert replace(other.config, frames=one.config.frames) == one.config and other.held == one.held
        assert len(window_times(other.scored_from, paper_small())) == 7
        assert other.config.frames - other.scored_from == 10 and one.definition != other.definition
    assert len(turning_set()) == 24 and {s.config.frames for s in turning_set()} == {41}


def test_only_the_past_shows_what_turned_away(turning):
    frames = list(turning.frames("cpu"))
    assert [f.seen is not None for f in frames] == [False, False, False, True, True]
    last = frames[-1]
    names = last.inputs.cameras.names
    assert last.seen.names == names and last.seen.seen.shape[0] == 4, "now, and three frames before"
    alone = last.seen.by_past_alone(names)
    surface = last.truth.depth[0] > 0
    assert 0 < int(alone.sum()) < int(surface.sum()) and not (alone & ~surface).any()
    assert torch.equal(alone, last.seen.seen[1:].any((0, 1)) & ~last.seen.seen[0].any(0))
    assert not replace(last.seen, seen=last.seen.seen[[0, 0]]).by_past_alone(names).any(), "nothing moved"


class Counts(Telea):
    """Telea, and how often it was asked."""

    steps, past = 0, 0

    def step(self, view, context, state):
        type(self).steps += 1
        return super().step(view, context, state)

    def encode_past(self, view, context):
        type(self).past += sum(context(time, view.source_views) is not None for time in range(view.time))


class Carries(Counts):
    """The same, with something to remember."""

    def initial_state(self):
        return Carried()


class Carried(State):
    pass


@pytest.mark.parametrize(("kind", "steps"), [(Counts, 3), (Carries, 6)])
def test_frames_before_cost_what_a_context_needs_and_carriers_see_them_all(turning, monkeypatch, kind, steps):
    kind.steps = kind.past = 0
    monkeypatch.setattr(scene_run, "make_method", lambda name, *how: kind())
    run = evaluate_scene(turning, ("telea",), RunSettings()).runs[0]
    assert run.error is None and [f.time for f in run.frames] == [3, 4]
    assert kind.steps == steps, "the first that is scored is done twice"
    assert kind.past == 3 + 3 + 4, "the whole past is there"
    assert all(f.past_px > 0 for f in run.frames)


def test_a_scored_view_is_what_a_stream_of_all_frames_gives(turning, monkeypatch):
    """The window is whole, though nothing was mended before."""
    torch.manual_seed(0)
    net = build(replace(paper_small(), widths=(8,) * 9, dim=32, heads=2, blocks=1, n_w=1, k_w=4)).eval()
    monkeypatch.setattr(scene_run, "make_method", lambda name, *how: net)
    late = evaluate_scene(turning, ("x",), RunSettings(background="white")).runs[0]
    whole = replace(turning, scored_from=0)
    every = evaluate_scene(whole, ("x",), RunSettings(background="white")).runs[0]
    assert late.error is None and every.error is None
    for one, other in zip(late.frames, every.frames[-2:], strict=True):
        assert one.hole_px == other.hole_px and one.psnr_holes == pytest.approx(other.psnr_holes, abs=1e-3)


class Mean:
    """A network that fills with the mean of all that it is shown, and writes down how many frames before that were."""

    def __init__(self):
        self.before = []

    def check_size(self, height, width):
        pass

    def complete_clip(self, clip):
        self.before.append(len(clip.neighbours))
        mean = torch.stack([frames[0] for frames in (clip.now, *clip.neighbours)]).mean((0, 2, 3))
        return mean[:, None, None].expand(3, 48, 48)

    def complete_remembering(self, now, memory):
        raise AssertionError("O remembers nothing")


@pytest.mark.parametrize("background", ["black", "white"])
def test_a_network_that_keeps_views_alone_is_run_for_scored_ones_alone(turning, monkeypatch, background):
    def run(scene):
        network = Mean()
        inpainter = OnlineInpainter(network, OnlineConfig(size_px=(48, 48)))
        monkeypatch.setattr(scene_run, "make_method", lambda name, *how: inpainter)
        done = evaluate_scene(scene, ("x",), RunSettings(background=background)).runs[0]
        assert done.error is None
        return done.frames, network.before

    late, before = run(turning)
    assert before == [3, 3, 3], "of two scored times; the first is done twice"
    every, before = run(replace(turning, scored_from=0))
    assert before == [0, 0, 1, 2, 3, 3]
    for one, other in zip(late, every[-2:], strict=True):
        assert one.psnr_holes == other.psnr_holes and one.psnr_whole == other.psnr_whole


def test_the_region_has_its_own_mean(make_cell, make_frame):
    frames = [make_frame(psnr_past=20.0, past_px=60), make_frame(psnr_past=10.0, past_px=3)]
    scores = records([make_cell("s", "telea", "P-turn", frames)])
    assert scores.mean("psnr", "past") == 20.0
    assert scores.mean("hole_fraction", "only_past") == pytest.approx((1 + 0.05) / 2)
