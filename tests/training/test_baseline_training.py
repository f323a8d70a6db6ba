"""Published networks learn on our samples, from what they are shown on a stream, and go on where they stopped."""

import json
import shutil
from dataclasses import replace
from itertools import islice

import pytest
import torch
from inpainting.plates import context
from inpainting.plates import view as plate
from safetensors.torch import load_file

from viewmend import cli
from viewmend.baselines.dstt import DSTT
from viewmend.baselines.e2fgvi import E2FGVI, E2FGVIHQ, LocalFlows
from viewmend.baselines.fuseformer import TOKENS, FuseFormer
from viewmend.baselines.published import load_baseline
from viewmend.training.baseline_clips import training_clip
from viewmend.training.baseline_objective import BaselineObjective, clip_terms, flow_term
from viewmend.training.baseline_run import BaselineRun, baseline_recipe
from viewmend.training.loop import train
from viewmend.training.processes import processes
from viewmend.training.run_files import RunError
from viewmend.training.samples import Sample

SIZE = (48, 48)


def sample(time, previous=None):
    view, complete = plate(time), plate(time, None)
    truth = (255 * complete.rgb).round().to(torch.uint8)
    return Sample(view, (context(time),), None, truth, previous)


@pytest.fixture
def clip_of_two():
    return sample(1, sample(0))


@pytest.mark.parametrize("framing", ["def", "win", "mul"])
def test_clips_are_framed_as_a_stream_is(framing, clip_of_two):
    torch.manual_seed(0)
    clip = training_clip(clip_of_two, SIZE, framing)
    assert clip.frames.shape == clip.truth.shape == (2, 3, *SIZE) and clip.holes.shape == (2, *SIZE)
    assert clip.references.shape == ({"mul": 3}.get(framing, 0), 3, *SIZE)
    assert bool(clip.holes.any(2).any(1).all()) and not clip.frames.movedim(1, -1)[clip.holes].any()
    # Beside the holes the plate is rendered as it is.
    rest = (~clip.holes)[:, None].expand_as(clip.truth)
    assert float((clip.frames - clip.truth).abs()[rest].mean()) < 0.02
    assert bool(clip.truth.movedim(1, -1)[clip.holes].abs().sum() > 0)


@pytest.mark.parametrize("framing", ["def", "win", "mul"])
def test_clips_upon_white_are_what_a_stream_upon_white_shows(framing, clip_of_two):
    """Beside the holes all that changes is the background; in them, the truth's alone."""

    def white_where_empty(sample):
        view, empty = sample.view, (sample.view.mask == 0) & (sample.view.error == 0)
        return replace(sample, view=replace(view, rgb=torch.where(empty, 1.0, view.rgb)))

    def with_background(sample):
        alpha = torch.full(sample.view.mask.shape, 255, dtype=torch.uint8)
        alpha[:, :20] = 0
        mask = sample.view.mask * (alpha > 0)
        view = replace(sample.view, mask=mask, rgb=sample.view.rgb * (alpha > 0))
        return replace(sample, view=view, alpha=alpha, truth=sample.truth * (alpha > 0))

    clip = replace(with_background(clip_of_two), previous=with_background(clip_of_two.previous))
    white = replace(white_where_empty(clip), previous=white_where_empty(clip.previous))
    torch.manual_seed(0)
    made = training_clip(clip, SIZE, framing, "white")
    torch.manual_seed(0)
    expected = training_clip(white, SIZE, framing)
    assert torch.equal(made.frames, expected.frames) and torch.equal(made.holes, expected.holes)
    assert torch.equal(made.references, expected.references)
    torch.manual_seed(0)
    black = training_clip(clip, SIZE, framing)
    left = black.truth[..., 0] == -1
    assert bool((made.truth[..., 0][left] == 1).any())
    assert float((made.truth - black.truth).min()) > -0.1, "as bright or brighter, but where resizing rings"
    with pytest.raises(ValueError, match="samples that tell where the subject is"):
        training_clip(clip_of_two, SIZE, framing, "white")


