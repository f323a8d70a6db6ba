"""Every public name in src is used in src, or is in `viewmend.__all__`: code that only tests call is deleted.

Exempt: dataclass fields, a command's `Options`, `run` and `parse`, methods of public classes, and methods that
override a library's.
"""

import ast
import importlib
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from conventions.line_counts import parse

import viewmend

SRC = Path(__file__).resolve().parents[2] / "src"
ENTRY_POINTS = {"Options", "run", "main", "parse"}


@dataclass(frozen=True)
class Definition:
    """A public name, and the code whose own mentions of it do not count."""

    module: str
    name: str
    node: ast.AST
    owner: ast.ClassDef | None = None

    def __str__(self) -> str:
        return f"{self.module}:{f'{self.owner.name}.' if self.owner else ''}{self.name}"


def definitions(module: str, tree: ast.Module) -> Iterator[Definition]:
    """Public functions, classes, methods and constants."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield Definition(module, node.name, node)
        targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
        names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
        yield from (Definition(module, name, node) for name in names)
        for inner in node.body if isinstance(node, ast.ClassDef) else ():
            if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef):
                yield Definition(module, inner.name, inner, node)


def mentions(tree: ast.AST) -> tuple[Counter[str], Counter[str], set[str]]:
    """How often each name and each attribute is read, and what is imported (`module:name`)."""
    names, attributes, imported = Counter[str](), Counter[str](), set[str]()
    nodes = [*ast.walk(tree)]
    prose = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            names[node.id] += 1
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
            attributes[node.attr] += 1
        elif isinstance(node, ast.ImportFrom):
            imported |= {f"{node.module}:{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
            # Quoted annotations, registry entries, and the arguments of getattr and import_module.
            names.update(re.findall(r"\w+", node.value) if len(node.value) < 80 else ())
            attributes[node.value] += 1
            imported.add(node.value)
    return names, attributes, imported


def unused(src: Path, public: set[str]) -> list[str]:
    """Public definitions that nothing in `src` mentions but themselves."""
    paths = {".".join(p.relative_to(src).with_suffix("").parts): p for p in sorted(src.rglob("*.py"))}
    trees = {name.removesuffix(".__init__"): parse(path.read_text("utf-8")) for name, path in paths.items()}
    read = {module: mentions(tree) for module, tree in trees.items()}
    attributes = sum((found for _, found, _ in read.values()), Counter[str]())
    imported = {i for module, (_, _, found) in read.items() for i in found if module != "viewmend"}
    if "viewmend" in trees:  # the package itself lists most of what it imports, and uses only what it calls
        calls = [node.func for node in ast.walk(trees["viewmend"]) if isinstance(node, ast.Call)]
        called = {function.id for function in calls if isinstance(function, ast.Name)}
        imported |= {i for i in read["viewmend"][2] if i.partition(":")[2] in called}
    found = []
    for definition in (d for module, tree in trees.items() for d in definitions(module, tree)):
        name, module = definition.name, definition.module
        if name.startswith("_") or (module == "viewmend" and name in public):
            continue
        own_names, own_attributes, _ = mentions(definition.node)
        if definition.owner:
            used = (
                definition.owner.name in public
                or attributes[name] > own_attributes[name]
                or overrides_a_library(definition, set(trees))
            )
        else:
            package, _, last = module.rpartition(".")
            whole = f"{package}:{last}" in imported or module in imported  # the module itself is passed on
            used = (
                name in public
                or (name in ENTRY_POINTS and module.startswith("viewmend.cli"))
                or f"{module}:{name}" in imported
                or read[module][0][name] > own_names[name]
                or (whole and attributes[name] > own_attributes[name])
            )
        if not used:
            found.append(str(definition))
    return found


def overrides_a_library(definition: Definition, own: set[str]) -> bool:
    """Whether a base class from outside of src declares this method."""
    assert definition.owner is not None
    if not definition.owner.bases or definition.module not in own:
        return False
    kind = getattr(importlib.import_module(definition.module), definition.owner.name)
    return any(
        hasattr(base, definition.name) for base in kind.__mro__ if base.__module__.split(".")[0] != "viewmend"
    )


def test_every_public_name_is_used():
    assert unused(SRC, set(viewmend.__all__)) == [], "delete it with its tests, or use it"


UNUSED = """
from made_up.used import SIZE
UNREAD = 3
Alias = int
def lonely(n): return lonely(n - 1)
def called(): ...
class Idle: ...
class Busy:
    def _own(self): ...
    def idle(self): return self.idle()
    def works(self): ...
def offered(): ...
called(), Busy().works(), SIZE
"""


def test_unused_names_are_found(tmp_path):
    (tmp_path / "made_up").mkdir()
    (tmp_path / "made_up/new.py").write_text(UNUSED)
    (tmp_path / "made_up/used.py").write_text("SIZE = 3\ndef draw(): ...\ndef cut(): ...\n")
    (tmp_path / "made_up/user.py").write_text(
        'from made_up import used\n"""See cut of used."""\nused.draw()\n'
    )
    found = [f"made_up.new:{name}" for name in ("UNREAD", "Alias", "lonely", "Idle", "Busy.idle")]
    assert unused(tmp_path, {"offered"}) == [*found, "made_up.used:cut"]
    assert "made_up.new:offered" in unused(tmp_path, set())
