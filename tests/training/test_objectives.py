"""The recipes, the image losses of section 8, the ray fill's objective, and objectives from outside of the package."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from torch import nn
from training.conftest import RUN, SAMPLING, SCENES, studio_samples

from viewmend.models.checkpoint import load_network
from viewmend.models.paper.config import PaperConfig, paper, paper_small
from viewmend.models.paper.context import window_times
from viewmend.models.views.config import RaysConfig, ViewsConfig
from viewmend.models.views.pyramids import SourceCameras
from viewmend.models.views.ray_fill import RayFill
from viewmend.training.adversarial import GAN
from viewmend.training.config import ObjectiveConfig, SamplingConfig, TrainConfig
from viewmend.training.loop import train
from viewmend.training.objective import HoleValidation, ImageLoss, Objective, StepOutput, image_loss
from viewmend.training.paper import PaperObjectiveConfig, paper_image_loss
from viewmend.training.rays import RayBatch, RayBatchScenes, RaysObjectiveConfig
from viewmend.training.recipes import RECIPES, make_recipe
from viewmend.training.samples import true_image
from viewmend.training.shards import ShardError, ShardScenes, sample_to_bytes, write_shards
from viewmend.training.views import ViewsObjectiveConfig

EVERY_PIXEL = 10**6


def test_a_validation_without_holes_is_an_error(tmp_path):
    class Empty:
        def scene(self, number):
            return []

    validation = HoleValidation(Empty(), 2, lambda model, sample: sample.view.rgb, "black")
    with pytest.raises(ValueError, match="expected views with holes, got none in 100 scenes"):
        validation(nn.Linear(1, 1), tmp_path / "shown.png")


@pytest.mark.parametrize("name", RECIPES)
def test_recipes_are_consistent(name):
    config = make_recipe(name)
    assert config.name == name and config.new_per_batch <= config.batch
    model = getattr(config.objective, "model", None)
    cameras = model.num_views if isinstance(model, ViewsConfig | RaysConfig) else 0
    assert config.objective.sampling.num_ray_views == cameras


@pytest.mark.parametrize(("name", "model"), [("paper", paper), ("paper-small", paper_small)])
def test_the_recipes_of_the_paper_are_the_papers(name, model):
    config = make_recipe(name)
    objective, sampling = config.objective, config.objective.sampling
    assert (
        isinstance(objective, PaperObjectiveConfig)
        and objective.model == model()
        and objective.adversarial == 0.01
    )
    last = max(sampling.frames)
    assert set(sampling.frames) == set(window_times(last, paper())) and sampling.min_history == 6
    assert sampling.num_source_views == (3,) and sampling.num_target_frames == 1
    adversary = objective.make_objective(config, replace(objective, model=paper_small()), None).adversary
    assert adversary is not None and (adversary.loss, adversary.weight) == (GAN, 0.01)


@pytest.mark.parametrize(
    ("start", "kind", "model"),
    [
        ("views", ViewsObjectiveConfig, ViewsConfig),
        ("rays", RaysObjectiveConfig, RaysConfig),
        ("paper-small", PaperObjectiveConfig, PaperConfig),
    ],
)
def test_fine_tuning_uses_the_objective_of_its_model(start, kind, model):
    config = make_recipe("finetune", start)
    assert isinstance(config.objective, kind) and isinstance(config.objective.model, model)
    assert config.start == start and config.learning_rate < make_recipe("views").learning_rate
    assert make_recipe("finetune").start == "views"


@pytest.mark.parametrize(
    ("step", "progress", "factor"), [(5, 0.0, 0.1), (59, 0.01, 1.0), (2, 0.05, 0.5), (4, 0.1, 1.0)]
)
def test_warm_up_ends_after_its_steps_or_a_tenth_of_the_run(step, progress, factor):
    found = Objective.learning_rate_factor(None, step, progress, 60)
    cosine = 0.5 * (1 + math.cos(math.pi * progress))
    assert found == pytest.approx(factor * cosine)


def test_impossible_values_are_refused(tiny):
    for change in (
        {"new_per_batch": 0},
        {"steps": 0},
        {"minutes": float("nan")},
        {"learning_rate": 0.0},
        {"microbatch": 0},
    ):
        with pytest.raises(ValueError, match=f"{next(iter(change))} of"):
            replace(tiny, **change)


def losses_by_definition(predicted, counted, error, truth):
    """Section 8: the mean over views of the means of what is off, weighted by E and by 1 - E."""
    parts = []
    for image, included, E, target in zip(predicted, counted, error, truth, strict=True):
        off = (image - target).abs().mean(0)
        parts.append([(weight * off).sum() / weight.sum() for weight in (E, (1 - E) * (included > 0))])
    return torch.tensor(parts).mean(0)


def test_image_losses_equal_their_definition(rng):
    sizes = [(5, 7), (6, 4)]
    predicted, truth = ([torch.rand(3, *s, generator=rng) for s in sizes] for _ in range(2))
    counted = [(torch.rand(s, generator=rng) > 0.4).float() for s in sizes]
    error = [torch.rand(s, generator=rng) * (torch.rand(s, generator=rng) > 0.5) for s in sizes]
    loss, summed = (image_loss(predicted, counted, error, truth, channels) for channels in ("mean", "sum"))
    expected = losses_by_definition(predicted, counted, error, truth)
    assert torch.allclose(torch.stack([loss.inside, loss.outside]), expected, atol=1e-6)
    assert torch.allclose(torch.stack([summed.inside, summed.outside]), 3 * expected, atol=1e-5)


def test_no_hole_gives_zero_loss_and_gradient(rng):
    predicted = torch.rand(3, 4, 4, generator=rng).requires_grad_()
    none = torch.zeros(4, 4)
    loss = image_loss([predicted], [none], [none], [torch.zeros(3, 4, 4)])
    total = loss.inside + loss.outside + 0.5 * (loss.log_error - loss.log_error.detach())
    total.backward()
    assert float(total.detach()) == 0
    assert predicted.grad is not None and not predicted.grad.any()


def test_the_log_error_is_a_tenth_of_negative_psnr_in_the_holes(rng):
    predicted, truth = torch.rand(3, 6, 6, generator=rng), torch.rand(3, 6, 6, generator=rng)
    E = (torch.rand(6, 6, generator=rng) > 0.5).float()
    loss = image_loss([predicted], [E], [E], [truth])
    psnr = -10 * (predicted - truth)[:, E > 0].square().mean().log10()
    assert torch.allclose(-10 * loss.log_error, psnr, atol=0.02)


RAYS = RaysObjectiveConfig(model=RaysConfig(num_views=3), sampling=replace(SAMPLING, with_context=False))


def ray_batches(max_pixels, seed="0"):
    return RayBatchScenes(studio_samples(), seed, max_pixels).scene(0)


def test_all_rays_of_a_view_cost_the_loss_of_its_fill():
    torch.manual_seed(0)
    samples, batches = studio_samples().scene(0), ray_batches(EVERY_PIXEL)
    assert len(samples) == len(batches) > 1
    objective = RAYS.make_objective(TrainConfig(name="rays", objective=RAYS, **RUN), RAYS, None)
    with torch.no_grad():
        output = objective(batches)
        filled = [objective.model(s.view, SourceCameras.of(s.ray_views, s.view.silhouettes)) for s in samples]
    nowhere = [torch.zeros_like(s.view.error) for s in samples]
    holes = [(s.view.error > 0).float() for s in samples]
    expected = image_loss(filled, nowhere, holes, [s.truth.float() / 255 for s in samples])
    assert float(output.image.inside) == pytest.approx(float(expected.inside), abs=2e-3)
    assert float(output.image.log_error) == pytest.approx(float(expected.log_error), abs=2e-2)
    assert not output.image.outside
    expected = output.image.inside + RAYS.log_error * output.image.log_error
    assert float(output.total) == pytest.approx(float(expected))


def test_a_number_always_gives_the_same_rays():
    first, again, other = ray_batches(20), ray_batches(20), ray_batches(20, "1")
    assert [len(batch.truth) for batch in first] == [20] * len(first)
    assert [sample_to_bytes(a) for a in first] == [sample_to_bytes(b) for b in again]
    assert [sample_to_bytes(a) for a in first] != [sample_to_bytes(b) for b in other]


def test_stored_rays_train_the_ray_fill(tiny, tmp_path):
    batches, shards = ray_batches(20), tmp_path / "shards"
    list(write_shards(batches, shards))
    again = ShardScenes(shards, "0", RayBatch).scene(0)
    assert {sample_to_bytes(x) for x in again} == {sample_to_bytes(x) for x in batches}
    config = TrainConfig(
        name="rays", objective=RAYS, scenes=SCENES, shards=shards, **(RUN | {"validate_every": 4})
    )
    trained = load_network(train(config, tmp_path / "rays"))
    assert isinstance(trained, RayFill)
    assert '"holes"' in (tmp_path / "rays/log.jsonl").read_text()
    train(replace(config, steps=1), tmp_path / "more", start=trained)
    with pytest.raises(ValueError, match="expected a RayFill of the recipe's sizes"):
        train(config, tmp_path / "other", start=nn.Linear(2, 2))
    with pytest.raises(ShardError, match=r"shard-00000\.tar: expected Sample, got RayBatch"):
        train(replace(tiny, shards=shards), tmp_path / "paper")


def test_an_objective_from_outside_uses_the_same_loop(shards, tmp_path):
    """Research scripts define their own objectives; this one trains the mean colour of the views."""

    @dataclass(frozen=True, kw_only=True)
    class MeanColourConfig(ObjectiveConfig):
        sampling: SamplingConfig = SAMPLING

        @staticmethod
        def make_objective(config, options, start):
            return MeanColour(config, nn.Linear(3, 3, bias=False))

        def make_scenes(self, scenes, seed):
            return studio_samples(seed)

    class MeanColour(Objective):
        def forward(self, batch):
            colour = torch.stack([s.view.rgb.mean((1, 2)) for s in batch])
            loss = (self.model(colour) - colour).square().mean()
            return StepOutput(ImageLoss(loss, loss, loss), loss)

        def save(self, model, folder, card):
            (folder / "README.md").write_text(card)

    config = TrainConfig(name="mean", objective=MeanColourConfig(), **RUN)
    assert "# mean" in (train(config, tmp_path) / "README.md").read_text()


def test_outside_the_decoded_patches_the_paper_compares_the_view_itself(tiny):
    objective = tiny.objective.make_objective(tiny, tiny.objective, None)
    sample = studio_samples().scene(0)[0]
    truth = [true_image(sample, "white")]
    with torch.no_grad():
        [made] = objective.model([sample.view], [list(sample.context)])
        before = paper_image_loss([made], [sample.view.error], truth)
        covered = replace(made, coverage=torch.ones_like(made.coverage))
        after = paper_image_loss([covered], [sample.view.error], truth)
    assert torch.equal(before.inside, after.inside) and float(before.outside) < float(after.outside)
