"""Command lines that override a named recipe: every field of the recipe is an option, and its default the recipe's."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, TypeVar

import tyro

from viewmend.inpainting.config import InpainterConfig
from viewmend.training.plan import DataPlan, Recipe
from viewmend.training.recipes import RECIPES, for_model

if TYPE_CHECKING:
    from viewmend.training.baseline_run import BaselineRecipe

Options = TypeVar("Options")
DEFAULT = "small"
STARTED = ("small", "finetune")
"""Recipes that begin with the shipped small model where no other is named."""


def parse(options: Callable[..., Options], arguments: Sequence[str], prog: str) -> Options:
    """The options of a command whose first word is a recipe (`small` where there is none).

    Args:
        options: makes the command's options; its `recipe` is a `Recipe`.
        arguments: the command line, without the command.
        prog: the command, for its help.

    Raises:
        ValueError: no such recipe, or one of its values is impossible.
    """
    named = bool(arguments) and not arguments[0].startswith("-")
    name, rest = (arguments[0], arguments[1:]) if named else (DEFAULT, arguments)
    words = [part for word in rest for part in (word.split("=", 1) if word.startswith("--from=") else [word])]
    start = next((after for word, after in pairwise(words) if word == "--from"), None)
    flags = (tyro.conf.FlagCreatePairsOff, tyro.conf.AvoidSubcommands)
    default = options(recipe=_named(name, start))
    found = tyro.cli(type(default), args=list(rest), default=default, prog=f"{prog} {name}", config=flags)
    return replace(found, recipe=_checked(found.recipe))  # pyright: ignore


def started_from(recipe: Recipe, start: str | None) -> str | None:
    """What a recipe begins with: what was named, or for some the shipped small model."""
    return start or ("small" if recipe.name in STARTED else None)


def _named(name: str, start: str | None) -> "Recipe | BaselineRecipe":
    """The recipe of this name before anything is overridden; `finetune` is of the model that it begins with."""
    if name in RECIPES:
        recipe = RECIPES[name](DataPlan())
        if name != "finetune":
            return recipe
        from viewmend.inpainting.checkpoint import load_config

        model = load_config(start or "small")
        if not isinstance(model, InpainterConfig):
            raise ValueError(f"expected a model with a transformer for finetune, got '{start}'; go on with `views`")
        return replace(recipe, model=model, data=for_model(model, recipe.data))
    from viewmend.baselines.published import NETWORKS
    from viewmend.training.baseline_run import baseline_recipe

    if name not in NETWORKS:
        raise ValueError(f"expected a recipe among {', '.join((*RECIPES, *NETWORKS))}, got '{name}'; see --help")
    return baseline_recipe(name, DataPlan(), started=start is not None)


def _checked(recipe: Recipe) -> Recipe:
    """The recipe, unless it cannot be run here."""
    from viewmend.cli.checks import check_device, check_people

    data = recipe.data
    if recipe.name == "finetune" and not (data.captures or data.shards):
        raise ValueError("expected --captures DIR for finetune, got none; name the folder of your capture")
    if not 4 <= data.cameras[0] <= data.cameras[1] <= 60:
        raise ValueError(f"expected --cameras of 4 to 60, the fewer first, got {data.cameras}; for example 6 8")
    check_people(data.performers, data.motions)
    check_device(data.data_device)
    return recipe
