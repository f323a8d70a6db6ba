"""Stored scenes give the samples that they were made of; windows of them teach every weight of the reader."""

import json
from dataclasses import replace
from random import Random

import pytest
import torch

from viewmend.cli import main
from viewmend.geometry.cameras import project, unproject
from viewmend.inpainting.checkpoint import load_network, save_inpainter
from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.inpainting.sweep.cells import nearest_depth, rim_depth
from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.leave_one_out.scenes import LeaveOneOut
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.loop import train
from viewmend.training.plan import DataPlan, ViewLossWeights, WholeViewRecipe
from viewmend.training.sample_files import ShardError, StoredShards, sample_from_bytes, sample_to_bytes, write_shards
from viewmend.training.scenes import StudioScenes
from viewmend.training.stored_scenes import StoredSamples, StudioStore, store
from viewmend.training.whole_view_objective import WholeViewObjective, _visible
from viewmend.training.whole_view_run import WholeViewRun
from viewmend.training.whole_views import (
    WINDOW_PX,
    WholeView,
    WholeViewScenes,
    random_part,
    random_window,
    recoloured,
    untrained,
)

PLAN = DataPlan(sizes_px=(96,), cameras=(5, 6), times=(0,), held_cameras=2, ray_views=4, hull_resolution=48)
MODEL = SweepConfig(num_views=4, width=8, place_channels=4, features=8, fine_features=8, error_features=8)
RULE = RenderConfig(error_rule="all")


@pytest.fixture(scope="module")
def studio():
    return Studio(StudioConfig(seed=3, cameras=6, frames=1, size_px=(160, 149)))


@pytest.fixture(scope="module")
def stored(studio):
    def truth(held, time):
        return studio.truth(studio.true_cameras.select([held]), time)

    rig = LeaveOneOut({0: studio.read(0)}, true_view=truth)
    return store(rig, 0, replace(PLAN, held_cameras=6), Random(0))


@pytest.fixture(scope="module")
def whole(stored):
    return WholeView.of(stored.sample(0, RULE, 4), SweepNet(MODEL))


@pytest.fixture(scope="session")
def view_shards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view-shards")
    scenes = StudioStore(StudioScenes(PLAN, "tests"))
    list(write_shards((scenes.scene(number)[0] for number in range(3)), folder, per_shard=2))
    return folder


def test_a_stored_scene_is_the_rig_without_a_camera(studio, stored):
    frame = studio.read(0)
    assert sorted(view.name for view in stored.held) == sorted(frame.cameras.names)
    assert len(sample_to_bytes(stored)) < 0.3 * frame.rgb.numel() * len(stored.held)
    again = sample_from_bytes(sample_to_bytes(stored))
    for number in (0, 3):
        name = stored.held[number].name
        stream = Stream(SweepNet(MODEL), StreamConfig(render=RULE, memory_mb=None))
        stream.push(frame.without([name]), None)
        wanted = stream.render(frame.cameras.select([name]))
        sample = again.sample(number, RULE, 4)
        view = sample.view
        assert name not in view.candidate_views and view.source_views == wanted.source_views
        # The hull is carved more coarsely, and its vertices are in steps.
        both = (view.mask > 0) & (wanted.mask > 0)
        assert float(both.sum() / ((view.mask > 0) | (wanted.mask > 0)).sum()) > 0.93
        assert float((view.rgb - wanted.rgb).abs()[:, both].median()) < 0.02
        true = studio.truth(studio.true_cameras.select([name]), 0)
        assert torch.equal(sample.alpha, true.mask[0])
        assert float((sample.depth - true.depth[0]).abs().max()) < 1e-4
        black = (true.rgb[0] * (true.mask[0] / 255)).round()
        assert float((sample.truth - black).abs().max()) <= 1
        seen = sample.ray_views.frame
        assert seen.cameras.names == view.closest_views(4)
        own = frame.select(seen.cameras.names)
        inside = own.mask > 0
        assert torch.equal(seen.mask, own.mask)
        assert torch.equal(seen.rgb.movedim(1, -1)[inside], own.rgb.movedim(1, -1)[inside])
        both = (seen.depth > 0) & (own.depth > 0)
        assert float((seen.depth - own.depth)[both].abs().median()) < 0.01, "of every second pixel"


