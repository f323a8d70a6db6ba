"""A run trains its part, writes what it should, and goes on as if it had never been stopped."""

import json
from dataclasses import replace
from itertools import islice

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from viewmend.baselines.classical import Telea
from viewmend.inpainting.chain import build
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.protocol import ContextProvider, State
from viewmend.training import loop, ray_batches
from viewmend.training.loop import Run, train
from viewmend.training.plan import LossWeights
from viewmend.training.processes import processes
from viewmend.training.run_files import FILE, RunError
from viewmend.training.sample_files import sample_from_bytes
from viewmend.training.schedule import averaging
from viewmend.training.validation import Validation


def log_of(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def same_weights(a, b):
    a, b = (load_file(folder / "model.safetensors") for folder in (a, b))
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


@pytest.mark.parametrize("part", ["all", "rays", "patches"])
def test_a_short_run_trains_its_part_and_writes_a_model_that_loads_and_a_log(part, tiny, tmp_path):
    recipe = replace(tiny, part=part, steps=3, ema=0.0)
    reported = []
    train(recipe, tmp_path, report=reported.append)
    assert [entry["step"] for entry in log_of(tmp_path)] == [1, 2, 3] == [entry.step for entry in reported]
    inpainter = load_network(tmp_path)
    assert inpainter.config == recipe.model
    torch.manual_seed(recipe.seed)
    untrained = build(recipe.model).state_dict()
    moved = {n.startswith("coarse.") for n, w in inpainter.state_dict().items() if not torch.equal(w, untrained[n])}
    assert moved == {"all": {True, False}, "rays": {True}, "patches": {False}}[part]
    assert "tiny" in (tmp_path / "README.md").read_text()


ADVERSARIAL = LossWeights(adversarial=0.01, adversarial_kind="hinge", discriminator="clip")


@pytest.mark.parametrize("loss", [LossWeights(), ADVERSARIAL], ids=["image", "adversarial"])
def test_going_on_is_as_if_the_run_had_not_been_stopped(loss, tiny, tmp_path):
    recipe = replace(tiny, loss=loss)
    train(recipe, tmp_path / "whole")
    with processes() as own:
        for _ in islice(Run(recipe, tmp_path / "parts", None, own).steps(), 3):
            pass  # the checkpoint is of step 2: the third step is lost and made again
    assert [entry["step"] for entry in log_of(tmp_path / "parts")] == [1, 2, 3]
    reported = []
    train(recipe, tmp_path / "parts", report=reported.append)
    assert [entry.step for entry in reported] == [3, 4]
    assert same_weights(tmp_path / "whole", tmp_path / "parts")
    costs = [[entry["losses"] for entry in log_of(tmp_path / which)] for which in ("whole", "parts")]
    assert costs[0] == costs[1]
    assert bool(costs[0][-1]["discriminator"]) == bool(loss.adversarial)
    train(recipe, tmp_path / "parts", report=reported.append)
    assert len(reported) == 2, "a finished run has nothing left to do"


def test_a_run_that_is_asked_to_stop_loses_no_step(tiny, tmp_path):
    train(replace(tiny, checkpoint_every=100), tmp_path / "whole")
    reported = []
    train(replace(tiny, checkpoint_every=100), tmp_path / "parts", None, reported.append, None, lambda: bool(reported))
    assert [entry.step for entry in reported] == [1]
    train(replace(tiny, checkpoint_every=100), tmp_path / "parts", report=reported.append)
    assert [entry.step for entry in reported] == [1, 2, 3, 4] and same_weights(tmp_path / "whole", tmp_path / "parts")


def test_a_run_goes_on_only_with_its_own_recipe_and_a_whole_file(tiny, tmp_path):
    train(replace(tiny, steps=1), tmp_path)
    with pytest.raises(RunError, match="differs in batch, learning_rate"):
        train(replace(tiny, batch=3, learning_rate=1.0), tmp_path)
    whole = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RunError, match=r"run\.safetensors: expected a run to go on with"):
        train(tiny, tmp_path)


