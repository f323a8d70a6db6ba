"""A run trains its model, writes its files, and resumes as if it had not been interrupted."""

import json
from dataclasses import replace
from itertools import islice

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import nn
from training.conftest import log_of

from viewmend.models.base import ContextProvider
from viewmend.models.checkpoint import load_network
from viewmend.models.classical import Telea
from viewmend.models.compositing import composite
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.training.loop import Processes, Run, RunClock, averaging, join_processes, train
from viewmend.training.paper import PaperObjective
from viewmend.training.run_files import CHECKPOINT, RunError, RunState, load_run, save_run
from viewmend.training.samples import true_image
from viewmend.training.shards import sample_from_bytes


def same_weights(a, b):
    a, b = (load_file(folder / "model.safetensors") for folder in (a, b))
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def with_options(config, **changes):
    return replace(config, objective=replace(config.objective, **changes))


@pytest.fixture(scope="module")
def whole(tiny, tmp_path_factory):
    """The folder of a run of the tiny config that was never interrupted; leave it as it is."""
    return train(tiny, tmp_path_factory.mktemp("whole"))


@pytest.fixture
def every_two(monkeypatch):
    """Checkpoints are due at every second step."""
    calls = []
    monkeypatch.setattr(RunClock, "checkpoint_due", lambda self: calls.append(0) or len(calls) % 2 == 0)
    monkeypatch.setattr(RunClock, "note_checkpoint", lambda self: calls.clear())


def test_a_short_run_trains_the_model_and_writes_a_log_and_a_card(tiny, tmp_path):
    config = replace(tiny, steps=3, ema=0.0)
    reported = []
    train(config, tmp_path, report=reported.append)
    assert [entry["step"] for entry in log_of(tmp_path)] == [1, 2, 3] == [entry.step for entry in reported]
    model = load_network(tmp_path)
    assert model.config == config.objective.model
    torch.manual_seed(config.seed)
    untrained = PatchTransformer(config.objective.model).state_dict()
    changed = {n.split(".")[0] for n, w in model.state_dict().items() if not torch.equal(w, untrained[n])}
    assert changed == {"tokeniser", "transformer", "decoder"}
    card = (tmp_path / "README.md").read_text()
    assert "`viewmend train tiny` from random weights: 3 steps" in card
    assert "a data set written by `viewmend make-dataset`" in card


def test_a_run_starts_from_the_model_that_its_config_names(tiny, tmp_path):
    first = train(replace(tiny, steps=2), tmp_path / "first")
    config = replace(tiny, steps=1, learning_rate=1e-12, start=str(first))
    second = train(config, tmp_path / "second")
    for name, weight in load_network(first).state_dict().items():
        torch.testing.assert_close(weight, load_network(second).state_dict()[name], atol=1e-6, rtol=0)
    assert f"from `{first}`" in (second / "README.md").read_text()


@pytest.mark.parametrize("adversarial", [0.0, 0.01])
def test_a_resumed_run_equals_an_uninterrupted_one(adversarial, tiny, tmp_path, every_two):
    config = with_options(tiny, adversarial=adversarial)
    train(config, tmp_path / "whole")
    with join_processes() as own:
        for _ in islice(Run(config, tmp_path / "parts", None, own).steps(), 3):
            pass  # the checkpoint is of step 2: the third step is lost and made again
    assert [entry["step"] for entry in log_of(tmp_path / "parts")] == [1, 2, 3]
    reported = []
    train(config, tmp_path / "parts", report=reported.append)
    assert [entry.step for entry in reported] == [3, 4]
    assert same_weights(tmp_path / "whole", tmp_path / "parts")
    losses = [[entry["losses"] for entry in log_of(tmp_path / which)] for which in ("whole", "parts")]
    assert losses[0] == losses[1]
    assert bool(losses[0][-1]["discriminator"]) == bool(losses[0][-1]["adversarial"]) == bool(adversarial)
    train(config, tmp_path / "parts", report=reported.append)
    assert len(reported) == 2, "a complete run has nothing left to do"


