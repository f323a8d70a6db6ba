"""A docstring stands by itself; those of `viewmend.__all__` are contracts with an example that runs."""

import ast
import doctest
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent
from types import FunctionType

import pytest

import viewmend

SRC = Path(__file__).resolve().parents[2] / "src"
MANY_PARAMETERS = 4
PUBLIC = [name for name in viewmend.__all__ if callable(getattr(viewmend, name)) and name != "__version__"]


def docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and text of every docstring: of modules, classes, functions, fields and constants."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            value = statement.value if isinstance(statement, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield statement.lineno, value.value.strip()


def half_sentences(source: str) -> list[int]:
    """Lines of docstrings that go on in the next one, or go on with the one before."""
    goes_on = re.compile(r"[,;:]$")
    continues = re.compile(r"[a-z]+(?![\w.(=\[/*-])|(Of|And|By|Its|Their|Those)\b")  # a plain word, no name, no z-depth
    return [line for line, text in docstrings(ast.parse(source)) if goes_on.search(text) or continues.match(text)]


def test_no_docstring_goes_on_in_the_next():
    found = [
        f"{p.relative_to(SRC)}:{line}" for p in sorted(SRC.rglob("*.py")) for line in half_sentences(p.read_text())
    ]
    assert found == [], "say it in whole sentences"


def test_half_sentences_are_seen():
    fields = {"x": "How many,", "y": "and of what.", "z": "z-depth.", "w": "One; two.", "v": "Of x."}
    source = "".join(f'{name} = 1\n"""{text}"""\n' for name, text in fields.items())
    assert half_sentences(source) == [2, 4, 10]


def parts(name: str, value: object) -> Iterator[tuple[str, FunctionType]]:
    """A function itself; of a class what others call of it."""
    if isinstance(value, FunctionType):
        yield name, value
    elif inspect.isclass(value):
        own = {k: f for k, f in vars(value).items() if isinstance(f, FunctionType) and f.__module__ == value.__module__}
        hidden = {"__init__"} if "__dataclass_fields__" in vars(value) else set()
        for key, inner in own.items():
            if key not in hidden and (key == "__init__" or not key.startswith("_")):
                yield f"{name}.{key}", inner


def faults(name: str, value: object) -> list[str]:
    """What a contract lacks: `Args:` from four parameters on, its errors, an example."""
    found = []
    if ">>> " not in (inspect.getdoc(value) or ""):
        found.append(f"{name} has no example")
    for part, function in parts(name, value):
        text = inspect.getdoc(function) or ""
        parameters = [p for p in inspect.signature(function).parameters if p not in ("self", "cls")]
        if len(parameters) >= MANY_PARAMETERS and "Args:" not in text:
            found.append(f"{part} has {len(parameters)} parameters and no Args:")
        raises = any(isinstance(n, ast.Raise) for n in ast.walk(ast.parse(dedent(inspect.getsource(function)))))
        if raises and "Error" not in text:
            found.append(f"{part} raises what it does not say")
    return found


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_name_is_a_contract(name):
    assert faults(name, getattr(viewmend, name)) == []


@pytest.mark.parametrize("name", PUBLIC)
def test_its_examples_run(name):
    value = getattr(viewmend, name)
    for part in doctest.DocTestFinder(recurse=False).find(value, name, module=False, globs={}):
        failed = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(part)
        assert failed.attempted and not failed.failed


def lame(first, second, third, fourth):
    """A function with too short a contract."""
    raise RuntimeError


def test_a_short_contract_is_seen():
    assert faults("lame", lame) == [
        "lame has no example",
        "lame has 4 parameters and no Args:",
        "lame raises what it does not say",
    ]
