"""Counts how many small faults in the package its tests find.

    python research/mutations.py --parts geometry models --count 50

Each mutation changes one expression of a copy of the package, such as a sign, a comparison or an axis. The tests of
its part then run until one fails. A mutation that fails a test, or lasts too long, is killed. One that no test
notices has survived: either it changes nothing that matters, or a test is missing.
"""

import ast
import copy
import importlib
import importlib.util
import itertools
import math
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from random import Random
from typing import NoReturn

import pytest
import tyro

ROOT = Path(__file__).resolve().parents[1]
"""The repository has this path."""
PARTS = {
    "geometry": ("tests/geometry", "tests/laws", "tests/test_publishing.py"),
    "rendering": ("tests/rendering", "tests/models/test_error_predictor.py", "tests/test_stream.py"),
    "models": ("tests/models", "tests/laws"),
    "data": ("tests/data",),
    "training": ("tests/training",),
    "metrics": ("tests/metrics", "tests/evaluation/test_scores.py"),
}
"""The tests of each part: a folder of the package."""
SLOWER = 4.0
"""A mutation is killed if its tests take this many times as long as without it, and a minute more."""

REWRITE = "ignore::pytest.PytestAssertRewriteWarning"
"""The warning that a plugin of pytest has been imported before."""
LIBRARIES = (
    "torch",
    "numba",
    "cv2",
    "safetensors.torch",
    "av",
    "PIL.Image",
    "tyro",
)
"""Modules that are imported once for all tests."""

OPPOSITES: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
"""Operators, and what replaces each."""
BOUNDARIES: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
}
"""Comparisons, and those that differ from them only where both sides are equal."""
RENAMED = {
    "min": "max",
    "amin": "amax",
    "minimum": "maximum",
    "any": "all",
    "floor": "ceil",
    "argmin": "argmax",
    "sin": "cos",
}
"""Functions, and what replaces each; the other way round, too."""
DROPPED = frozenset(
    ["clamp", "clip", "abs", "round", "floor", "flip", "detach", "clone", "normalize", "copy", "mT", "T"]
)
"""Functions and attributes that return something like their first argument, which is put in their place."""
AXES = frozenset(["width", "height", "x", "y", "u", "v", "row", "column", "rows", "columns", "left", "top"])
"""Neighbouring arguments of these names are swapped."""
REDUCTIONS = frozenset(
    ["sum", "mean", "amax", "amin", "any", "all", "flip", "unbind", "norm", "argmax", "cumsum"]
)
"""Functions whose axis is changed."""
OPTIONS = frozenset(
    ["mode", "padding_mode", "padding", "indexing", "method", "cull", "antialias", "min", "max"]
)
"""Arguments that are left out."""
PATH_LIKE = re.compile(r"folder|path|\bout\b|root|file|\"|'", re.IGNORECASE)
"""A division whose operands look like this joins paths."""


@dataclass(frozen=True)
class Mutation:
    """One expression of a file, and what replaces it."""

    part: str
    file: Path
    """The file, relative to the repository."""
    kind: str
    node: ast.expr
    """The expression that is replaced."""
    replacement: ast.expr

    def __str__(self) -> str:
        before = ast.unparse(self.node)
        after = ast.unparse(self.replacement)
        return f"{self.file}:{self.node.lineno}: {self.kind}: {before} -> {after}"

    def apply(self, source: str) -> str:
        """The file's source with the replacement."""
        lines = source.encode().splitlines(keepends=True)
        assert self.node.end_lineno is not None
        assert self.node.end_col_offset is not None
        first = sum(map(len, lines[: self.node.lineno - 1])) + self.node.col_offset
        last = sum(map(len, lines[: self.node.end_lineno - 1])) + self.node.end_col_offset
        data = source.encode()
        return (data[:first] + f"({ast.unparse(self.replacement)})".encode() + data[last:]).decode()