def test_the_recipe_says_what_a_run_learns_from(recipe, tmp_path):
    with processes() as own:
        for background in ("black", "white"):
            run = BaselineRun(replace(recipe, background=background), tmp_path / background, None, own)
            assert run.objective.background == background


def test_what_is_learned_from_white_is_white(clip_of_two):
    def clip_upon(background):
        torch.manual_seed(0)
        bright = replace(clip_of_two, alpha=torch.zeros(clip_of_two.view.mask.shape, dtype=torch.uint8))
        sample = replace(bright, previous=None)
        return BaselineObjective(DSTT(), SIZE, False, None, background)([sample]).clips[0]

    assert float(clip_upon("white").truth.min()) > 0.9 > float(clip_upon("black").truth.min())


def test_terms_are_means_over_their_own_pixels(clip_of_two, rng):
    clip = training_clip(clip_of_two, SIZE, "win")
    made = 2 * torch.rand(clip.truth.shape, generator=rng) - 1
    sums, counts = [0.0, 0.0], [0, 0]
    for t in range(2):
        for y in range(SIZE[0]):
            for x in range(SIZE[1]):
                part = 0 if clip.holes[t, y, x] else 1
                sums[part] += float((made - clip.truth)[t, :, y, x].abs().mean())
                counts[part] += 1
    inside, outside = clip_terms(made, clip)
    assert float(inside) == pytest.approx(sums[0] / counts[0], rel=1e-4)
    assert float(outside) == pytest.approx(sums[1] / counts[1], rel=1e-4)
    none = replace(clip, holes=torch.zeros_like(clip.holes))
    assert float(clip_terms(made, none)[0]) == 0


def test_flows_are_compared_with_those_of_the_true_frames_and_only_after_a_checkpoint(clip_of_two):
    torch.manual_seed(0)
    network, start = E2FGVIHQ(), E2FGVIHQ()
    network.load_state_dict(start.state_dict())
    for begun in (start, None):
        objective = BaselineObjective(network, (60, 108), False, begun)
        outcome = objective([clip_of_two])
        assert (float(outcome.flow.detach()) > 0) == (begun is not None)
        expected = outcome.image.inside + outcome.image.outside + outcome.flow
        assert torch.allclose(outcome.total, expected)
    teacher = BaselineObjective(network, (60, 108), False, start).teacher
    assert teacher is not None and not any(p.requires_grad for p in teacher.parameters())
    one = LocalFlows(torch.zeros(1, 0, 2, 4, 4), torch.zeros(1, 0, 2, 4, 4))
    assert float(flow_term(one, one)) == 0


def test_what_is_judged_is_the_rendered_view_with_the_holes_filled(clip_of_two):
    torch.manual_seed(0)
    outcome = BaselineObjective(DSTT(), SIZE, False, None)([clip_of_two])
    [clip], [composed] = outcome.clips, outcome.composed
    rest = (~clip.holes)[:, None].expand_as(composed)
    assert torch.equal(composed[rest], clip.frames[rest])
    outcome.total.backward()


