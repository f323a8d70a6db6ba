"""The page's JavaScript stays easy to read: `javascript_counts.py` finds none of the patterns that it counts."""

from collections import Counter

import pytest
from conventions.javascript_counts import COLUMNS, PAGE, count_file, strip_text
from conventions.line_counts import count_folders, format_table


def test_scripts_stay_easy_to_read():
    counts = count_folders(PAGE, ".js", count_file)
    total = sum(counts.values(), Counter[str]())
    assert total["lines"] > 3_000
    found = {name: total[name] for name in COLUMNS if name != "lines" and total[name] > 0}
    assert found == {}, f"\n{format_table(counts, COLUMNS)}"


@pytest.mark.parametrize(
    "name, counted, accepted",
    [
        ("parallel", "const [a, b] = [x, y];", "const [a, b] = pair;"),
        ("parallel", "let a;\n[a, b] = [x,\n  [y]];", "const [a, b] = [x, y].map((n) => n + 1);"),
        ("declarations", "let a = 1, b = 2;", "let a = f(1, 2);"),
        (
            "declarations",
            "for (let a = 0, b = 0; a < 2; a++) f();",
            "for (const [a, b] of [[1, 2]]) f(a, b);",
        ),
        ("declarations", "const { a, b } = x,\n  c = 1;", "const { a, b } = x;\nconst c = [1, 2];"),
        ("statements", "a(); b();", "for (a = 0; a < 2; a++) b(); // once; twice"),
        ("statements", "if (a) { b(); c(); }", "const a = () => { b(); };"),
        ("nested", "a ? b : c ? d : e;", "f(a ? b : c, d ? e : g);"),
        ("nested", "a ? (b) : c?.d ? e : f;", "a ? b?.c ?? d : e;"),
        ("late_constants", "function f() {}\nconst A = 1;", "const A = 1;\nfunction f() {}"),
        ("late_constants", "const f = (a) => a;\nconst A = 1;", "const A = (1);\nconst f = () => 1;"),
        ("long_lines", "a = " + "1" * 107, "a = " + "1" * 106),
    ],
)
def test_patterns_are_counted(name: str, counted: str, accepted: str):
    assert count_file(counted)[name] == 1
    assert count_file(accepted)[name] == 0


@pytest.mark.parametrize(
    "text",
    ["// a; b", "/* a;\nb */", "'a; \\' b'", '"a; b"', "`a; ${f(`b; ${c}`)} d; e`", "f(/[/;] a; \\/b/)"],
)
def test_text_and_comments_are_not_counted(text: str):
    code = strip_text(text)
    assert ";" not in code
    assert code.count("\n") == text.count("\n")
