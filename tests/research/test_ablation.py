"""The models of Table 3: how the variants differ, and a short training of each."""

from dataclasses import fields, replace

import ablation
import pytest
import torch
from ablation import FIRST_WEIGHT, VARIANTS, Options, run, variant_recipe
from training.conftest import MODEL, SAMPLING, SCENES, studio_samples

from viewmend.evaluation.paper_tables import paper_rows
from viewmend.models.checkpoint import load_network, save_inpainter
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.training.recipes import make_recipe
from viewmend.training.shards import write_shards


@pytest.fixture
def options(tmp_path, monkeypatch):
    recipe = make_recipe("paper-small")
    small = replace(
        recipe, objective=replace(recipe.objective, model=MODEL, sampling=SAMPLING), scenes=SCENES
    )
    monkeypatch.setattr(ablation, "make_recipe", lambda name: small)
    torch.manual_seed(0)
    save_inpainter(PatchTransformer(MODEL), tmp_path / "start", "# start\n")
    return Options(
        shards=tmp_path / "shards", start=tmp_path / "start", out=tmp_path / "models", seeds=(1,), steps=1
    )


def test_the_variants_are_the_rows_of_the_paper():
    assert {row.method for row in paper_rows(3)} == set(VARIANTS)


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_differs_from_the_papers_model_as_stated(name, options):
    model = variant_recipe(name, options, 0).objective.model
    assert {f.name for f in fields(model) if getattr(model, f.name) != getattr(MODEL, f.name)} == set(
        VARIANTS[name]
    )


def test_all_variants_are_trained_from_the_same_weights(options):
    list(write_shards(studio_samples("ablation", replace(SCENES, sizes_px=(128,))).scene(0), options.shards))
    run(options)
    start = load_network(options.start).state_dict()[FIRST_WEIGHT]
    for name in VARIANTS:
        model = load_network(options.out / f"{name}-s1")
        first, channels = (
            model.state_dict()[FIRST_WEIGHT],
            [0, 1, 2, 3, 4] if "masks" not in name else [0, 1, 2, 4],
        )
        assert 0 < (first - start[:, channels]).abs().max() < 0.01
