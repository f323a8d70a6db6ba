"""Runs on stored scenes: each term is learned, runs go on where they stopped, a number gives the same views."""

import json
from dataclasses import replace

import pytest
import torch
from training.conftest import RUN
from training.tiny_views import VIEW_MODEL, VIEW_PLAN, VIEW_RULE

from viewmend.cli import main
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.training.loop import train
from viewmend.training.plan import ViewLossWeights, WholeViewRecipe
from viewmend.training.sample_files import ShardError, StoredShards, sample_to_bytes, write_shards
from viewmend.training.scenes import StudioScenes
from viewmend.training.stored_scenes import StoredSamples, StudioStore
from viewmend.training.whole_view_objective import WholeViewObjective
from viewmend.training.whole_view_run import WholeViewRun
from viewmend.training.whole_views import (
    WholeView,
    WholeViewScenes,
)


@pytest.fixture(scope="module")
def whole():
    stored = StudioStore(StudioScenes(VIEW_PLAN, "tests")).scene(0)[0]
    return WholeView.of(stored.sample(0, VIEW_RULE, 4), SweepNet(VIEW_MODEL))


@pytest.fixture(scope="session")
def view_shards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view-shards")
    scenes = StudioStore(StudioScenes(VIEW_PLAN, "tests"))
    list(write_shards((scenes.scene(number)[0] for number in range(3)), folder, per_shard=2))
    return folder


@pytest.mark.parametrize(
    "term", ["colour", "log_error", "gradient", "cell_colour", "alpha", "place", "visible", "errors"]
)
def test_each_term_alone_can_be_learned(whole, term):
    """A few steps on one view lower it."""
    torch.manual_seed(0)
    weights = ViewLossWeights(**dict.fromkeys(vars(ViewLossWeights()), 0.0) | {term: 1.0})
    net = SweepNet(VIEW_MODEL)
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
    net = SweepNet(VIEW_MODEL)
    output = WholeViewObjective(net, ViewLossWeights())([whole, whole])
    output.total.backward()
    still = [name for name, p in net.named_parameters() if p.grad is None or float(p.grad.abs().sum()) == 0]
    assert still == []
    assert float(output.image.outside) > 0 and float(output.image.log_error) < 0


def test_what_is_wrong_can_be_learned_alone(view_shards, tmp_path):
    """The reader stays bit for bit; a model without an `ErrorNet`, or an untrained one, is refused."""
    torch.manual_seed(0)
    data = replace(VIEW_PLAN, shards=view_shards)
    recipe = WholeViewRecipe(
        name="views", model=VIEW_MODEL, data=data, steps=3, workers=0, part="errors", bfloat16=False
    )
    recipe = replace(recipe, validate_every=0, batch=1, new_per_batch=1, warmup=1)
    start = SweepNet(replace(VIEW_MODEL, error_features=0))
    with pytest.raises(ValueError, match="a trained reader and an ErrorNet"):
        train(recipe, tmp_path / "none", kind=WholeViewRun)
    trained = load_network(train(recipe, tmp_path / "run", start=start, kind=WholeViewRun))
    assert all(torch.equal(trained.state_dict()[name], weight) for name, weight in start.state_dict().items())
    again = train(replace(recipe, steps=1), tmp_path / "more", start=trained, kind=WholeViewRun)
    moved = load_network(again).errors.tell.weight - trained.errors.tell.weight
    assert 0 < float(moved.detach().abs().max()) < 0.1, "it begins with what there is"


def test_a_reader_of_other_sizes_is_no_beginning(view_shards, tmp_path):
    recipe = WholeViewRecipe(
        name="views", model=VIEW_MODEL, data=replace(VIEW_PLAN, shards=view_shards), steps=1, workers=0
    )
    with pytest.raises(ValueError, match="of the recipe's sizes"):
        train(recipe, tmp_path, start=SweepNet(replace(VIEW_MODEL, width=12)), kind=WholeViewRun)


def test_a_run_goes_on_where_it_stopped(view_shards, tmp_path):
    recipe = WholeViewRecipe(
        name="views",
        model=VIEW_MODEL,
        data=replace(VIEW_PLAN, shards=view_shards),
        **RUN,
        validate_every=4,
        validation_views=1,
    )
    once = train(recipe, tmp_path / "once", kind=WholeViewRun)
    train(replace(recipe, steps=2), tmp_path / "twice", kind=WholeViewRun)
    twice = train(recipe, tmp_path / "twice", kind=WholeViewRun)
    lines = [[json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()] for run in (once, twice)]
    scores = next(line["validation"] for line in lines[0] if "validation" in line)
    assert scores["rendered"] > 10 and scores["read"] > 5 and (once / "validation-000004.png").exists()
    costs = [[line["losses"]["total"] for line in run if "losses" in line] for run in lines]
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
        WholeViewScenes(StoredSamples(StoredShards(view_shards, "0"), VIEW_PLAN, seed), seed, SweepNet(VIEW_MODEL))
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
        shards = StoredSamples(StoredShards(view_shards, "0"), VIEW_PLAN, "0")
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