def test_a_window_is_a_part_of_the_view_and_of_its_truth(whole):
    torch.manual_seed(1)
    cameras = set()
    for _ in range(30):
        window = random_window(whole)
        height, width = window.view.mask.shape
        assert height <= WINDOW_PX and width <= WINDOW_PX and int((window.view.mask > 0).sum()) > 0
        assert window.truth.shape[1:] == window.alpha.shape == window.depth.shape == (height, width)
        assert window.scale == whole.scale
        names = window.rig.views.frame.cameras.names
        assert names == whole.rig.views.frame.cameras.names[: len(names)] and len(window.rig.pyramids) == len(names)
        cameras.add(len(names))
        # The camera of the window sees the same points at the same places.
        at = torch.tensor([[[width / 2, height / 2]]])
        point = unproject(at, torch.tensor([[2.0]]), window.view.camera)[0]
        uv, _ = project(point, whole.view.camera)
        left, top = (uv[0, 0] - at[0, 0]).round().int().tolist()
        assert torch.equal(whole.truth[:, top : top + height, left : left + width], window.truth)
        assert torch.equal(whole.view.rgb[:, top : top + height, left : left + width], window.view.rgb)
    assert cameras == {4}, "four are all that there are"


def test_a_part_to_be_read_lies_in_the_subject(whole):
    torch.manual_seed(0)
    parts = [random_part(whole) for _ in range(40)]
    read = [part for part in parts if part is not None]
    assert 4 < len(read) < 24
    assert all(bool((rim_depth(whole.view.depth)[part] > 0).all()) for part in read)
    assert all(bool(part[whole.view.holes].all()) for part in read), "what is missing is always read"


def test_other_colours_are_those_of_cameras_view_and_truth_alike(stored):
    sample = stored.sample(0, RULE, 4)
    other = recoloured(sample, Random(2))
    gains = []
    for before, after in (
        (sample.view.rgb, other.view.rgb),
        (sample.truth / 255, other.truth / 255),
        (sample.ray_views.frame.rgb[0] / 255, other.ray_views.frame.rgb[0] / 255),
    ):
        means, changed = before.mean((1, 2)).sort().values, after.mean((1, 2)).sort().values
        gains.append(changed / means)
    assert 0.55 < float(gains[0].mean()) < 1
    for gain in gains[1:]:
        torch.testing.assert_close(gain, gains[0], atol=0.02, rtol=0)


def test_who_sees_the_surface_is_known(whole, studio):
    """Points of the true surface project to about their own depth in a camera that sees them."""
    torch.manual_seed(0)
    net = SweepNet(MODEL)
    with torch.no_grad():
        reading = net(whole.view, whole.rig, whole.scale)
    cells = tuple(reading.swept.cells.T)
    z = nearest_depth(whole.depth)[cells]
    seen = _visible(whole, reading, z)
    assert seen.shape == (len(z), 4) and 0.2 < float(seen[z > 0].float().mean()) < 0.95
    assert not bool(seen[z == 0].any())
    # The camera closest in angle sees most, and moving the surface away hides it.
    assert float(seen[:, 0].float().mean()) >= float(seen[:, 3].float().mean()) - 0.05
    behind = _visible(whole, reading, z + 0.3 * whole.scale.size_m)
    assert int(behind.sum()) < 0.3 * int(seen.sum())


@pytest.mark.parametrize(
    "term", ["colour", "log_error", "gradient", "cell_colour", "alpha", "place", "visible", "errors"]
)
def test_each_term_alone_can_be_learned(whole, term):
    """A few steps on one view lower it."""
    torch.manual_seed(0)
    weights = ViewLossWeights(**dict.fromkeys(vars(ViewLossWeights()), 0.0) | {term: 1.0})
    net = SweepNet(MODEL)
    objective, rate = WholeViewObjective(net, weights), torch.optim.Adam(net.parameters(), 3e-3)
    losses = []
    for _ in range(24):
        torch.manual_seed(5)
        rate.zero_grad()
        loss = objective([whole]).total
        loss.backward()
        rate.step()
        losses.append(float(loss.detach()))
    assert min(losses) < losses[0] - 0.02 * abs(losses[0]), losses


def test_every_weight_learns(whole):
    torch.manual_seed(0)
    net = SweepNet(MODEL)
    output = WholeViewObjective(net, ViewLossWeights())([whole, whole])
    output.total.backward()
    still = [name for name, p in net.named_parameters() if p.grad is None or float(p.grad.abs().sum()) == 0]
    assert still == []
    assert float(output.image.outside) > 0 and float(output.image.log_error) < 0


