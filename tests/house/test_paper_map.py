"""What docs/paper-map.md names is there."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
NAMED = re.compile(r"`([\w/]+\.py)(?:: (\w+))?`")


def names_of(path: Path) -> set[str]:
    """Functions, classes and methods of a file."""
    kinds = (ast.FunctionDef, ast.ClassDef)
    return {node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kinds)}


def wrong(text: str) -> list[str]:
    """What a map names, and is not in src."""
    found = []
    for file, name in NAMED.findall(text):
        path = ROOT / "src/viewmend" / file
        if not path.is_file() or (name and name not in names_of(path)):
            found.append(f"{file}: {name}")
    return found


def test_every_file_and_function_of_the_map_is_there():
    text = (ROOT / "docs/paper-map.md").read_text()
    assert len(NAMED.findall(text)) > 40
    assert wrong(text) == []


def test_a_renamed_function_is_seen():
    assert wrong("| 1 | x | `stream.py: Strom`, `nowhere.py`, `stream.py: Stream` |") == [
        "stream.py: Strom",
        "nowhere.py: ",
    ]
