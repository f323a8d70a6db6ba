"""Published networks are trained on clips framed as on a stream, with their authors' losses."""

import shutil
from dataclasses import replace
from itertools import islice

import pytest
import torch
from models.plates import context
from models.plates import view as plate
from safetensors.torch import load_file
from training.conftest import RUN, SAMPLING, SCENES, studio_samples

from viewmend.contrib.baselines.e2fgvi import E2FGVI, E2FGVIHQ, LocalFlows
from viewmend.contrib.baselines.published import load_baseline
from viewmend.contrib.baselines.token_transformers import DSTT, TOKENS, FuseFormer
from viewmend.contrib.baselines.training import (
    BaselineObjective,
    BaselineObjectiveConfig,
    clip_terms,
    flow_term,
    training_clip,
)
from viewmend.training.adversarial import HINGE
from viewmend.training.config import TrainConfig
from viewmend.training.loop import Run, RunClock, join_processes, train
from viewmend.training.recipes import make_recipe
from viewmend.training.samples import Sample
from viewmend.training.shards import write_shards
from viewmend.utils.weight_files import construct

SIZE = (48, 48)


def sample(time, previous=None):
    view, complete = plate(time), plate(time, None)
    truth = (255 * complete.rgb).round().to(torch.uint8)
    return Sample(view, (context(time),), None, truth, previous)


@pytest.fixture
def clip_of_two():
    return sample(1, sample(0))


def config_of(network="dstt", size_px=SIZE, shards=None, **changes) -> TrainConfig:
    options = BaselineObjectiveConfig(
        network=network, size_px=size_px, sampling=replace(SAMPLING, clip_length=2), clip_length=2
    )
    run = RUN | {"steps": 3, "batch": 1, "replay_size": 1, "ema": 0.0, "learning_rate": 1e-4} | changes
    return TrainConfig(name=network, objective=options, scenes=SCENES, shards=shards, **run)


def objective(start=None, background="black", **changes) -> BaselineObjective:
    torch.manual_seed(0)
    config = config_of(**changes)
    return BaselineObjective(config, replace(config.objective, background=background), start)


@pytest.mark.parametrize("framing", ["def", "win", "mul"])
def test_clips_are_framed_as_a_stream_is(framing, clip_of_two):
    torch.manual_seed(0)
    clip = training_clip(clip_of_two, SIZE, framing)
    assert clip.frames.shape == clip.truth.shape == (2, 3, *SIZE) and clip.holes.shape == (2, *SIZE)
    assert clip.references.shape == ({"mul": 3}.get(framing, 0), 3, *SIZE)
    assert bool(clip.holes.any(2).any(1).all()) and not clip.frames.movedim(1, -1)[clip.holes].any()
    # Outside the holes the plate is rendered without errors.
    rest = (~clip.holes)[:, None].expand_as(clip.truth)
    assert float((clip.frames - clip.truth).abs()[rest].mean()) < 0.02
    assert bool(clip.truth.movedim(1, -1)[clip.holes].abs().sum() > 0)
    assert len(training_clip(clip_of_two, SIZE, framing, length=1).frames) == 1


@pytest.mark.parametrize("framing", ["def", "win", "mul"])
def test_on_white_only_the_background_differs(framing, clip_of_two):
    def white_where_empty(sample):
        view, empty = sample.view, (sample.view.mask == 0) & (sample.view.error == 0)
        return replace(sample, view=replace(view, rgb=torch.where(empty, 1.0, view.rgb)))

    def with_background(sample):
        alpha = torch.full(sample.view.mask.shape, 255, dtype=torch.uint8)
        alpha[:, :20] = 0
        view = replace(sample.view, mask=sample.view.mask * (alpha > 0), rgb=sample.view.rgb * (alpha > 0))
        return replace(sample, view=view, alpha=alpha, truth=sample.truth * (alpha > 0))

    clip = replace(with_background(clip_of_two), previous=with_background(clip_of_two.previous))
    white = replace(white_where_empty(clip), previous=white_where_empty(clip.previous))
    found = []
    for one, background in ((clip, "white"), (white, "black"), (clip, "black")):
        torch.manual_seed(0)
        found.append(training_clip(one, SIZE, framing, background))
    made, expected, black = found
    assert torch.equal(made.frames, expected.frames) and torch.equal(made.holes, expected.holes)
    assert torch.equal(made.references, expected.references)
    assert bool((made.truth[..., 0][black.truth[..., 0] == -1] == 1).any())
    assert float((made.truth - black.truth).min()) > -0.1, (
        "as bright or brighter, except for ringing of the resize"
    )
    with pytest.raises(ValueError, match="expected samples with alpha"):
        training_clip(clip_of_two, SIZE, framing, "white")


def test_terms_are_means_over_their_own_pixels(clip_of_two, rng):
    clip = training_clip(clip_of_two, SIZE, "win")
    made = 2 * torch.rand(clip.truth.shape, generator=rng) - 1
    off = (made - clip.truth).abs().mean(1)
    inside, outside = clip_terms(made, clip)
    assert float(inside) == pytest.approx(float(off[clip.holes].mean()), rel=1e-4)
    assert float(outside) == pytest.approx(float(off[~clip.holes].mean()), rel=1e-4)
    assert float(clip_terms(made, replace(clip, holes=torch.zeros_like(clip.holes)))[0]) == 0