def test_holes_are_guessed_by_the_reader_of_rays_of_another_model(stored, tmp_path):
    """Its weights come from the checkpoint that is named, are not trained, and fill the whole view, not its windows."""
    recipe = WholeViewRecipe(name="views", model=replace(MODEL, num_views=8, coarse_fill="rays"), steps=1)
    net, small = untrained(replace(recipe, bfloat16=False)), load_network("small")
    assert torch.equal(net.coarse.choose.weight, small.coarse.choose.weight)
    assert not any(weight.requires_grad for weight in net.coarse.parameters())
    assert all(weight.requires_grad for name, weight in net.named_parameters() if not name.startswith("coarse."))
    sample = stored.sample(0, RULE, 4)
    whole = WholeView.of(sample, net)
    holes = whole.view.holes
    assert int(holes.sum()) > 30 and torch.equal(whole.guess[:, ~holes], whole.view.rgb[:, ~holes])
    wanted = small.coarse([replace(whole.view, error=holes.float())], [sample.ray_views])[0]
    torch.testing.assert_close(whole.guess, wanted, atol=1e-5, rtol=0)
    torch.manual_seed(3)
    window = random_window(whole)
    height, width = window.guess.shape[1:]
    parts = whole.guess.unfold(1, height, 1).unfold(2, width, 1)
    assert bool((parts == window.guess[:, None, None]).all(-1).all(-1).all(0).any())
    save_inpainter(SweepNet(MODEL), tmp_path, "")
    with pytest.raises(ValueError, match="with a RayBlendNet"):
        untrained(replace(recipe, coarse_from=str(tmp_path)))


def test_what_is_wrong_can_be_learned_alone(view_shards, tmp_path):
    """The reader stays bit for bit; a model without an `ErrorNet`, or an untrained one, is refused."""
    torch.manual_seed(0)
    data = replace(PLAN, shards=view_shards)
    recipe = WholeViewRecipe(name="views", model=MODEL, data=data, steps=3, workers=0, part="errors", bfloat16=False)
    recipe = replace(recipe, validate_every=0, batch=1, new_per_batch=1, warmup=1)
    start = SweepNet(replace(MODEL, error_features=0))
    with pytest.raises(ValueError, match="a trained reader and an ErrorNet"):
        train(recipe, tmp_path / "none", kind=WholeViewRun)
    trained = load_network(train(recipe, tmp_path / "run", start=start, kind=WholeViewRun))
    assert all(torch.equal(trained.state_dict()[name], weight) for name, weight in start.state_dict().items())
    again = train(replace(recipe, steps=1), tmp_path / "more", start=trained, kind=WholeViewRun)
    moved = load_network(again).errors.tell.weight - trained.errors.tell.weight
    assert 0 < float(moved.detach().abs().max()) < 0.1, "it begins with what there is"


def test_a_reader_of_other_sizes_is_no_beginning(view_shards, tmp_path):
    recipe = WholeViewRecipe(name="views", model=MODEL, data=replace(PLAN, shards=view_shards), steps=1, workers=0)
    with pytest.raises(ValueError, match="of the recipe's sizes"):
        train(recipe, tmp_path, start=SweepNet(replace(MODEL, width=12)), kind=WholeViewRun)


def test_a_run_goes_on_where_it_stopped(view_shards, tmp_path):
    recipe = WholeViewRecipe(
        name="views",
        model=MODEL,
        data=replace(PLAN, shards=view_shards),
        steps=4,
        batch=2,
        new_per_batch=1,
        replay_size=3,
        warmup=1,
        workers=0,
        ema=0.5,
        bfloat16=False,
        checkpoint_every=2,
        validate_every=4,
        validation_views=1,
    )
    once = train(recipe, tmp_path / "once", kind=WholeViewRun)
    train(replace(recipe, steps=2), tmp_path / "twice", kind=WholeViewRun)
    twice = train(recipe, tmp_path / "twice", kind=WholeViewRun)
    lines = [[json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()] for run in (once, twice)]
    scores = next(line["validation"] for line in lines[0] if "validation" in line)
    assert scores["rendered"] > 10 and scores["read"] > 5 and (once / "validation-000004.png").exists()
    costs = [[line["costs"]["total"] for line in run if "costs" in line] for run in lines]
    assert len(costs[0]) == len(costs[1]) == 4 and costs[0][:2] == costs[1][:2]


