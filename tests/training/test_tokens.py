"""Windows that are encoded already: the same picture, the transformer alone learns, and others' tokens are refused."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from training.conftest import PLAN
from training.test_autoencoder import MODEL, recipe_of, taught_by

from viewmend.inpainting.chain import build
from viewmend.inpainting.checkpoint import load_network
from viewmend.training.encoded import fingerprint, with_keys
from viewmend.training.from_tokens import TokensObjective, encoded
from viewmend.training.loop import train
from viewmend.training.objective import Objective
from viewmend.training.plan import LossWeights
from viewmend.training.recipes import RECIPES
from viewmend.training.sample_files import read_shard, sample_from_bytes, sample_to_bytes, write_shards

LOSS = LossWeights(channels="sum", outside="image")
recipe = partial(recipe_of, "tokens", clip_length=1, loss=LOSS)


def made(seed, **changes):
    torch.manual_seed(seed)
    return build(replace(MODEL, **changes)).eval()


@pytest.fixture
def sample(shards):
    found = read_shard(sorted(shards.glob("*.tar"))[0])[0]
    now = found.context[0]
    past = replace(now, frame=replace(now.frame, rgb=now.frame.rgb.flip(3), time=now.frame.time - 1))
    return replace(found, context=(now, past), previous=None)


def test_a_view_comes_out_as_from_the_images(sample):
    net = made(0)
    with torch.no_grad():
        from_images = net([sample.view], [list(sample.context)])[0]
        from_tokens = net([sample.view], [with_keys(net, sample.view, encoded(net, sample).encoded)])[0]
        from_nothing = net([sample.view], [[]])[0]
    away = (from_tokens.inpainted - from_images.inpainted).abs().max()
    assert away < 0.1 * (from_nothing.inpainted - from_images.inpainted).abs().max(), "bfloat16 costs the last bits"
    assert from_tokens.coverage.equal(from_images.coverage)


def test_only_the_cameras_and_times_that_the_model_looks_at(sample):
    net = made(0)
    own = encoded(net, sample).encoded
    cameras, now = sample.context[0].frame.cameras.names, sample.view.time
    kept = {(f.name, f.time) for f in with_keys(net, sample.view, own)}
    assert kept == {(name, views.frame.time) for views in sample.context for name in net.context_names(sample.view)}
    assert len({time for _, time in kept}) == 2 and len(cameras) >= 2
    present = made(0, n_c=0, n_w=0)
    assert {f.time for f in with_keys(present, sample.view, own)} == {now}
    single = made(0, context_cameras=1)
    assert {f.name for f in with_keys(single, sample.view, own)} == set(sample.view.closest_views(1))
    assert with_keys(made(0, n_c=0, n_w=0), replace(sample.view, time=now + 90), own) == []


def test_a_context_that_shows_nothing_to_the_camera_looked_at_is_none(sample):
    net = made(0, context_cameras=1)
    closest = sample.view.closest_views(1)
    rest = [name for name in sample.context[0].frame.cameras.names if name not in closest]
    elsewhere = replace(sample, context=tuple(views.select(rest) for views in sample.context))
    assert encoded(net, elsewhere).encoded.frames == ()
    with torch.no_grad():
        images = net([sample.view], [list(elsewhere.context)])[0].inpainted
        nothing = net([sample.view], [[]])[0].inpainted
    assert images.equal(nothing)


def test_keys_and_values_are_the_models_own_and_learn(sample):
    net, other = made(0), made(1)
    own = encoded(net, sample).encoded
    assert not any(frame.keys_values.numel() for frame in own.frames)
    frames = with_keys(net, sample.view, own)
    for frame in frames:
        expected = net.transformer.project_context(frame.tokens.float())
        torch.testing.assert_close(frame.keys_values, expected)
    others = with_keys(other, sample.view, own)
    assert not torch.allclose(others[0].keys_values, frames[0].keys_values, atol=1e-3)
    frames[-1].keys_values.sum().backward()
    assert net.transformer.keys_values.weight.grad is not None


def test_what_is_stored_comes_back(sample):
    one = encoded(made(0), sample)
    again = sample_from_bytes(sample_to_bytes(one))
    assert again.context == () and again.encoded.encoder == fingerprint(made(0)) != fingerprint(made(1))
    for before, after in zip(one.encoded.frames, again.encoded.frames, strict=True):
        assert after.tokens.dtype == torch.bfloat16 and torch.equal(before.tokens, after.tokens)
        assert (before.name, before.time) == (after.name, after.time)
        assert torch.equal(before.places, after.places) and torch.equal(before.depths, after.depths)


def test_the_transformer_alone_learns(sample, tmp_path):
    torch.manual_seed(0)
    own = build(MODEL)
    list(write_shards([encoded(own, sample)] * 3, tmp_path / "encoded"))
    weights, moved = taught_by(recipe(tmp_path / "encoded"), tmp_path / "run")
    assert moved == {"transformer"}
    assert any(name.startswith("transformer.keys_values") for name in weights)


def test_what_begins_anew_takes_nothing_of_the_start(sample, tmp_path):
    start = made(5)
    list(write_shards([encoded(start, sample)] * 3, tmp_path / "encoded"))
    plan = recipe(tmp_path / "encoded", anew=("transformer",), learning_rate=1e-9, seed=3)
    after = load_network(str(train(plan, tmp_path / "run", start))).state_dict()
    kept = {name for name, weight in start.state_dict().items() if torch.equal(weight, after[name])}
    assert {name.split(".")[0] for name in kept} >= {"tokeniser", "decoder"}
    assert not any(name.startswith("transformer.keys_values") for name in kept)
    whole = load_network(str(train(replace(plan, anew=()), tmp_path / "whole", start))).state_dict()
    assert all(torch.allclose(weight, whole[name], atol=1e-6) for name, weight in start.state_dict().items())


def test_tokens_of_another_encoder_and_images_are_refused(sample):
    net, run = made(0), recipe(None)
    objective = TokensObjective(net, run)
    assert torch.isfinite(objective([encoded(net, sample)]).total)
    with pytest.raises(ValueError, match=f"this model's encoder .{fingerprint(net)}.*got {fingerprint(made(1))};"):
        objective([encoded(net, sample), encoded(made(1), sample)])
    with pytest.raises(ValueError, match="got none, but images; make them with the model"):
        objective([sample])
    with pytest.raises(ValueError, match="expected samples with the images of their context, got encoded ones"):
        Objective(net, replace(run, part="all"))([encoded(net, sample)])


def test_slivers_count_for_nothing_until_it_is_time(sample):
    net, run = made(0), recipe(None, loss=replace(LOSS, wide_first=0.5))
    narrow = torch.zeros_like(sample.view.error)
    rows, columns = torch.nonzero(sample.view.error > 0).unbind(1)
    narrow[rows[0], columns[0]] = 1
    one = replace(encoded(net, sample), view=replace(sample.view, error=narrow))
    objective = TokensObjective(net, run)
    with torch.no_grad():
        before = objective([one]).image
        objective.progress = 0.5
        after = objective([one]).image
        always = TokensObjective(net, recipe(None))([one]).image
    assert before.inside == 0 < after.inside == always.inside
    assert before.outside == after.outside == always.outside, "slivers are not outside of holes, either"


def test_the_recipe_is_that_of_paper_small_with_what_it_holds_still():
    found = RECIPES["tokens"](PLAN)
    assert found.part == "tokens" and found.model == RECIPES["windows"](PLAN).model
    assert found.replay_size == 1 and found.new_per_batch == found.batch, "encoded windows are cheap to read"