def log_of(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


@pytest.fixture
def recipe(tiny):
    made = baseline_recipe("dstt", tiny.data)
    return replace(
        made, data=tiny.data, size_px=SIZE, steps=3, minutes=None, batch=1, replay_size=1, workers=0, checkpoint_every=2
    )


def test_recipes_have_the_authors_parameters(plan):
    recipe = baseline_recipe("e2fgvi", plan)
    assert (recipe.learning_rate, recipe.discriminator_rate, recipe.loss.adversarial) == (1e-4, 1e-4, 0.01)
    assert (
        recipe.loss.adversarial_kind == "hinge" and recipe.loss.discriminator == "clip" and recipe.data.clip_length == 5
    )
    assert recipe.size_px == (240, 432) and recipe.ema == 0 and recipe.weight_decay == 0


@pytest.mark.slow
def test_a_network_learns_goes_on_and_is_a_method(recipe, tmp_path):
    train(recipe, tmp_path / "whole", kind=BaselineRun)
    with processes() as own:
        for _ in islice(BaselineRun(recipe, tmp_path / "parts", None, own).steps(), 2):
            pass
    train(recipe, tmp_path / "parts", kind=BaselineRun)
    whole, parts = (load_file(tmp_path / n / "model.safetensors") for n in ("whole", "parts"))
    assert whole.keys() == parts.keys() and all(torch.equal(whole[key], parts[key]) for key in whole)
    costs = [[entry["losses"] for entry in log_of(tmp_path / n)] for n in ("whole", "parts")]
    assert costs[0] == costs[1] and all(c["adversarial"] and c["discriminator"] for c in costs[0])
    assert [entry["learning_rate"] for entry in log_of(tmp_path / "whole")] == pytest.approx([1e-4, 1e-4, 1e-4])
    torch.manual_seed(recipe.seed)
    fresh = DSTT().state_dict()
    assert sum(not torch.equal(whole[key], fresh[key]) for key in fresh) > 150, "all of it learns"
    assert "Views upon black. Began with random weights." in (tmp_path / "whole" / "README.md").read_text()
    network = load_baseline("dstt", f"@{tmp_path / 'whole'}")
    assert all(torch.equal(value, whole[key]) for key, value in network.state_dict().items())
    with pytest.raises(RunError, match="differs in started"):
        train(replace(recipe, started=True), tmp_path / "whole", kind=BaselineRun)
    for name in ("whole", "parts"):  # a gigabyte
        shutil.rmtree(tmp_path / name)


def test_a_network_that_fills_with_black_still_learns_in_bfloat16(clip_of_two):
    network = DSTT()
    with torch.no_grad():
        network.decoder[-1].bias.fill_(-4)
    BaselineObjective(network, SIZE, True, None)([clip_of_two]).image.inside.backward()
    assert float(network.decoder[-1].bias.grad.abs().min()) > 1e-4


@pytest.mark.parametrize(("kind", "size"), [(FuseFormer, (36, 48)), (E2FGVI, (60, 108))])
def test_learned_maps_are_learned_in_parts(kind, size, clip_of_two):
    """Frames smaller than the maps see a part of them, each time another; what is learned is for all of them."""
    torch.manual_seed(0)
    network = kind()
    objective = BaselineObjective(network, size, False, None)
    for _ in range(8):
        objective([clip_of_two]).total.backward()
    maps = [network.sc.bias.grad.abs().sum(0)]
    if kind is FuseFormer:
        maps.append(network.add_pos_emb.pos_emb.grad.abs().sum(-1).reshape(TOKENS))
    for seen in maps:
        share = float((seen > 0).float().mean())
        assert 1.5 * size[0] * size[1] / (240 * 432) < share < 1


@pytest.mark.slow
def test_the_command_begins_with_a_checkpoint(shards, tmp_path, capsys):
    torch.manual_seed(5)
    torch.save({"netG": DSTT().state_dict()}, tmp_path / "dstt.pth")
    arguments = ["train", "dstt", "--from", str(tmp_path / "dstt.pth"), "--shards", str(shards), "--batch", "1"]
    arguments += ["--clip-length", "2"]
    out = tmp_path / "out"
    assert cli.main([*arguments, "--steps", "1", "--workers", "0", "--out", str(out)]) == 0
    tuned, begun = load_file(out / "model.safetensors"), DSTT()
    torch.manual_seed(5)
    begun = DSTT().state_dict()
    steps = [float((tuned[key] - begun[key]).abs().max()) for key in begun]
    assert 0 < max(steps) < 2e-4, "one step of Adam from the checkpoint"
    shutil.rmtree(out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["dstt", "--from", "absent.pth"], "absent.pth: expected a file of weights, found none"),
        (["sttn"], "expected a recipe among small, .*dstt, fuseformer, e2fgvi, e2fgvi-hq, got 'sttn'"),
        (["small", "--size-px", "60", "108"], "Unrecognized options: --size-px"),
        (["fuseformer", "--size-px", "64", "108"], "frames of 432x240.*got 108x64"),
        (["e2fgvi", "--validate-every", "5", "--steps", "1"], "expected --validate-every 0"),
    ],
)
def test_what_cannot_be_trained_is_said(arguments, message, tmp_path, capsys):
    import re

    assert cli.main(["train", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert re.search(message, capsys.readouterr().err)
