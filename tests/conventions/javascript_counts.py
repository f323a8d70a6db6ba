"""Counts of patterns that make JavaScript hard to read, by folder of the page.

Prints them when run in the folder `tests`: `python -m conventions.javascript_counts [PAGE]`.
"""

import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from conventions.line_counts import MAX_COLUMNS, count_folders, format_table

PAGE = Path(__file__).resolve().parents[2] / "src" / "viewmend" / "live" / "page"
TOKEN = re.compile(
    r"""
    (?P<comment>//[^\n]*|/\*.*?\*/)
    | (?P<text>"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')
    | (?P<regex>(?:(?<=[(,=:&|?!>])\ ?|\breturn\ )/(?![*/])(?:\\.|\[(?:\\.|[^\]\\\n])*\]|[^/\\\n\[])+/\w*)
    | (?P<template>`)
    """,
    re.VERBOSE | re.DOTALL,
)
"""What is not code: comments, strings, regular expressions, and the beginning of a template."""
DECLARATION = re.compile(r"\b(?:const|let|var)\b")
CONDITIONAL = re.compile(r"\?(?![.?])(?<!\?\?)")
"""The question mark of `a ? b : c`, not that of `?.` or `??`."""
FUNCTION = re.compile(
    r"^(?:export )?(?:(?:async )?function\b|class\b|const \w+ = (?:async )?\([^()]*\) =>)", re.MULTILINE
)
"""The beginning of a function or class at the top level; its parameters contain no brackets."""
CONSTANT = re.compile(r"^(?:export )?const [A-Z][A-Z0-9_]* =", re.MULTILINE)
"""The beginning of a constant at the top level."""
OPENING = "([{"
CLOSING = ")]}"
COLUMNS = {
    "lines": "non-blank lines",
    "parallel": "assignments of an array literal to several names",
    "declarations": "declarations of several names in one statement",
    "statements": "lines with several statements",
    "nested": "conditional operators within another one",
    "late_constants": "files with constants after the first function or class",
    "long_lines": f"lines over {MAX_COLUMNS} columns",
}
"""The counts, and what each counts."""


def count_file(source: str) -> Counter[str]:
    """Count the patterns in the source of a file."""
    code = strip_text(source)
    lines = [line for line in source.splitlines() if line.strip()]
    return Counter(
        lines=len(lines),
        parallel=sum(is_parallel(code, match.end()) for match in re.finditer(r"\]\s*=\s*(?=\[)", code)),
        declarations=sum(declares_several(code, match.end()) for match in DECLARATION.finditer(code)),
        statements=sum(has_several_statements(line) for line in code.splitlines()),
        nested=count_nested(code),
        late_constants=has_late_constants(code),
        long_lines=sum(len(line) > MAX_COLUMNS for line in lines),
    )


def strip_text(source: str) -> str:
    """The source without comments, and with empty strings, so that only code is left; lines stay lines."""
    parts = []
    position = 0
    while match := TOKEN.search(source, position):
        parts.append(source[position : match.start()])
        position = match.end()
        if match.lastgroup == "template":
            position = end_of_template(source, position)
        if match.lastgroup != "comment":
            parts.append('""')
        parts.append("\n" * source.count("\n", match.start(), position))
    parts.append(source[position:])
    return "".join(parts)


def end_of_template(source: str, position: int) -> int:
    """The position after a template literal, whose text begins at `position`."""
    while source[position] != "`":
        if source[position] == "\\":
            position += 1
        elif source.startswith("${", position):
            position = end_of_expression(source, position + 2)
        position += 1
    return position + 1


def end_of_expression(source: str, position: int) -> int:
    """The position of the brace that closes the expression of a template, which begins at `position`."""
    depth = 0
    while depth > 0 or source[position] != "}":
        if source[position] == "`":
            position = end_of_template(source, position + 1)
            continue
        depth += {"{": 1, "}": -1}.get(source[position], 0)
        position += 1
    return position


def walk_brackets(code: str, start: int) -> Iterator[tuple[int, str, int]]:
    """Positions from `start`, their characters, and the number of brackets that are open after each."""
    depth = 0
    for position in range(start, len(code)):
        character = code[position]
        depth += (character in OPENING) - (character in CLOSING)
        yield position, character, depth


def is_parallel(code: str, start: int) -> bool:
    """Whether the array literal at `start` is all that is assigned; `[a, b] = [x, y].map(f)` has one value."""
    end = next(position for position, _, depth in walk_brackets(code, start) if depth == 0)
    return not re.match(r"\s*[.\[(]", code[end + 1 :])


def declares_several(code: str, start: int) -> bool:
    """Whether the declaration whose keyword ends at `start` has more than one name or pattern."""
    for _, character, depth in walk_brackets(code, start):
        if depth < 0 or (depth == 0 and character == ";"):
            return False
        if depth == 0 and character == ",":
            return True
    return False


def has_several_statements(line: str) -> bool:
    """Whether code follows a semicolon that is not in the head of a `for`."""
    depth = 0
    for position, character in enumerate(line):
        depth += (character == "(") - (character == ")")
        if character == ";" and depth == 0 and line[position + 1 :].strip(" \t})],;"):
            return True
    return False


def count_nested(code: str) -> int:
    """Count the conditional operators that another one of the same expression precedes."""
    marks = {match.start() for match in CONDITIONAL.finditer(code)}
    found = 0
    pending = [0]
    for position, character, _ in walk_brackets(code, 0):
        if character in OPENING:
            pending.append(0)
        elif character in CLOSING:
            pending.pop()
        elif character in ",;":
            pending[-1] = 0
        elif position in marks:
            found += pending[-1] > 0
            pending[-1] += 1
    return found


def has_late_constants(code: str) -> int:
    """Whether a constant follows the first function or class, as a number."""
    definition = FUNCTION.search(code)
    return int(definition is not None and CONSTANT.search(code, definition.end()) is not None)


if __name__ == "__main__":
    page = Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE
    print(format_table(count_folders(page, ".js", count_file), COLUMNS))
