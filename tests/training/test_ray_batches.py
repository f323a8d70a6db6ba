"""Looked-up pixels are all that the ray reader learns from, and say the same as the samples they come from."""

from dataclasses import replace

import pytest
import torch

from viewmend.inpainting.chain import build
from viewmend.inpainting.ray_sampling import RayFeatures
from viewmend.training.loop import train
from viewmend.training.losses import image_loss
from viewmend.training.ray_batches import MOST_BLIND, RayBatch, RayBatchScenes, RaysObjective, augmented
from viewmend.training.sample_files import ShardError, ShardScenes, sample_from_bytes, sample_to_bytes, write_shards
from viewmend.training.samples import Sample
from viewmend.training.scenes import StudioScenes

EVERY_PX = 10**6


def test_they_cost_what_the_fill_of_the_whole_sample_costs(tiny):
    torch.manual_seed(0)
    model, source = build(tiny.model), StudioScenes(tiny.data, "0")
    samples = source.scene(0)
    lookups = RayBatchScenes(source, "0", EVERY_PX).scene(0)
    assert len(samples) == len(lookups) > 1
    with torch.no_grad():
        outcome = RaysObjective(model, tiny)(lookups)
        filled = model.coarse([s.view for s in samples], [s.ray_views for s in samples])
    nowhere = [torch.zeros_like(s.view.error) for s in samples]
    missing = [(s.view.error > 0).float() for s in samples]
    expected = image_loss(filled, nowhere, missing, [s.truth.float() / 255 for s in samples])
    assert float(outcome.image.inside) == pytest.approx(float(expected.inside), abs=2e-3)
    assert float(outcome.image.log_error) == pytest.approx(float(expected.log_error), abs=2e-2)
    assert not outcome.image.outside


def test_a_number_always_gives_the_same_few_pixels_and_seeds_others(tiny):
    source = StudioScenes(tiny.data, "0")
    first, again, other = (RayBatchScenes(source, seed, 20).scene(0) for seed in ("0", "0", "1"))
    assert [len(lookups.truth) for lookups in first] == [20] * len(first)
    assert [sample_to_bytes(a) for a in first] == [sample_to_bytes(b) for b in again]
    assert [sample_to_bytes(a) for a in first] != [sample_to_bytes(b) for b in other]


def test_they_are_kept_in_shards_and_train_rays_alone(tiny, tmp_path):
    source = RayBatchScenes(StudioScenes(tiny.data, "0"), "0", 20)
    lookups = source.scene(0)
    assert all(sample_to_bytes(sample_from_bytes(sample_to_bytes(x))) == sample_to_bytes(x) for x in lookups)
    shards = tmp_path / "shards"
    list(write_shards(lookups, shards))
    again = RayBatchScenes(ShardScenes(shards, "0", (Sample, RayBatch)), "0", 5).scene(0)
    assert {sample_to_bytes(x) for x in again} == {sample_to_bytes(x) for x in lookups}, "as they were looked up"
    recipe = replace(tiny, part="rays", data=replace(tiny.data, shards=shards), steps=2)
    assert (train(recipe, tmp_path / "rays") / "model.safetensors").exists()
    with pytest.raises(ShardError, match=r"shard-00000\.tar: expected Sample, got RayBatch; make samples"):
        train(replace(recipe, part="patches"), tmp_path / "patches")


def test_variations_are_what_other_cameras_in_another_light_might_have_seen(tiny):
    """A reader that only copies the smooth guess is as right as before, but for light."""
    for lookups in RayBatchScenes(StudioScenes(tiny.data, "0"), "0", 20).scene(0):
        truth, guess = lookups.truth.float(), lookups.around[:, 5:, 5, 5].float()
        for seed in range(8):
            torch.manual_seed(seed)
            other = augmented(lookups)
            gain = float(other.truth.float().sum() / truth.sum())
            assert 0.59 < gain <= 1.01
            error = (other.around[:, 5:, 5, 5].float() - other.truth.float()).square().sum(1)
            assert torch.allclose(error, gain**2 * (guess - truth).square().sum(1), rtol=0.05, atol=60)
            left = other.features[..., 8].amax((0, 1)) > 0
            assert left.any() and bool((left | (lookups.features[..., 7].amax((0, 1)) == 0)).all()), "chosen ones stay"
            kept = other.features[..., left, :]
            assert torch.equal(kept[..., 3:10], lookups.features[..., left, 3:10])
            total, before = (f[..., [0, 1, 2]].float().sum() for f in (kept, lookups.features[..., left, :]))
            assert float(total / before.clamp_min(1)) == pytest.approx(gain, abs=0.03)
    torch.manual_seed(1)
    again = [augmented(lookups) for _ in range(2)]
    assert sample_to_bytes(again[0]) != sample_to_bytes(again[1])


def test_some_cameras_see_nothing_but_never_those_that_coloured_the_view(tiny):
    plan = replace(tiny.data, shards=None, clip_length=1, cameras=(8, 8), ray_views=6, context_cameras=(2,))
    lookups = RayBatchScenes(StudioScenes(replace(plan, context_weights=(1,)), "0"), "0", 20).scene(0)[0]
    seeing = lambda batch: (batch.features != 0).flatten(0, 1).any(0).any(-1)  # noqa: E731
    chosen = (RayFeatures.unstack(lookups.features).is_source > 0).flatten(0, 1).any(0)[:, 0]
    assert int(chosen.sum()) == 2 and bool(seeing(lookups).all())
    lost = []
    for seed in range(60):
        torch.manual_seed(seed)
        left = seeing(augmented(lookups))
        assert bool(left[chosen].all())
        lost.append(int((~left).sum()))
    assert 0.1 < sum(count > 0 for count in lost) / len(lost) < 0.45, "of three tenths of the samples"
    assert 1 < max(lost) <= MOST_BLIND
