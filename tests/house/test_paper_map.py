"""What docs/paper-map.md names is there."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
NAMED = re.compile(r"`([\w/]+\.py)(?:: (\w+))?`(?: \| `(.+)` \|$)?", re.MULTILINE)
"""A file, a name in it, and in the table of equations a line of that, or two."""


def sources_of(path: Path) -> dict[str, str]:
    """The source of the functions, classes and methods of a file by name; those of one name, one after the other."""
    found, text = dict[str, str](), path.read_text()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = found.get(node.name, "") + (ast.get_source_segment(text, node) or "")
    return found


def stands(part: str, source: str) -> bool:
    """Whether it is in a line of the source, and does not break off within a sum."""
    ends = (line.partition(part)[2].lstrip() for line in source.splitlines() if part in line)
    return any(not end.startswith(("+", "-")) for end in ends)


def wrong(text: str) -> list[str]:
    """What a map names, and is not in src."""
    found = []
    for file, name, line in NAMED.findall(text):
        path = ROOT / "src/viewmend" / file
        sources = sources_of(path) if path.is_file() else {}
        lines = line.split("`, `") if line else []
        there = all(stands(part, sources.get(name, "")) for part in lines)
        if not path.is_file() or (name and name not in sources) or not there:
            found.append(f"{file}: {name}")
    return found


def without_a_line(text: str) -> list[str]:
    """The equations that do not tell their line."""
    rows = [row for row in text.split("## Sections")[0].splitlines() if re.match(r"\| \d", row)]
    return [row for row in rows if not any(line for _, _, line in NAMED.findall(row))]


def test_every_file_and_function_of_the_map_is_there():
    text = (ROOT / "docs/paper-map.md").read_text()
    assert len(NAMED.findall(text)) > 40
    assert wrong(text) == []
    assert without_a_line(text) == []


def test_a_renamed_function_is_seen():
    assert wrong("| 1 | x | `stream.py: Strom`, `nowhere.py`, `stream.py: Stream` |") == [
        "stream.py: Strom",
        "nowhere.py: ",
    ]


def test_a_changed_line_is_seen():
    row = "| 2 | 1 | x | `inpainting/decoder.py: blend` | `mended = error` |"
    assert wrong(row) == [] == without_a_line(row)
    part = (
        "| 22 | 8 | L | `training/objective.py: Objective` | `total = weights.image * (image.inside + image.outside)` |"
    )
    assert wrong(part) == ["training/objective.py: Objective"], "the sum goes on"
    assert wrong(row.replace("mended = error", "mended = E")) == ["inpainting/decoder.py: blend"]
    assert without_a_line("| 2 | 1 | x | `inpainting/decoder.py: blend` |")