def test_flows_are_compared_with_the_starting_models_only(clip_of_two):
    begun, fresh = (objective(start, network="e2fgvi-hq", size_px=(60, 108)) for start in (E2FGVIHQ(), None))
    for own in (begun, fresh):
        with torch.no_grad():
            output = own([clip_of_two])
        flow = float(output.total - output.image.inside - output.image.outside)
        assert (flow > 1e-6) == (own is begun)
    teacher = begun.flow_teacher
    assert teacher is not None and not any(p.requires_grad for p in teacher.parameters())
    none = torch.zeros(1, 0, 2, 4, 4)
    assert float(flow_term(LocalFlows(none, none), LocalFlows(none, none))) == 0


@pytest.mark.parametrize("background", ["black", "white"])
def test_the_discriminator_receives_completed_clips(background, clip_of_two):
    empty = torch.zeros(clip_of_two.view.mask.shape, dtype=torch.uint8)
    one = replace(clip_of_two, alpha=empty, previous=replace(clip_of_two.previous, alpha=empty))
    output = objective(background=background)([one])
    assert output.judged is not None
    [truth], [completed], [error] = output.judged.truth, output.judged.completed, output.judged.error
    assert truth.shape == completed.shape == (3, 2, *SIZE) and error.shape == (2, *SIZE) and bool(error.any())
    assert (float(truth.min()) > 0.9) == (background == "white")
    output.total.backward()


def test_the_recipes_have_the_authors_parameters():
    for name in ("dstt", "fuseformer", "e2fgvi", "e2fgvi-hq"):
        config = make_recipe(name)
        assert (config.learning_rate, config.ema, config.objective.sampling.clip_length) == (1e-4, 0, 5)
        assert config.objective.network == name and config.objective.size_px == (240, 432)
    own = construct(objective)
    assert own.adversary is not None and own.adversary.loss is HINGE and own.adversary.weight == 0.01
    assert [own.learning_rate_factor(0, at, 1) for at in (0.0, 0.79, 0.8)] == [1.0, 1.0, 0.1]


def test_a_network_that_outputs_black_still_gets_gradients_in_bfloat16(clip_of_two):
    own = objective(precision="bfloat16")
    with torch.no_grad():
        own.model.decoder[-1].bias.fill_(-4)
    own([clip_of_two]).image.inside.backward()
    assert float(own.model.decoder[-1].bias.grad.abs().min()) > 1e-4


@pytest.mark.parametrize(
    ("network", "kind", "size"),
    [
        ("fuseformer", FuseFormer, (36, 48)),
        pytest.param("e2fgvi", E2FGVI, (60, 108), marks=pytest.mark.slow),
    ],
)
def test_positional_maps_are_trained_in_parts(network, kind, size, clip_of_two):
    """Frames smaller than the maps use another random part of them each time."""
    own = objective(network=network, size_px=size)
    for _ in range(2):
        own([clip_of_two]).total.backward()
    maps = [own.model.sc.bias.grad.abs().sum(0)]
    if kind is FuseFormer:
        maps.append(own.model.add_pos_emb.pos_emb.grad.abs().sum(-1).reshape(TOKENS))
    for used in maps:
        assert 1.5 * size[0] * size[1] / (240 * 432) < float((used > 0).float().mean()) < 1


@pytest.mark.slow
def test_a_network_is_trained_resumed_and_usable_as_a_method(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(RunClock, "checkpoint_due", lambda self: calls.append(0) or len(calls) == 2)
    monkeypatch.setattr(RunClock, "note_checkpoint", lambda self: calls.clear())
    clips = studio_samples("tests", clip_length=2)
    list(
        write_shards(
            (s for number in range(3) for s in clips.scene(number)), tmp_path / "shards", shard_size=2
        )
    )
    config = config_of(shards=tmp_path / "shards", validate_every=3, validation_views=1)
    train(config, tmp_path / "whole")
    with join_processes() as own:
        for _ in islice(Run(config, tmp_path / "parts", None, own).steps(), 3):
            pass
    train(config, tmp_path / "parts")
    whole, parts = (load_file(tmp_path / n / "model.safetensors") for n in ("whole", "parts"))
    assert whole.keys() == parts.keys() and all(torch.equal(whole[key], parts[key]) for key in whole)
    torch.manual_seed(config.seed)
    fresh = DSTT().state_dict()
    assert sum(not torch.equal(whole[key], fresh[key]) for key in fresh) > 150, "all of it is trained"
    assert (
        "Views on black. Use as the method `dstt-o-def@FOLDER`." in (tmp_path / "whole/README.md").read_text()
    )
    assert '"telea"' in (tmp_path / "whole/log.jsonl").read_text()
    network = load_baseline("dstt", f"@{tmp_path / 'whole'}")
    assert all(torch.equal(value, whole[key]) for key, value in network.state_dict().items())
    tuned = train(
        replace(config, steps=1, start=str(tmp_path / "whole"), validate_every=0), tmp_path / "tuned"
    )
    steps = [
        float((value - whole[key]).abs().max())
        for key, value in load_file(tuned / "model.safetensors").items()
    ]
    assert 0 < max(steps) < 2e-4, "one step of Adam from the checkpoint"
    for name in ("whole", "parts", "tuned"):  # a gigabyte
        shutil.rmtree(tmp_path / name)
