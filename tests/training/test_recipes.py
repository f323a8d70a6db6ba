"""Recipes state models that exist; what cannot be is refused."""

from dataclasses import replace
from itertools import pairwise

import pytest

from viewmend.inpainting.chain import build
from viewmend.training.plan import DataPlan, LossWeights, WholeViewRecipe
from viewmend.training.recipes import RECIPES, small, small_rays
from viewmend.training.schedule import learning_rate_factor


def test_the_learning_rate_warms_up_and_ends_at_zero():
    assert learning_rate_factor(0, 0.0, 10) == pytest.approx(0.1)
    assert learning_rate_factor(100, 0.5, 10) == pytest.approx(0.5)
    assert learning_rate_factor(100, 1.0, 10) == pytest.approx(0.0)


ADVERSARIAL = LossWeights(adversarial=0.01, adversarial_kind="hinge", discriminator="clip")


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


def test_readers_learn_from_subjects_of_every_size(plan):
    for name in ("small_rays", "views"):
        sizes = RECIPES[name](plan).data.sizes_px
        steps = [larger / smaller for smaller, larger in pairwise(sizes)]
        assert len(sizes) == 4 and all(1 < step < 1.5 for step in steps), f"{name}: {sizes} leaves sizes out"


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