def test_the_checkpoint_before_the_last_is_kept_and_used_without_the_last(tiny, tmp_path):
    train(tiny, tmp_path / "whole")
    train(tiny, tmp_path / "parts")
    (tmp_path / "parts" / FILE).write_bytes(b"damaged")
    with pytest.raises(RunError, match=r"put run\.previous\.safetensors in its place"):
        train(tiny, tmp_path / "parts")
    (tmp_path / "parts" / FILE).unlink()
    reported = []
    train(tiny, tmp_path / "parts", report=reported.append)
    assert [entry.step for entry in reported] == [3, 4] and same_weights(tmp_path / "whole", tmp_path / "parts")


def test_weights_that_are_not_finite_never_replace_good_ones(tiny, tmp_path, monkeypatch):
    train(replace(tiny, steps=2), tmp_path)
    before = {name: (tmp_path / name).read_bytes() for name in (FILE, "model.safetensors")}
    monkeypatch.setattr(torch.optim.AdamW, "step", lambda self: self.param_groups[0]["params"][0].data.fill_(torch.inf))
    with pytest.raises(FloatingPointError, match="expected finite numbers"):
        train(replace(tiny, steps=3), tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in before} == before


def test_averages_follow_slowly(tiny, tmp_path):
    with processes() as own:
        run = Run(replace(tiny, ema=0.9, learning_rate=0.01), tmp_path, None, own)
        seen = [[weight.detach().clone() for weight in run.model.parameters()] for _ in islice(run.steps(), 2)]
        for average, first, second in zip(run.averaged.parameters(), *seen, strict=True):
            assert torch.allclose(average, 2 / 11 * first + 9 / 11 * second, atol=1e-6), "at first faster"
        assert any(float((a - b).abs().max()) > 1e-3 for a, b in zip(*seen, strict=True))


def test_averages_forget_the_beginning_and_then_follow_slowly():
    average, following = torch.tensor([100.0]), averaging(0.998)
    for count in range(1, 400):
        following([average], [torch.tensor([float(count % 2)])], count)
    assert 0.4 < float(average) < 0.6, "a hundred is forgotten"
    late = torch.tensor([0.0])
    following([late], [torch.tensor([1.0])], 10**6)
    assert float(late) == pytest.approx(0.002, rel=1e-3)
    for decay in (0.0, 0.05):
        now = torch.tensor([0.0])
        averaging(decay)([now], [torch.tensor([1.0])], torch.tensor(1))
        assert float(now) == pytest.approx(1 - decay)


def test_gradients_are_clipped(tiny, tmp_path):
    """By so much here that Adam's own epsilon outweighs them."""
    moved = {}
    for norm in (1e-12, 1.0):
        with processes() as own:
            run = Run(replace(tiny, max_grad_norm=norm, weight_decay=0.0), tmp_path / str(norm), None, own)
            before = [weight.detach().clone() for weight in run.learned]
            list(islice(run.steps(), 1))
            moved[norm] = max(float((a.detach() - b).abs().max()) for a, b in zip(run.learned, before, strict=True))
    assert moved[1e-12] < 0.01 * moved[1.0]


def test_somebody_elses_log_is_not_touched(tiny, tmp_path):
    (tmp_path / "log.jsonl").write_text('{"mine": 1}\n{"step": 7}\n')
    with pytest.raises(ValueError, match=r"log\.jsonl: expected no such file"):
        train(tiny, tmp_path)
    assert [f.name for f in tmp_path.iterdir()] == ["log.jsonl"]
    assert (tmp_path / "log.jsonl").read_text() == '{"mine": 1}\n{"step": 7}\n'


def test_a_run_that_ended_before_its_first_checkpoint_begins_again(tiny, tmp_path):
    def end(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tiny, tmp_path, report=end)
    assert len(log_of(tmp_path)) == 1 and not (tmp_path / FILE).exists()
    train(tiny, tmp_path)
    assert [entry["step"] for entry in log_of(tmp_path)] == [1, 2, 3, 4]


