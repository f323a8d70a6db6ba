"""Files, functions and argument lists stay small; the lists of exceptions may only shrink."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
OTHERS = sorted(p for part in ("tests", "benchmarks", "examples") for p in (ROOT / part).rglob("*.py"))
MAX_FILE_LINES, MAX_FUNCTION_LINES, MAX_ARGUMENTS = 300, 50, 8

LONG_FILES: set[str] = set()
LONG_FUNCTIONS: set[str] = set()
# Compiled kernels take plain arrays and numbers, no dataclasses: docs/decisions/0002-compiled-kernels.md.
MANY_ARGUMENTS: set[str] = {
    "viewmend/geometry/_hull_numba.py:carve_blocks",
    "viewmend/geometry/_hull_numba.py:carve_voxels",
    "viewmend/geometry/_hull_numba.py:judge",
    "viewmend/geometry/_hull_numba.py:occupied_blocks",
    "viewmend/geometry/_rasterize_numba.py:draw_band",
    "viewmend/inpainting/_ray_sampling_numba.py:compare_silhouette",
    "viewmend/inpainting/_ray_sampling_numba.py:follow",
    "viewmend/inpainting/sweep/_lookup_numba.py:_sample",
    "viewmend/inpainting/sweep/_lookup_numba.py:look_up_camera",
    "viewmend/inpainting/sweep/_lookup_numba.py:look_up_silhouette",
    "viewmend/inpainting/sweep/_weigh_numba.py:weigh",
    "viewmend/rendering/_blend_numba.py:_blend_rows",
    "viewmend/rendering/_blend_numba.py:_weigh",
}


def measure(source: str, name: str) -> tuple[set[str], set[str], set[str]]:
    """The names of the file, functions and argument lists over the limits."""
    files = {name} if len(source.splitlines()) > MAX_FILE_LINES else set()
    long, many = set(), set()
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        label = f"{name}:{node.name}"
        if (node.end_lineno or node.lineno) - node.lineno + 1 > MAX_FUNCTION_LINES:
            long.add(label)
        arguments = node.args
        names = [a.arg for a in [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]]
        if len([a for a in names if a not in ("self", "cls")]) > MAX_ARGUMENTS:
            many.add(label)
    return files, long, many


@pytest.fixture(scope="module")
def measured() -> tuple[set[str], set[str], set[str]]:
    totals: tuple[set[str], set[str], set[str]] = (set(), set(), set())
    for path in SOURCES:
        for total, found in zip(totals, measure(path.read_text(), str(path.relative_to(ROOT / "src"))), strict=True):
            total |= found
    return totals


@pytest.mark.parametrize(
    ("kind", "allowed"), [(0, LONG_FILES), (1, LONG_FUNCTIONS), (2, MANY_ARGUMENTS)], ids=["files", "functions", "args"]
)
def test_only_listed_exceptions_are_large(measured, kind, allowed):
    assert measured[kind] == allowed, "make it smaller, or take it off the list when it became smaller"


def test_tests_and_benchmarks_are_no_longer_files_than_sources():
    names = [str(p.relative_to(ROOT)) for p in OTHERS if len(p.read_text().splitlines()) > MAX_FILE_LINES]
    assert len(OTHERS) > 200 and names == [], "split it by what it tests"


def test_the_ratchet_sees_what_is_too_large():
    body = "\n".join(f"    a{i} = {i}" for i in range(MAX_FUNCTION_LINES))
    source = f"def f(a, b, c, d, e, f, g, h, i):\n{body}\n" + "\n" * MAX_FILE_LINES
    assert measure(source, "x.py") == ({"x.py"}, {"x.py:f"}, {"x.py:f"})
