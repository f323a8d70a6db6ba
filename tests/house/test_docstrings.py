"""A docstring stands by itself; those of `viewmend.__all__` are contracts with an example that runs."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

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
    continues = re.compile(r"[a-z]+(?![\w.(=\[/*-])")  # a plain word in lower case, no name and no z-depth
    return [line for line, text in docstrings(ast.parse(source)) if goes_on.search(text) or continues.match(text)]


def test_no_docstring_goes_on_in_the_next():
    found = [
        f"{p.relative_to(SRC)}:{line}" for p in sorted(SRC.rglob("*.py")) for line in half_sentences(p.read_text())
    ]
    assert found == [], "say it in whole sentences"


def test_half_sentences_are_seen():
    fields = {"x": "How many,", "y": "and of what.", "z": "z-depth.", "w": "One; two."}
    source = "".join(f'{name} = 1\n"""{text}"""\n' for name, text in fields.items())
    assert half_sentences(source) == [2, 4]