def change_operator(node: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """Signs, factors, conditions and comparisons become their opposites."""
    changed = copy.deepcopy(node)
    match changed:
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in OPPOSITES:
            texts = any(isinstance(side, ast.Constant | ast.JoinedStr | ast.List | ast.Tuple) and _is_text(side)
                        for side in (left, right))  # fmt: skip
            is_path = isinstance(operator, ast.Div) and PATH_LIKE.search(ast.unparse(node))
            if not texts and not is_path:
                changed.op = OPPOSITES[type(operator)]()  # type: ignore[assignment]
                yield ("sign" if isinstance(operator, ast.Add | ast.Sub) else "factor"), changed
        case ast.UnaryOp(op=ast.USub() | ast.Invert() | ast.Not(), operand=operand):
            if not isinstance(operand, ast.Constant):
                yield "sign", operand
        case ast.BoolOp(op=operator):
            changed.op = OPPOSITES[type(operator)]()  # type: ignore[assignment]
            yield "condition", changed
        case ast.Compare(ops=[operator], comparators=[_]) if type(operator) in OPPOSITES:
            changed.ops = [OPPOSITES[type(operator)]()]  # type: ignore[list-item]
            yield "condition", changed


def change_boundary(node: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """Comparisons include or exclude equality, and whole numbers in sums, slices and ranges grow by one."""
    changed = copy.deepcopy(node)
    match changed:
        case ast.Compare(ops=[operator], comparators=[_]) if type(operator) in BOUNDARIES:
            changed.ops = [BOUNDARIES[type(operator)]()]  # type: ignore[list-item]
            yield "boundary", changed
        case ast.BinOp(op=ast.Add() | ast.Sub(), right=ast.Constant(value=int() as value)):
            changed.right = ast.Constant(value + 1)
            yield "off by one", changed
        case ast.Call(func=ast.Name(id="range"), args=[*_, last]):
            changed.args[-1] = ast.BinOp(last, ast.Sub(), ast.Constant(1))
            yield "off by one", changed


def change_call(node: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """Calls are dropped, or are of the opposite function, or along another axis, or without an option."""
    names = RENAMED | {new: old for old, new in RENAMED.items()}
    if isinstance(node, ast.Attribute) and node.attr in DROPPED & {"mT", "T"}:
        yield "dropped", node.value
    if not isinstance(node, ast.Call):
        return
    changed = copy.deepcopy(node)
    match changed.func:
        case ast.Attribute(value=value, attr=name):
            is_module = isinstance(value, ast.Name) and value.id in ("torch", "np", "F", "math")
        case ast.Name(id=name):
            is_module = True
        case _:
            return
    if name in DROPPED and (changed.args or not is_module):
        assert isinstance(changed.func, ast.Attribute | ast.Name)
        yield "dropped", changed.args[0] if is_module else changed.func.value  # type: ignore[union-attr]
    if name in names:
        opposite = copy.deepcopy(changed)
        if isinstance(opposite.func, ast.Attribute):
            opposite.func.attr = names[name]
        else:
            opposite.func = ast.Name(names[name])
        if not isinstance(opposite.func, ast.Name) or opposite.func.id in ("min", "max", "any", "all"):
            yield "opposite", opposite
    yield from _change_axes(changed, name)
    for keyword in changed.keywords:
        if keyword.arg in OPTIONS:
            fewer = copy.deepcopy(changed)
            fewer.keywords = [other for other in fewer.keywords if other.arg != keyword.arg]
            yield "option", fewer


def _change_axes(call: ast.Call, name: str) -> Iterator[tuple[str, ast.expr]]:
    """The call with neighbouring axes swapped, or a reduction along another axis."""
    for place, (first, second) in enumerate(zip(call.args, call.args[1:], strict=False)):
        both = [part.id for part in (first, second) if isinstance(part, ast.Name)]
        if len(both) == 2 and AXES.issuperset(both) and name not in ("min", "max"):
            swapped = copy.deepcopy(call)
            swapped.args[place : place + 2] = [second, first]
            yield "axes", swapped
    if name in REDUCTIONS and len(call.args) == 1 and isinstance(call.args[0], ast.Constant):
        axis = call.args[0].value
        if type(axis) is int and axis in (0, 1):
            other = copy.deepcopy(call)
            other.args = [ast.Constant(1 - axis)]
            yield "axes", other


CHANGES: tuple[Callable[[ast.expr], Iterator[tuple[str, ast.expr]]], ...] = (
    change_operator,
    change_boundary,
    change_call,
)
"""All functions that change an expression; each yields kinds and replacements."""


def _is_text(node: ast.expr) -> bool:
    return not isinstance(node, ast.Constant) or isinstance(node.value, str | bytes)


def find_mutations(part: str) -> list[Mutation]:
    """All mutations of a part, in the order of its files."""
    found = []
    for file in sorted((ROOT / "src" / "viewmend" / part).rglob("*.py")):
        for node in _expressions(ast.parse(file.read_text(encoding="utf-8"))):
            for change in CHANGES:
                for kind, replacement in change(node):
                    found.append(Mutation(part, file.relative_to(ROOT), kind, node, replacement))
    return found


def _expressions(node: ast.AST) -> Iterator[ast.expr]:
    """The expressions of functions, without annotations, decorators, messages and assertions."""
    skipped = (ast.Raise, ast.Assert, ast.JoinedStr, ast.arguments, ast.Import, ast.ImportFrom)
    for name, field in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases"):
            continue
        for child in field if isinstance(field, list) else [field]:
            if isinstance(child, ast.AST) and not isinstance(child, skipped):
                if isinstance(child, ast.expr):
                    yield child
                yield from _expressions(child)


def choose(mutations: list[Mutation], count: int, seed: int) -> list[Mutation]:
    """This many mutations, of all kinds in turn, at most one for each expression."""
    random = Random(seed)
    kinds: defaultdict[str, list[Mutation]] = defaultdict(list)
    for mutation in random.sample(mutations, len(mutations)):
        kinds[mutation.kind].append(mutation)
    chosen: dict[tuple[Path, int, int], Mutation] = {}
    while len(chosen) < count and any(kinds.values()):
        for kind in sorted(kinds):
            if kinds[kind]:
                mutation = kinds[kind].pop()
                chosen.setdefault((mutation.file, mutation.node.lineno, mutation.node.col_offset), mutation)
    return list(islice(chosen.values(), count))


class Copy:
    """A copy of the package, whose files are mutated one at a time while tests run on it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shutil.copytree(ROOT / "src", folder / "src", ignore=shutil.ignore_patterns("*.pyc"))

    def run_tests(self, tests: list[str], limit_s: float = math.inf) -> str | None:
        """The first test that fails; None if all pass, and 'timeout' after `limit_s`.

        They run in a fork of this process, which has imported what takes long.
        """
        printed = self.folder / "printed.txt"
        process = os.fork()
        if process == 0:
            self._become_tests(tests, printed)
        end = time.monotonic() + limit_s
        done, status = os.waitpid(process, os.WNOHANG)
        while not done:
            if time.monotonic() > end:
                os.killpg(process, signal.SIGKILL)
                os.waitpid(process, 0)
                return "timeout"
            time.sleep(0.1)
            done, status = os.waitpid(process, os.WNOHANG)
        if status == 0:
            return None
        failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", printed.read_text(errors="replace"), re.MULTILINE)
        return failed[0] if failed else f"exit status {os.waitstatus_to_exitcode(status)}"

    def _become_tests(self, tests: list[str], printed: Path) -> NoReturn:
        """Run tests on the copy, with the output in a file, and end this process."""
        code = 1
        try:
            os.setsid()
            with printed.open("wb") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            os.chdir(ROOT)
            os.environ |= {"PYTHONPATH": str(self.folder / "src")}
            sys.dont_write_bytecode = False  # pytest then rewrites its files once, not for each mutation
            sys.path.insert(0, str(self.folder / "src"))
            spec = importlib.util.find_spec("viewmend")
            assert spec is not None and spec.origin is not None and spec.origin.startswith(str(self.folder))
            options = [
                "-q",
                "-x",
                "-p",
                "no:cacheprovider",
                "--tb=no",
                "-rfE",
                "--jaxtyping-packages=",
                "-W",
                REWRITE,
            ]
            code = pytest.main([*options, *tests])
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(code)

    def run_mutated(self, mutation: Mutation, limit_s: float) -> str | None:
        """The first test that fails with this mutation; None if it survives."""
        file = self.folder / mutation.file
        source = file.read_text(encoding="utf-8")
        changed_ns = file.stat().st_mtime_ns
        kernels = file.parent / "__pycache__"
        kept = self.folder / "kernels"
        if file.stem.endswith(
            "_numba"
        ):  # compiled kernels know nothing of changes in functions that they call
            kernels.rename(kept)
        try:
            file.write_text(mutation.apply(source), encoding="utf-8")
            return self.run_tests(tests_of(mutation), limit_s)
        finally:
            file.write_text(source, encoding="utf-8")
            os.utime(file, ns=(changed_ns, changed_ns))
            if kept.exists():
                shutil.rmtree(kernels, ignore_errors=True)
                kept.rename(kernels)


def tests_of(mutation: Mutation) -> list[str]:
    """The part's tests; those that are named after the file come first."""
    name = mutation.file.stem.strip("_").removesuffix("_numba")
    folders = PARTS[mutation.part]
    own = [file for folder in folders for file in (ROOT / folder).glob(f"test_{name}*.py")]
    return [*(str(file.relative_to(ROOT)) for file in own), *folders]


def main(
    parts: tuple[str, ...] = tuple(PARTS),
    count: int = 100,
    seed: int = 0,
    matching: str = "",
    list_only: bool = False,
) -> None:
    """Print each mutation with the test that killed it, and the numbers of killed and surviving ones.

    Args:
        parts: folders of the package to mutate.
        count: mutations in all parts together.
        seed: chooses the mutations.
        matching: choose only mutations whose line of output contains this text.
        list_only: print the mutations without running tests.
    """
    unknown = set(parts) - set(PARTS)
    if unknown:
        raise SystemExit(
            f"expected parts among {', '.join(PARTS)}, got {', '.join(unknown)}; check the spelling"
        )
    chosen: dict[str, list[Mutation]] = {}
    for number, part in enumerate(parts):
        share = count * (number + 1) // len(parts) - count * number // len(parts)
        chosen[part] = choose([m for m in find_mutations(part) if matching in str(m)], share, seed)
    if list_only:
        print(*itertools.chain(*chosen.values()), sep="\n")
        return
    for library in LIBRARIES:
        importlib.import_module(library)
    totals = []
    with tempfile.TemporaryDirectory() as folder:
        package = Copy(Path(folder))
        for part, mutations in chosen.items():
            limit_s = measure_limit(package, part)
            survived = 0
            for mutation in mutations:
                killer = package.run_mutated(mutation, limit_s)
                survived += killer is None
                print(f"killed by {killer}: {mutation}" if killer else f"SURVIVED: {mutation}", flush=True)
            totals.append(f"{part}: {len(mutations) - survived} killed, {survived} survived")
    print(*totals, sep="\n")


def measure_limit(package: Copy, part: str) -> float:
    """The longest that tests of a part may take with a mutation, seconds.

    Raises:
        RuntimeError: they fail without one.
    """
    began = time.monotonic()
    failed = package.run_tests(list(PARTS[part]))
    if failed:
        raise RuntimeError(
            f"expected tests to pass without a mutation, got a failure of {failed}; mend it first"
        )
    return SLOWER * (time.monotonic() - began) + 60


if __name__ == "__main__":
    tyro.cli(main)
