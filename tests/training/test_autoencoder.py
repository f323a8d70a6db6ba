"""Encoder and decoder alone, on patches of camera images."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from training.conftest import MODEL as CHAIN
from training.conftest import PLAN, RUN

from viewmend.inpainting.chain import build
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.config import paper_small
from viewmend.inpainting.images import context_images
from viewmend.training.autoencoder import AutoencoderObjective
from viewmend.training.loop import Run, train
from viewmend.training.losses import LEAST_SQUARE
from viewmend.training.plan import LossWeights, Recipe
from viewmend.training.processes import Processes
from viewmend.training.recipes import RECIPES
from viewmend.training.sample_files import read_shard
from viewmend.training.through_tokens import through_tokens

MODEL = replace(paper_small(), widths=(8,) * 9, dim=32, heads=2, groups=1, blocks=2)
PLAIN = LossWeights(channels="sum")


def recipe_of(name, shards, clip_length=2, **changes) -> Recipe:
    """A run that takes a second, of a part of a tiny `paper_small`."""
    data = replace(PLAN, shards=shards, clip_length=clip_length, ray_views=0)
    return Recipe(name=name, data=data, **(RUN | {"part": name, "validate_every": 0, "model": MODEL} | changes))


recipe = partial(recipe_of, "autoencoder", loss=PLAIN)


def taught_by(run: Recipe, out: Path) -> tuple[dict[str, torch.Tensor], set[str]]:
    """The weights that a run from nothing, by seed 0, writes to `out`, and the modules in which it moved any."""
    torch.manual_seed(0)
    before = build(MODEL).state_dict()
    after = load_network(str(train(run, out))).state_dict()
    return after, {name.split(".")[0] for name in after if not torch.equal(before[name], after[name])}


def first_samples(shards):
    return read_shard(sorted(shards.glob("*.tar"))[0])[:2]


def test_patches_are_those_of_the_images_and_pass_through_their_own_token_alone(shards):
    sample = first_samples(shards)[0]
    net = build(MODEL).eval()
    stack = context_images(sample.context[0], MODEL)
    with torch.no_grad():
        made, shown = through_tokens(net, [stack, stack])
        tokens = net.tokeniser([stack])
        alone = net.decoder(tokens, shown[: len(tokens)])
    assert made.shape == shown.shape == (2 * len(stack.places), 3, 28, 28)
    torch.testing.assert_close(made[: len(tokens)], alone, atol=1e-5, rtol=0)
    for n in range(0, len(stack.places), 3):
        view, row, column = stack.places[n].tolist()
        image = torch.zeros(3, 28, 28)
        part = stack.channels[view, :3, 16 * row : 16 * row + 28, 16 * column : 16 * column + 28]
        image[:, : part.shape[1], : part.shape[2]] = part
        assert torch.equal(shown[n], image)


def test_the_loss_is_that_of_all_patches(shards):
    samples = [replace(s, context=s.context[:1]) for s in first_samples(shards)]
    net = build(MODEL).eval()
    with torch.no_grad():
        out = AutoencoderObjective(net, recipe(shards, loss=replace(PLAIN, log_error=0.5)))(samples)
        made, shown = through_tokens(net, [context_images(s.context[0], MODEL) for s in samples])
    assert float(out.image.inside) == pytest.approx(float((made - shown).abs().sum(1).mean()), rel=1e-5)
    log_error = float((((made - shown) ** 2).mean() + LEAST_SQUARE).log10())
    assert float(out.total) == pytest.approx(float(out.image.inside) + 0.5 * log_error, rel=1e-5)
    assert float(out.image.outside) == 0 and out.completed == ()
    blank = replace(samples[0], context=(replace(samples[0].context[0], depth=samples[0].context[0].depth * 0),))
    blank = replace(blank, context=(replace(blank.context[0], frame=replace(blank.context[0].frame, mask=None)),))
    with pytest.raises(ValueError, match="none that shows any"):
        AutoencoderObjective(net, recipe(shards))([blank])


def test_a_run_teaches_encoder_and_decoder_alone_and_another_goes_on_from_it(shards, tmp_path):
    out = tmp_path / "run"
    after, moved = taught_by(recipe(shards, seed=0), out)
    assert moved == {"tokeniser", "decoder"}
    card = (out / "README.md").read_text()
    assert "L1 of patches of camera images; averaged" in card and "holes" not in card
    begun = train(
        replace(recipe(shards, part="all", steps=1, learning_rate=1e-12), name="on"),
        tmp_path / "on",
        load_network(str(out)),
    )
    for name, weight in load_network(str(begun)).state_dict().items():
        torch.testing.assert_close(weight, after[name], atol=1e-6, rtol=0)


def test_of_a_chain_the_patches_learn_and_not_the_rays(shards, tmp_path):
    chain = recipe(shards, model=CHAIN)
    run = Run(chain, tmp_path / "chain", None, Processes(0, 1, torch.device("cpu")))
    learned = {name for name, weight in run.model.named_parameters() if weight.requires_grad}
    assert {name.split(".")[:2][1] for name in learned} == {"tokeniser", "decoder"}
    assert all(name.startswith("patches.") for name in learned) and isinstance(run.objective, AutoencoderObjective)
    assert len(list(run.steps())) == chain.steps


def test_what_it_cannot_be_judged_by_is_refused():
    with pytest.raises(ValueError, match="validate-every 0"):
        replace(RECIPES["autoencoder"](PLAN), validate_every=5)
    with pytest.raises(ValueError, match="adversarial"):
        replace(RECIPES["autoencoder"](PLAN), loss=LossWeights(adversarial=0.1))
