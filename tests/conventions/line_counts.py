"""Counts of patterns that make lines hard to read, by package: `python tests/conventions/line_counts.py [SOURCE]`."""

import ast
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path

SRC = Path(__file__).resolve().parents[2] / "src" / "viewmend"
MAX_COLUMNS = 110
"""Lines of code should have at most this many columns."""
MAX_STATEMENTS = 45
"""Functions should have at most this many statements, without docstrings."""
MAX_LOCALS = 20
"""Functions should bind at most this many names, without parameters and variables of comprehensions."""
PREPOSITIONS = frozenset(
    [
        "about",
        "above",
        "across",
        "after",
        "along",
        "among",
        "around",
        "as",
        "at",
        "before",
        "below",
        "beneath",
        "between",
        "beyond",
        "by",
        "during",
        "except",
        "for",
        "from",
        "in",
        "inside",
        "into",
        "like",
        "of",
        "off",
        "on",
        "onto",
        "outside",
        "over",
        "per",
        "since",
        "than",
        "through",
        "to",
        "toward",
        "under",
        "until",
        "upon",
        "with",
        "within",
        "without",
    ]
)
"""A docstring that begins with one of these words leaves out its subject."""
COLUMNS = {
    "lines": "non-blank lines",
    "parallel": "assignments of several values to several names",
    "walruses": "assignment expressions",
    "long_lines": f"lines over {MAX_COLUMNS} columns",
    "prepositions": "docstrings that begin with a preposition",
    "late_constants": "files with constants after the first function or class",
    "statements": f"functions over {MAX_STATEMENTS} statements",
    "locals": f"functions over {MAX_LOCALS} local names",
}
"""The counts, and what each counts."""

Function = ast.FunctionDef | ast.AsyncFunctionDef
SCOPES = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


@cache
def parse(source: str) -> ast.Module:
    """The syntax tree of a source, parsed once for all conventions; leave it as it is."""
    return ast.parse(source)


def count_file(source: str) -> Counter[str]:
    """Count the patterns in the source of a file."""
    tree = parse(source)
    lines = [line for line in source.splitlines() if line.strip()]
    nodes = [*ast.walk(tree)]
    functions = [node for node in nodes if isinstance(node, Function)]
    return Counter(
        lines=len(lines),
        parallel=sum(is_parallel(node) for node in nodes),
        walruses=sum(isinstance(node, ast.NamedExpr) for node in nodes),
        long_lines=sum(len(line) > MAX_COLUMNS for line in lines),
        prepositions=sum(begins_with_preposition(text) for text in docstrings(nodes)),
        late_constants=int(has_late_constants(tree)),
        statements=sum(count_statements(node) > MAX_STATEMENTS for node in functions),
        locals=sum(len(local_names(node)) > MAX_LOCALS for node in functions),
    )


def is_parallel(node: ast.AST) -> bool:
    """Whether a node is `a, b = x, y`; unpackings of one value, such as `low, high = bounds`, are not."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Tuple)
        and any(isinstance(target, ast.Tuple) for target in node.targets)
    )


def docstrings(nodes: list[ast.AST]) -> Iterator[str]:
    """The docstrings of modules, classes, functions, constants and fields."""
    for node in nodes:
        if not isinstance(node, ast.Module | ast.ClassDef | Function):
            continue
        for statement in node.body:
            value = statement.value if isinstance(statement, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield value.value


def begins_with_preposition(docstring: str) -> bool:
    """Whether the first word of a docstring is a preposition."""
    words = docstring.split()
    return bool(words) and words[0].lower() in PREPOSITIONS


def has_late_constants(tree: ast.Module) -> bool:
    """Whether a module assigns to a name after its first function or class; `__all__` may stand anywhere."""
    defined = False
    for node in tree.body:
        if isinstance(node, Function | ast.ClassDef):
            defined = True
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names = [target.id for target in targets if isinstance(target, ast.Name)]
        if defined and isinstance(node, ast.Assign | ast.AnnAssign) and names != ["__all__"]:
            return True
    return False


def count_statements(function: Function) -> int:
    """Count the statements of a function, at all levels, without docstrings."""
    statements = [node for part in function.body for node in ast.walk(part) if isinstance(node, ast.stmt)]
    return sum(
        not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)) for node in statements
    )


def local_names(function: Function) -> set[str]:
    """The names that a function binds, without its parameters, those of functions in it, and comprehensions'."""
    found = set[str]()
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        if isinstance(node, SCOPES):
            continue
        if isinstance(node, COMPREHENSIONS):
            pending += [inner for inner in ast.walk(node) if isinstance(inner, ast.NamedExpr)]
        else:
            pending += ast.iter_child_nodes(node)
    return found


def count_folders(
    root: Path, suffix: str, count_file: Callable[[str], Counter[str]]
) -> dict[str, Counter[str]]:
    """The counts of each folder in `root`; files next to the folders count as 'top level'."""
    counts: dict[str, Counter[str]] = {}
    for path in sorted(root.rglob(f"*{suffix}")):
        relative = path.relative_to(root)
        folder = relative.parts[0] if len(relative.parts) > 1 else "top level"
        counts.setdefault(folder, Counter()).update(count_file(path.read_text("utf-8")))
    return counts


def format_table(counts: dict[str, Counter[str]], columns: Iterable[str]) -> str:
    """A table of the counts, a line for each folder and one for their sum."""
    total = sum(counts.values(), Counter[str]())
    rows = [("folder", *columns)]
    rows += [
        (name, *(str(found[key]) for key in columns)) for name, found in {**counts, "total": total}.items()
    ]
    share = 100 * total["long_lines"] / max(total["lines"], 1)
    table = "\n".join("".join(f"{cell:>16}" for cell in row) for row in rows)
    return f"{table}\n{share:.2f} % of the lines have more than {MAX_COLUMNS} columns"


if __name__ == "__main__":
    source = Path(sys.argv[1]) if len(sys.argv) > 1 else SRC
    print(format_table(count_folders(source, ".py", count_file), COLUMNS))
