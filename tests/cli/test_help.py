"""The help of every command is short and describes its flags as they are typed; every option is used."""

import dataclasses
import re
from functools import cache
from pathlib import Path

import pytest

from viewmend.cli import COMMANDS, main
from viewmend.training.recipes import RECIPES, make_recipe

ROOT = Path(__file__).resolve().parents[2]
WITH_RECIPES = ("train", "make-dataset")
NEGATIVE = ("do not ", "disable ", "skip ", "leave ", "ignore ", "never ", "without ")
UNCHANGED = re.compile(r"(use|take|keep|show|write) .*\bas (it is|they are)\b")
CASES = [name for name in COMMANDS if name not in WITH_RECIPES] + [
    f"{c} {r}" for c in WITH_RECIPES for r in RECIPES
]


@cache
def options_of(command: str) -> dict[str, str]:
    """The options of a command with their help."""
    import contextlib
    import io
    import os
    from unittest.mock import patch

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), patch.dict(os.environ, {"COLUMNS": "200", "NO_COLOR": "1"}):
        assert main([*command.split(), "--help"]) == 0
    found: dict[str, str] = {}
    name = ""
    for line in printed.getvalue().splitlines():
        if match := re.match(r"[\s│]+(?:-\w, )?(--[a-z][\w.-]*)(.*)", line):
            name = match[1]
            found[name] = re.sub(r"^( \S+)*?(\s{2,}|$)", "", match[2])
        elif name and re.match(r"[\s│]{8}", line):
            found[name] += " " + line
    return {name: " ".join(text.replace("│", " ").split()) for name, text in found.items()}


@pytest.mark.parametrize("command", CASES)
def test_a_negative_flag_is_described_as_typed(command):
    flags = {name: text for name, text in options_of(command).items() if re.match(r"--([\w-]+\.)?no-", name)}
    wrong = {
        n: t for n, t in flags.items() if not (t.lower().startswith(NEGATIVE) or UNCHANGED.match(t.lower()))
    }
    assert wrong == {}, "begin with a verb that says what the flag switches off"
    assert {n: t for n, t in flags.items() if "default: True" in t} == {}, (
        "a flag that is not given is not the default"
    )


@pytest.mark.parametrize("command", [case for case in CASES if case.split()[0] in WITH_RECIPES])
def test_training_commands_have_few_options(command):
    assert 10 < len(options_of(command)) < 30


def test_every_field_of_a_config_is_read():
    source = "\n".join(
        path.read_text()
        for folder in ("src/viewmend/training", "src/viewmend/models", "src/viewmend/contrib/baselines")
        for path in (ROOT / folder).rglob("*.py")
    )
    source += "\n".join(
        (ROOT / f"src/viewmend/cli/{name}.py").read_text() for name in ("train", "make_dataset")
    )

    def configs(value):
        yield type(value)
        for field in dataclasses.fields(value):
            inner = getattr(value, field.name)
            if dataclasses.is_dataclass(inner):
                yield from configs(inner)

    kinds = {kind for name in RECIPES for kind in configs(make_recipe(name))}
    assert {kind.__name__ for kind in kinds} >= {
        "TrainConfig",
        "SceneConfig",
        "SamplingConfig",
        "ViewsLossWeights",
    }
    unused = [
        f"{kind.__name__}.{field.name}"
        for kind in kinds
        for field in dataclasses.fields(kind)
        if not re.search(rf"\.{field.name}\b", source)
    ]
    assert unused == []


CARDS = sorted((ROOT / "src/viewmend/weights").glob("*/README.md"))


@pytest.mark.parametrize("card", CARDS, ids=lambda path: path.parent.name)
def test_model_cards_name_commands_and_options_that_exist(card):
    """An option belongs to the last command before it."""
    command, wrong = None, []
    for words, option in re.findall(
        r"`viewmend ([a-z-]+(?: [\w-]+)?)|(?<![\w-])(--[a-z][\w.-]*)", card.read_text()
    ):
        if words:
            command = next((c for c in (words, words.split()[0]) if c in CASES), None)
            wrong += [] if command else [words]
        elif command is None or option not in options_of(command):
            wrong.append(f"{command} {option}")
    assert wrong == []
