"""Files, functions and argument lists stay small."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MAX_FILE_LINES, MAX_FUNCTION_LINES, MAX_ARGUMENTS = 600, 50, 8
FOLDERS = ("src", "tests", "benchmarks", "research", "examples", "docs")


def large_functions(path: Path) -> list[str]:
    """The functions of a file that are longer than the limit or take more arguments than the limit.

    Compiled kernels (`_*_numba.py`) take arrays and numbers instead of dataclasses, so their arguments are not counted.
    """
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        lines = (node.end_lineno or node.lineno) - node.lineno + 1
        arguments = [a.arg for a in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]]
        count = 0 if path.name.endswith("_numba.py") else len([a for a in arguments if a not in ("self", "cls")])
        if lines > MAX_FUNCTION_LINES or count > MAX_ARGUMENTS:
            found.append(f"{path.name}:{node.name}: {lines} lines, {count} arguments")
    return found


def test_files_are_short():
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in paths}
    assert len(lengths) > 200
    assert {name: lines for name, lines in lengths.items() if lines > MAX_FILE_LINES} == {}, "split it by concept"


def test_functions_are_short():
    found = [fault for path in sorted((ROOT / "src").rglob("*.py")) for fault in large_functions(path)]
    assert found == [], "split the function, or group its arguments in a dataclass"


def test_a_large_function_is_found(tmp_path):
    body = "\n".join(f"    a{i} = {i}" for i in range(MAX_FUNCTION_LINES))
    path = tmp_path / "x.py"
    path.write_text(f"def f(): ...\ndef g(a, b, c, d, e, f, g, h, i): ...\ndef h():\n{body}\n")
    assert large_functions(path) == ["x.py:g: 1 lines, 9 arguments", "x.py:h: 51 lines, 0 arguments"]
