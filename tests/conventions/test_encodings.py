"""Text files are UTF-8 in every locale: what one machine wrote, another reads."""

import ast
from pathlib import Path

from conventions.line_counts import parse

ROOT = Path(__file__).parents[2] / "src/viewmend"
EXCEPTIONS = {"studio/bvh.py", "studio/procedural/skeleton.py"}
"""These read ASCII."""


def test_text_files_have_an_encoding():
    calls = {
        f"{name}:{node.lineno}"
        for path in ROOT.rglob("*.py")
        if (name := path.relative_to(ROOT).as_posix()) not in EXCEPTIONS
        for node in ast.walk(parse(path.read_text("utf-8")))
        if isinstance(node, ast.Call) and has_no_encoding(node)
    }
    assert calls == set()


def has_no_encoding(call: ast.Call) -> bool:
    """Whether a method of a path is called that uses the locale's encoding."""
    if not isinstance(call.func, ast.Attribute) or any(
        keyword.arg == "encoding" for keyword in call.keywords
    ):
        return False
    if call.func.attr == "open":
        return [ast.unparse(mode) for mode in call.args[:1]] in (["'r'"], ["'w'"], ["'a'"], ["'x'"])
    return len(call.args) < {"read_text": 1, "write_text": 2}.get(call.func.attr, 0)