def test_scenes_are_numbered_through_all_shards(view_shards, tmp_path):
    shards = StoredShards(view_shards, "0")
    scenes = [shards.scene(number) for number in range(4)]
    assert sorted(map(len, scenes)) == [0, 1, 1, 1], "the last shard is short"
    made = {sample_to_bytes(scene[0]) for scene in scenes if scene}
    assert len(made) == 3
    assert {sample_to_bytes(s) for n in range(4, 8) for s in shards.scene(n)} == made
    with pytest.raises(ShardError, match="expected tar files, found none"):
        StoredShards(tmp_path, "0")


def test_a_number_always_gives_the_same_views(view_shards):
    source, other = (
        WholeViewScenes(StoredSamples(StoredShards(view_shards, "0"), PLAN, seed), seed, SweepNet(MODEL))
        for seed in ("0", "1")
    )
    first, again, third = source.scene(1), source.scene(1), other.scene(1)
    assert len(first) == 2
    assert all(
        torch.equal(a.view.rgb, b.view.rgb) and torch.equal(a.truth, b.truth) for a, b in zip(first, again, strict=True)
    )
    assert any(not torch.equal(a.truth, b.truth) for a, b in zip(first, third, strict=True))


def test_some_holes_are_guessed_from_their_surroundings_alone(view_shards):
    """What a live view's budget may leave of the guess is learned, too; colours are the same for all that."""
    net = SweepNet(SweepConfig(num_views=4, width=8, place_channels=4, features=8, fine_features=8, coarse_fill="rays"))

    def guesses(quick):
        shards = StoredSamples(StoredShards(view_shards, "0"), PLAN, "0")
        scenes = WholeViewScenes(shards, "0", net, quick)
        return [own for number in range(1, 4) for own in scenes.scene(number)]

    slow, quick, some = guesses(0.0), guesses(1.0), guesses(0.5)
    assert all(torch.equal(a.truth, b.truth) for a, b in zip(slow, quick, strict=True))
    kinds = set()
    for a, b, own in zip(slow, quick, some, strict=True):
        holes = a.view.holes
        assert torch.equal(a.guess[:, ~holes], b.guess[:, ~holes])
        if bool(holes.any()):
            assert torch.equal(b.guess, SmoothFill()([replace(b.view, error=holes.float())], [None])[0])
            assert not torch.equal(a.guess, b.guess)
            kinds.add(torch.equal(own.guess, b.guess))
    assert kinds == {True, False}


def test_samples_go_on_where_they_stopped(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("viewmend.cli.samples.SCENES_A_SHARD", 2)
    out = tmp_path / "scenes"
    small = [
        "--sizes-px",
        "96",
        "--cameras",
        "5",
        "5",
        "--held-cameras",
        "1",
        "--workers",
        "0",
        "--hull-resolution",
        "48",
    ]
    whole = tmp_path / "whole"
    assert main(["samples", "views", "--out", str(whole), "--count", "4", *small]) == 0
    assert main(["samples", "views", "--out", str(out), "--count", "2", *small]) == 0
    assert main(["samples", "views", "--out", str(out), "--count", "4", *small]) == 0
    names = ["plan.txt", "shard-00000.tar", "shard-00001.tar"]
    assert sorted(p.name for p in out.iterdir() if p.suffix) == names
    assert [(out / n).read_bytes() for n in names] == [(whole / n).read_bytes() for n in names]
    capsys.readouterr()
    assert main(["samples", "views", "--out", str(out), "--count", "4", *small]) == 0
    assert "4 samples are there already" in capsys.readouterr().err
    assert main(["samples", "views", "--out", str(out), "--count", "6", *small, "--seed", "1"]) == 2
    assert "expected scenes of the same plan and seed" in capsys.readouterr().err


def test_stored_hulls_are_as_fine_as_the_plan_says(studio):
    rig = LeaveOneOut({0: studio.read(0)})
    sizes = [
        sum(len(view.faces) for view in store(rig, 0, replace(PLAN, hull_resolution=n), Random(0)).held)
        for n in (16, 48)
    ]
    assert 4 * sizes[0] < sizes[1]