def test_checkpoints_are_due_by_time(tiny, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("viewmend.training.loop.time.monotonic", lambda: now[0])
    clock = RunClock(replace(tiny, checkpoint_minutes=2.0), 0, 0.0)
    due = []
    for seconds in (0, 119, 1):
        now[0] += seconds
        due.append(clock.checkpoint_due())
    clock.note_checkpoint()
    assert due == [False, False, True] and not clock.checkpoint_due()
    now[0] += 60 * 3
    assert RunClock(replace(tiny, minutes=10.0), 0, 30.0).progress(0) == pytest.approx(0.05)


def test_a_run_that_is_stopped_loses_no_step(tiny, whole, tmp_path):
    reported = []
    train(tiny, tmp_path / "parts", report=reported.append, stopped=lambda: bool(reported))
    assert [entry.step for entry in reported] == [1]
    train(tiny, tmp_path / "parts", report=reported.append)
    assert [entry.step for entry in reported] == [1, 2, 3, 4] and same_weights(whole, tmp_path / "parts")


def test_a_run_resumes_only_with_its_own_config_and_a_whole_file(tiny, tmp_path):
    train(replace(tiny, steps=1), tmp_path)
    other = with_options(replace(tiny, batch=3, learning_rate=1.0), adversarial=0.5)
    with pytest.raises(RunError, match=r"differs in objective\.adversarial, batch;"):
        train(with_options(other, adversarial=0.5), tmp_path)
    whole = (tmp_path / CHECKPOINT).read_bytes()
    (tmp_path / CHECKPOINT).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RunError, match=r"run\.safetensors: expected a run to resume"):
        train(tiny, tmp_path)


def test_a_run_may_go_on_with_a_lower_learning_rate(tiny, tmp_path):
    """As the messages advise after a loss that is not finite."""
    train(replace(tiny, steps=2), tmp_path)
    train(replace(tiny, steps=4, learning_rate=1e-6), tmp_path)
    rates = [entry["learning_rate"] for entry in log_of(tmp_path)]
    assert len(rates) == 4 and 0 < max(rates[2:]) <= 1e-6 < min(rates[:2])


def test_processes_resume_only_from_the_same_checkpoint(tiny, tmp_path):
    class WithAnother(Processes):
        """This process, and one that found no checkpoint."""

        def maximum(self, *values):
            return [max(value, 0.0) for value in values]

    own = WithAnother(0, 1, torch.device("cpu"))
    assert Run(tiny, tmp_path, None, own).state.step == 0
    train(replace(tiny, steps=1), tmp_path)
    with pytest.raises(ValueError, match="same checkpoint in all processes, got steps 0 to 1"):
        Run(tiny, tmp_path, None, own)


def test_parameters_without_a_gradient_need_no_moments_to_resume(tiny, tmp_path):
    """E2FGVI on single views never uses some of its layers."""

    def make():
        net = nn.ModuleDict({"used": nn.Linear(2, 2), "unused": nn.Linear(2, 2)})
        return net, torch.optim.Adam(net.parameters())

    net, optimizer = make()
    net["used"](torch.ones(1, 2)).sum().backward()
    optimizer.step()
    state = RunState(step=1, elapsed_s=0.0, positions=())
    save_run(tmp_path, tiny, state, {"model": net}, {"optimizer": optimizer})
    other, other_optimizer = make()
    found = load_run(tmp_path / CHECKPOINT, tiny, {"model": other}, {"optimizer": other_optimizer})
    assert found == state and torch.equal(other["used"].weight, net["used"].weight)
    assert other_optimizer.state_dict()["state"].keys() == {0, 1}


@pytest.mark.parametrize(("has_units", "precision"), [(True, torch.bfloat16), (False, torch.float32)])
def test_automatic_precision_is_the_faster_one_and_a_run_resumes_where_the_other_is(
    tiny, tmp_path, monkeypatch, has_units, precision
):
    automatic = replace(tiny, precision="auto", steps=1)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": not has_units})
    train(automatic, tmp_path)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": has_units})
    with join_processes() as own:
        run = Run(automatic, tmp_path, None, own)
    assert run.state.step == 1
    assert run.model.compute_dtype == precision


