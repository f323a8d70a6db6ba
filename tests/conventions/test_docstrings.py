"""Docstrings of `viewmend.__all__` document arguments and errors, and have an example that runs."""

import ast
import doctest
import inspect
from collections.abc import Iterator
from textwrap import dedent
from types import FunctionType

import pytest

import viewmend

MANY_PARAMETERS = 4
PUBLIC = [name for name in viewmend.__all__ if callable(getattr(viewmend, name)) and name != "__version__"]


def parts(name: str, value: object) -> Iterator[tuple[str, FunctionType]]:
    """A function itself; of a class its public methods and its constructor."""
    if isinstance(value, FunctionType):
        yield name, value
    elif inspect.isclass(value):
        own = {
            k: f
            for k, f in vars(value).items()
            if isinstance(f, FunctionType) and f.__module__ == value.__module__
        }
        hidden = {"__init__"} if "__dataclass_fields__" in vars(value) else set()
        for key, inner in own.items():
            if key not in hidden and (key == "__init__" or not key.startswith("_")):
                yield f"{name}.{key}", inner


def faults(name: str, value: object) -> list[str]:
    """What a docstring lacks: `Args:` from four parameters on, the errors it raises, an example."""
    found = []
    if ">>> " not in (inspect.getdoc(value) or ""):
        found.append(f"{name} has no example")
    for part, function in parts(name, value):
        text = inspect.getdoc(function) or ""
        parameters = [p for p in inspect.signature(function).parameters if p not in ("self", "cls")]
        if len(parameters) >= MANY_PARAMETERS and "Args:" not in text:
            found.append(f"{part} has {len(parameters)} parameters and no Args:")
        raises = any(
            isinstance(n, ast.Raise) for n in ast.walk(ast.parse(dedent(inspect.getsource(function))))
        )
        if raises and "Error" not in text:
            found.append(f"{part} raises errors that it does not document")
    return found


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_are_documented(name):
    assert faults(name, getattr(viewmend, name)) == []


@pytest.mark.parametrize("name", PUBLIC)
def test_examples_run(name):
    value = getattr(viewmend, name)
    for part in doctest.DocTestFinder(recurse=False).find(value, name, module=False, globs={}):
        failed = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(part)
        assert failed.attempted and not failed.failed


def undocumented(first, second, third, fourth):
    """A function with too short a docstring."""
    raise RuntimeError


def test_a_short_docstring_is_found():
    assert faults("undocumented", undocumented) == [
        "undocumented has no example",
        "undocumented has 4 parameters and no Args:",
        "undocumented raises errors that it does not document",
    ]
