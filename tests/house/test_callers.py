"""A public name in src has a caller in src, or stands in `viewmend.__all__`: what only tests call is dead weight.

Not asked for, by rule: fields (the value carries them), names that a command gives (`Options`, `run`), and methods
that a base class from outside of src declares, since that one's code calls them.
"""

import ast
import importlib
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import viewmend

SRC = Path(__file__).resolve().parents[2] / "src"
ENTRY_POINTS = {"Options", "run", "main"}
"""What `viewmend.cli` and pyproject.toml call by name."""


@dataclass(frozen=True)
class Definition:
    """A public name: where it stands, and the piece of code whose own mentions of it do not count."""

    module: str
    name: str
    node: ast.AST
    owner: ast.ClassDef | None = None

    def __str__(self) -> str:
        inside = f"{self.owner.name}." if self.owner else ""
        return f"{self.module}:{inside}{self.name}"


def modules_of(src: Path) -> dict[str, ast.Module]:
    """Every module of these sources by its dotted name."""
    paths = {".".join(p.relative_to(src).with_suffix("").parts): p for p in sorted(src.rglob("*.py"))}
    return {name.removesuffix(".__init__"): ast.parse(path.read_text()) for name, path in paths.items()}


def definitions(module: str, tree: ast.Module) -> Iterator[Definition]:
    """Functions, classes, methods and constants that do not start with an underscore."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield Definition(module, node.name, node)
        for target in targets(node):
            yield Definition(module, target, node)
        if isinstance(node, ast.ClassDef):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef):
                    yield Definition(module, inner.name, inner, node)


def targets(node: ast.stmt) -> list[str]:
    """The names that an assignment binds."""
    if isinstance(node, ast.AnnAssign):
        bound: list[ast.expr] = [node.target]
    else:
        bound = list(node.targets) if isinstance(node, ast.Assign) else []
    return [n.id for part in bound for n in ast.walk(part) if isinstance(n, ast.Name)]


def mentions(tree: ast.AST) -> tuple[Counter[str], Counter[str], set[str]]:
    """How often each plain name is read, each attribute is read, and what is imported from where (`a.b:name`)."""
    names, attributes, imported = Counter[str](), Counter[str](), set[str]()
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            names[node.id] += 1
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
            attributes[node.attr] += 1
        elif isinstance(node, ast.ImportFrom):
            imported |= {f"{node.module}:{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
            # A quoted annotation, or what getattr and import_module are told.
            names.update(re.findall(r"\w+", node.value) if len(node.value) < 80 else ())
            attributes[node.value] += 1
            imported.add(node.value)
    return names, attributes, imported


def without_caller(src: Path, public: set[str]) -> list[str]:
    """Public definitions that nothing in `src` mentions but themselves."""
    trees = modules_of(src)
    seen = {module: mentions(tree) for module, tree in trees.items()}
    attributes = sum((a for _, a, _ in seen.values()), Counter[str]())
    imported = {i for module, (_, _, found) in seen.items() for i in found if module != "viewmend"}
    found = []
    for definition in (d for module, tree in trees.items() for d in definitions(module, tree)):
        name, module = definition.name, definition.module
        if name.startswith("_") or (module == "viewmend" and name in public):
            continue
        own_names, own_attributes, _ = mentions(definition.node)
        if definition.owner:
            called = attributes[name] > own_attributes[name] or from_outside(definition, set(trees))
        else:
            package, _, last = module.rpartition(".")
            whole = f"{package}:{last}" in imported or module in imported  # the module itself is passed around
            called = (
                name in public
                or (name in ENTRY_POINTS and module.startswith("viewmend.cli"))
                or f"{module}:{name}" in imported
                or seen[module][0][name] > own_names[name]
                or (whole and attributes[name] > own_attributes[name])
            )
        if not called:
            found.append(str(definition))
    return found


def from_outside(definition: Definition, own: set[str]) -> bool:
    """Whether a base class from outside of src declares this method."""
    assert definition.owner is not None
    if not definition.owner.bases or definition.module not in own:
        return False
    kind = getattr(importlib.import_module(definition.module), definition.owner.name)
    return any(hasattr(base, definition.name) for base in kind.__mro__ if base.__module__.split(".")[0] != "viewmend")


def test_every_public_name_has_a_caller():
    assert without_caller(SRC, set(viewmend.__all__)) == [], "delete it with its tests, or give it a caller"


NEW_ROOM = '''
"""A room that nobody visits."""
from made_up.used import SIZE

UNREAD = 3
Alias = int

def lonely(n):
    return lonely(n - 1)

def called(): ...

class Idle:
    """Nobody makes one."""

class Busy:
    field: int = 0

    def _own(self): ...

    def idle(self):
        return self.idle()

    def works(self): ...

def offered(): ...

def _private(): ...

called(), Busy().works(), SIZE
'''


@pytest.fixture
def made_up(tmp_path):
    (tmp_path / "made_up").mkdir()
    (tmp_path / "made_up/new.py").write_text(NEW_ROOM)
    (tmp_path / "made_up/used.py").write_text("SIZE = 3\n\ndef draw(): ...\n\ndef cut(): ...\n")
    (tmp_path / "made_up/user.py").write_text('from made_up import used\n\n"""See cut of used."""\n\nused.draw()\n')
    return tmp_path


def test_names_without_a_caller_are_seen(made_up):
    alone = ["UNREAD", "Alias", "lonely", "Idle", "Busy.idle", "offered"]
    assert without_caller(made_up, {"offered"}) == [f"made_up.new:{n}" for n in alone[:-1]] + ["made_up.used:cut"]
    assert f"made_up.new:{alone[-1]}" in without_caller(made_up, set())