def test_the_previous_checkpoint_is_kept_and_used_if_the_last_is_missing(tiny, whole, tmp_path, every_two):
    train(tiny, tmp_path / "parts")
    (tmp_path / "parts" / CHECKPOINT).write_bytes(b"damaged")
    with pytest.raises(RunError, match="remove the file to resume from the checkpoint before"):
        train(tiny, tmp_path / "parts")
    (tmp_path / "parts" / CHECKPOINT).unlink()
    reported = []
    train(tiny, tmp_path / "parts", report=reported.append)
    assert [entry.step for entry in reported] == [3, 4] and same_weights(whole, tmp_path / "parts")


def test_weights_that_are_not_finite_never_replace_good_ones(tiny, tmp_path, monkeypatch):
    train(replace(tiny, steps=2), tmp_path)
    before = {name: (tmp_path / name).read_bytes() for name in (CHECKPOINT, "model.safetensors")}
    monkeypatch.setattr(
        torch.optim.AdamW, "step", lambda self: self.param_groups[0]["params"][0].data.fill_(torch.inf)
    )
    with pytest.raises(FloatingPointError, match="expected finite"):
        train(replace(tiny, steps=3), tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in before} == before


def test_averages_forget_the_beginning_and_then_follow_slowly(tiny, tmp_path):
    with join_processes() as own:
        run = Run(replace(tiny, ema=0.9, learning_rate=0.01), tmp_path, None, own)
        seen = [
            [weight.detach().clone() for weight in run.model.parameters()] for _ in islice(run.steps(), 2)
        ]
        for average, first, second in zip(run.averaged.parameters(), *seen, strict=True):
            assert torch.allclose(average, 2 / 11 * first + 9 / 11 * second, atol=1e-6), "faster at first"
    late = torch.tensor([0.0])
    averaging(0.998)([late], [torch.tensor([1.0])], 10**6)
    assert float(late) == pytest.approx(0.002, rel=1e-3)


def test_gradients_are_clipped(tiny, tmp_path, monkeypatch):
    """To so small a norm here that Adam's epsilon outweighs them."""
    moved = {}
    for norm in (1e-12, 1.0):
        monkeypatch.setattr(PaperObjective, "max_grad_norm", norm)
        monkeypatch.setattr("viewmend.training.objective.WEIGHT_DECAY", 0.0)
        with join_processes() as own:
            run = Run(tiny, tmp_path / str(norm), None, own)
            before = [weight.detach().clone() for weight in run.trained]
            list(islice(run.steps(), 1))
            moved[norm] = max(
                float((a.detach() - b).abs().max()) for a, b in zip(run.trained, before, strict=True)
            )
    assert moved[1e-12] < 0.01 * moved[1.0]


def test_gradients_of_parts_of_a_batch_add_up_to_those_of_the_batch(tiny, tmp_path, monkeypatch):
    gradients, losses, passes = {}, {}, []
    forward = PaperObjective.forward
    monkeypatch.setattr(
        PaperObjective, "forward", lambda self, batch: passes.append(len(batch)) or forward(self, batch)
    )
    for size in (None, 2):
        config = replace(with_options(tiny, adversarial=0.01), batch=3, new_per_batch=3, microbatch=size)
        with join_processes() as own:
            run = Run(config, tmp_path / str(size), None, own)
            (first,) = islice(run.steps(), 1)
        gradients[size] = torch.cat([weight.grad.flatten() for weight in run.trained])
        losses[size] = first.losses
    assert passes == [3, 2, 1]
    torch.testing.assert_close(gradients[2], gradients[None], rtol=1e-3, atol=1e-6)
    assert losses[2] == pytest.approx(losses[None], rel=1e-4)


