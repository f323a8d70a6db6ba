"""Lines stay easy to read: the counts of `line_counts.py` stay below ceilings, which are only ever lowered."""

from collections import Counter
from pathlib import Path

import pytest
from conventions.line_counts import (
    COLUMNS,
    MAX_LOCALS,
    MAX_STATEMENTS,
    SRC,
    count_file,
    count_folders,
    format_table,
)

CEILINGS = {
    "parallel": 0,
    "walruses": 30,
    "prepositions": 1,
    "late_constants": 5,
    "statements": 1,
    "locals": 10,
}
"""The most of each pattern in the package."""
MAX_LONG_LINES_PERCENT = 1.5
"""The most lines over 110 columns, per cent of the non-blank lines."""


def test_lines_stay_easy_to_read():
    counts = count_folders(SRC, ".py", count_file)
    total = sum(counts.values(), Counter[str]())
    assert total["lines"] > 10_000
    above = {name: total[name] for name, ceiling in CEILINGS.items() if total[name] > ceiling}
    assert above == {}, f"\n{format_table(counts, COLUMNS)}"
    assert 100 * total["long_lines"] / total["lines"] <= MAX_LONG_LINES_PERCENT, (
        f"\n{format_table(counts, COLUMNS)}"
    )


@pytest.mark.parametrize(
    "name, counted, accepted",
    [
        ("parallel", "a, b = x, y", "a, b = pair"),
        ("walruses", "if (a := x): ...", "a = x\nif a: ..."),
        ("long_lines", "a = " + "1" * 107, "a = " + "1" * 106),
        ("prepositions", 'A = 1\n"""In metres."""', 'A = 1\n"""The distance, metres."""'),
        ("prepositions", 'def f():\n    """By hand."""', 'def f():\n    """Do it by hand."""'),
        ("late_constants", "def f(): ...\nA = 1", "A = 1\ndef f(): ...\n__all__ = []"),
        (
            "statements",
            "def f():\n" + "    g()\n" * (MAX_STATEMENTS + 1),
            'def f():\n    """Do it."""\n' + "    g()\n" * MAX_STATEMENTS,
        ),
        (
            "locals",
            "def f():\n" + "".join(f"    a{n} = {n}\n" for n in range(MAX_LOCALS + 1)),
            "def f(x):\n    b = [c for c in x]\n" + "    a = 1\n" * MAX_LOCALS,
        ),
    ],
)
def test_patterns_are_counted(name, counted, accepted):
    assert count_file(counted)[name] == 1 and count_file(accepted)[name] == 0


def test_files_are_counted_by_package(tmp_path: Path):
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "x.py").write_text("a, b = 1, 2\n")
    (tmp_path / "y.py").write_text("a = 1\n\n")
    counts = count_folders(tmp_path, ".py", count_file)
    assert {name: (found["lines"], found["parallel"]) for name, found in counts.items()} == {
        "room": (1, 1),
        "top level": (1, 0),
    }
