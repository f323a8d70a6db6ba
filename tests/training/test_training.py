"""A run trains its part, writes what it should, and goes on as if it had never been stopped."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from viewmend.baselines.classical import Telea
from viewmend.inpainting.chain import build
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.protocol import ContextProvider, State
from viewmend.training import loop, ray_batches
from viewmend.training.loop import Run, averaging, train
from viewmend.training.plan import DataPlan, LossWeights, WholeViewRecipe
from viewmend.training.processes import processes
from viewmend.training.recipes import RECIPES, small, small_rays
from viewmend.training.run_files import FILE, RunError
from viewmend.training.sample_files import sample_from_bytes
from viewmend.training.schedule import learning_rate_factor
from viewmend.training.validation import Validation


def log_of(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def same_weights(a, b):
    a, b = (load_file(folder / "model.safetensors") for folder in (a, b))
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def test_the_learning_rate_warms_up_and_ends_at_zero():
    assert learning_rate_factor(0, 0.0, 10) == pytest.approx(0.1)
    assert learning_rate_factor(100, 0.5, 10) == pytest.approx(0.5)
    assert learning_rate_factor(100, 1.0, 10) == pytest.approx(0.0)


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
    costs = [[entry["costs"] for entry in log_of(tmp_path / which)] for which in ("whole", "parts")]
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


SCRIPT = """
import sys
from dataclasses import replace
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from conftest import MODEL, PLAN
from dataclasses import replace
from viewmend.training.loop import train
from viewmend.training.plan import Recipe

plan = replace(PLAN, clip_length=2, shards=Path(sys.argv[5]))
recipe = Recipe(name="tiny", model=MODEL, data=plan, steps=int(sys.argv[3]), batch=2, new_per_batch=1, replay_size=3,
                warmup=1, workers=0, ema=0.5, bfloat16=False, checkpoint_every=1, validate_every=0,
                streams=int(sys.argv[4]))
train(recipe, Path(sys.argv[2]))
"""


def started(out, steps, shards, streams=1, launcher=()):
    script = out.with_suffix(".py")
    script.write_text(SCRIPT)
    here = str(Path(__file__).parent)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "JAXTYPING_DISABLE": "1"}
    command = [sys.executable, *launcher, str(script), here, str(out), str(steps), str(streams), str(shards)]
    with out.with_suffix(".log").open("w") as log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=log)


def test_a_killed_run_goes_on_from_a_whole_checkpoint(shards, tmp_path):
    run = started(tmp_path / "killed", 1000, shards)
    while not (tmp_path / "killed" / FILE).exists():
        assert run.poll() is None
        time.sleep(0.02)
    time.sleep(0.3)
    run.send_signal(signal.SIGKILL)
    run.wait()
    before = len(log_of(tmp_path / "killed"))
    assert started(tmp_path / "killed", before + 1, shards).wait() == 0
    assert started(tmp_path / "whole", before + 1, shards).wait() == 0
    # The cosine of a run of other steps is another: only that it went on, with every step in the log once.
    assert [entry["step"] for entry in log_of(tmp_path / "killed")] == list(range(1, before + 2))
    assert [e["costs"] for e in log_of(tmp_path / "killed")][:1] == [e["costs"] for e in log_of(tmp_path / "whole")][:1]


def test_two_processes_make_the_loss_curve_of_one_with_the_double_batch(shards, tmp_path):
    torchrun = ("-m", "torch.distributed.run", "--nproc-per-node=2", "--standalone")  # on any free port
    assert started(tmp_path / "one", 4, shards, streams=2).wait() == 0
    two = started(tmp_path / "two", 4, shards, launcher=torchrun)
    assert two.wait() == 0, (tmp_path / "two.log").read_text()[-3000:]
    one, two = (load_file(tmp_path / n / "model.safetensors") for n in ("one", "two"))
    for key in one:
        assert torch.allclose(one[key], two[key], atol=2e-5), key
    curves = [[e["costs"]["total"] for e in log_of(tmp_path / n)] for n in ("one", "two")]
    assert curves[0] == pytest.approx(curves[1], rel=1e-4)
    assert len(set(curves[0])) == 4


def test_recipes_state_models_that_exist_and_losses_that_fit(plan):
    for name, make in RECIPES.items():
        recipe = make(plan)
        if isinstance(recipe, WholeViewRecipe):
            cameras = recipe.model.num_views
        else:
            cameras = recipe.model.num_ray_views if recipe.model.coarse_fill == "rays" else 0
        assert recipe.name == name and recipe.data.ray_views == cameras
    assert small(plan).part == "patches" and small_rays(plan).part == "rays"
    parameters = sum(p.numel() for p in build(RECIPES["base"](plan).model).parameters())
    assert parameters < 40e6
    assert RECIPES["paper"](plan).loss == LossWeights(adversarial=0.01, channels="sum", outside="image"), (
        "the paper's objective, exactly"
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"loss": ADVERSARIAL, "data": DataPlan()}, "expected clips of 2 or more"),
        ({"loss": LossWeights(adversarial=0.01), "part": "rays"}, "expected no adversarial loss for rays alone"),
        ({"new_per_batch": 0}, "new_per_batch of 0"),
    ],
)
def test_a_recipe_that_cannot_be_is_refused(change, message, tiny):
    with pytest.raises(ValueError, match=message):
        replace(tiny, **change)


def test_what_a_step_draws_follows_from_its_number_alone(tiny, tmp_path):
    """Whoever draws between the steps changes nothing; the steps themselves draw differently."""
    recipe = replace(tiny, part="rays", augment=True, steps=3, checkpoint_every=100)
    drawn, augment = [], ray_batches.augmented

    def noting(lookups):
        drawn.append(float(torch.rand(())))
        return augment(lookups)

    for name in ("undisturbed", "disturbed"):
        between = None if name == "undisturbed" else lambda _: torch.rand(7)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ray_batches, "augmented", noting)
            train(recipe, tmp_path / name, report=between)
    assert same_weights(tmp_path / "undisturbed", tmp_path / "disturbed")
    assert drawn[: len(drawn) // 2] == drawn[len(drawn) // 2 :] and len(set(drawn)) == len(drawn) // 2 > 3