def test_a_run_interrupted_before_its_first_checkpoint_starts_again(tiny, tmp_path):
    def interrupt(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tiny, tmp_path, report=interrupt)
    assert len(log_of(tmp_path)) == 1 and not (tmp_path / CHECKPOINT).exists()
    train(tiny, tmp_path)
    assert [entry["step"] for entry in log_of(tmp_path)] == [1, 2, 3, 4]


def test_a_checkpoint_whose_values_do_not_fit_is_refused(tiny, tmp_path):
    train(replace(tiny, steps=1), tmp_path)
    with safe_open(tmp_path / CHECKPOINT, framework="pt") as file:
        metadata = file.metadata()
        whole = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    moment = next(key for key in whole if key.startswith("optimizer/"))
    weight = next(key for key in whole if key.startswith("model/"))
    state = json.dumps({"step": 1, "elapsed_s": 0.0})
    for tensors, header in (
        ({key: value for key, value in whole.items() if key != moment}, metadata),
        ({key: value for key, value in whole.items() if key != weight}, metadata),
        (whole | {weight: torch.zeros(3, 3, 3)}, metadata),
        (whole, metadata | {"state": state}),
    ):
        save_file(tensors, tmp_path / CHECKPOINT, header)
        with pytest.raises(RunError, match="expected a run of this version"):
            train(replace(tiny, steps=2), tmp_path)


def test_a_complete_run_writes_its_model_again(tiny, tmp_path):
    train(replace(tiny, steps=1), tmp_path)
    before = (tmp_path / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(before[:100])
    train(replace(tiny, steps=1), tmp_path)
    assert (tmp_path / "model.safetensors").read_bytes() == before


def test_a_loss_that_is_not_finite_ends_the_run_and_saves_its_batch(tiny, tmp_path, monkeypatch):
    class Broken(PatchTransformer):
        def __init__(self, config):
            super().__init__(config)
            next(self.decoder.parameters()).data.fill_(torch.nan)

    monkeypatch.setattr("viewmend.training.paper.PatchTransformer", Broken)
    with pytest.raises(FloatingPointError, match="at step 0"):
        train(tiny, tmp_path)
    saved = sorted((tmp_path / "not-finite-000000").iterdir())
    assert len(saved) == 1, "the buffer is empty at the first batch"
    assert sample_from_bytes(saved[0].read_bytes()).view.error.any()
    assert not (tmp_path / CHECKPOINT).exists()


def test_validation_scores_the_averaged_weights_and_writes_an_image(tiny, tmp_path):
    train(replace(tiny, validate_every=3), tmp_path)
    logged = [entry for entry in log_of(tmp_path) if "validation" in entry]
    assert [entry["step"] for entry in logged] == [0, 3, 4]
    with join_processes() as own:
        validation = Run(tiny, tmp_path / "other", None, own).objective.validation
    model, found, telea = load_network(tmp_path).eval(), [], Telea()
    samples = (sample for number in range(9) for sample in validation.scenes.scene(number))
    for sample in islice(samples, tiny.validation_views):
        with torch.no_grad():
            completed = model([sample.view], [list(sample.context)])[0].composited.clamp(0, 1)
        filled, _ = telea.step_on(
            "white", sample.view, ContextProvider(lambda *_: None), telea.initial_state()
        )
        truth, holes = true_image(sample, "white"), sample.view.error > 0
        off = [(rgb - truth)[:, holes] for rgb in (completed, composite("white", filled.rgb, filled.opacity))]
        found.append([-10 * float(each.square().mean().log10()) for each in off])
    expected = torch.tensor(found).mean(0).tolist()
    assert [logged[-1]["validation"][name] for name in ("holes", "telea")] == pytest.approx(
        expected, abs=2e-3
    )
    assert logged[0]["validation"]["telea"] == logged[1]["validation"]["telea"], "the views are fixed"
    assert sorted(p.name for p in tmp_path.glob("*.png")) == [
        f"validation-{step:06d}.png" for step in (0, 3, 4)
    ]