def test_a_run_whose_values_do_not_fit_is_one_clear_error(tiny, tmp_path):
    train(replace(tiny, steps=1), tmp_path)
    with safe_open(tmp_path / FILE, framework="pt") as file:
        metadata = file.metadata()
        whole = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    moment = next(key for key in whole if key.startswith("optimizer/"))
    weight = next(key for key in whole if key.startswith("model/"))
    state = json.dumps({"step": 1, "elapsed_s": 0.0})
    for tensors, told in (
        ({key: value for key, value in whole.items() if key != moment}, metadata),
        ({key: value for key, value in whole.items() if key != weight}, metadata),
        (whole | {weight: torch.zeros(3, 3, 3)}, metadata),
        (whole, metadata | {"state": state}),
    ):
        save_file(tensors, tmp_path / FILE, told)
        with pytest.raises(RunError, match="expected a run of this version"):
            train(replace(tiny, steps=2), tmp_path)


def test_a_finished_run_makes_its_model_again(tiny, tmp_path):
    train(replace(tiny, steps=1), tmp_path)
    before = (tmp_path / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(before[:100])
    train(replace(tiny, steps=1), tmp_path)
    assert (tmp_path / "model.safetensors").read_bytes() == before


def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_its_batch(tiny, tmp_path, monkeypatch):
    def broken(recipe, start):
        model = made(recipe, start)
        model.patches.decoder.linear.weight.data.fill_(torch.nan)
        return model

    made = loop._model
    monkeypatch.setattr(loop, "_model", broken)
    with pytest.raises(FloatingPointError, match="at step 0"):
        train(tiny, tmp_path)
    saved = sorted((tmp_path / "not-finite-000000").iterdir())
    assert len(saved) == 1, "the first batch has no buffer yet"
    assert sample_from_bytes(saved[0].read_bytes()).view.error.any()
    assert not (tmp_path / FILE).exists()


def test_validation_scores_the_averaged_weights_and_leaves_a_picture(tiny, tmp_path):
    train(replace(tiny, validate_every=3), tmp_path)
    judged = [entry for entry in log_of(tmp_path) if "validation" in entry]
    assert [entry["step"] for entry in judged] == [3, 4]
    views, model, found = Validation(tiny, tmp_path)._views(), load_network(tmp_path).eval(), []
    for sample in views:
        with torch.no_grad():
            made = model([sample.view], [list(sample.context)], ray_views=[sample.ray_views])[0]
        telea, _ = Telea().step(sample.view, ContextProvider(lambda *_: None), State())
        missing = sample.view.error > 0
        off = [(rgb - sample.truth / 255)[:, missing] for rgb in (made.completed, telea.rgb, made.coarse)]
        found.append([-10 * float(each.square().mean().log10()) for each in off])
    last = judged[-1]["validation"]
    expected = torch.tensor(found).mean(0).tolist()
    assert [last["holes"], last["telea"], last["coarse_fill"]] == pytest.approx(expected, abs=2e-3)
    assert judged[0]["validation"]["telea"] == judged[1]["validation"]["telea"], "the views are fixed"
    assert sorted(p.name for p in tmp_path.glob("*.png")) == ["validation-000003.png", "validation-000004.png"]


def test_what_a_step_draws_follows_from_its_number_alone(tiny, tmp_path):
    """Whoever draws between the steps changes nothing; the steps themselves draw differently."""
    recipe = replace(tiny, part="rays", augment=True, steps=3, checkpoint_every=100)
    drawn, augment = [], ray_batches.augmented

    def noting(batch):
        drawn.append(float(torch.rand(())))
        return augment(batch)

    for name in ("undisturbed", "disturbed"):
        between = None if name == "undisturbed" else lambda _: torch.rand(7)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ray_batches, "augmented", noting)
            train(recipe, tmp_path / name, report=between)
    assert same_weights(tmp_path / "undisturbed", tmp_path / "disturbed")
    assert drawn[: len(drawn) // 2] == drawn[len(drawn) // 2 :] and len(set(drawn)) == len(drawn) // 2 > 3
