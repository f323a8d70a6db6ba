"""Small bugs for `mutate.py`: where a source file can be broken, and how."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass

OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
SYMMETRIC = ("isinstance", "max", "min", "minimum", "maximum", "print")
"""Calls whose first two arguments may change places."""


@dataclass(frozen=True)
class Mutation:
    """Some whole lines of a file, and what stands there instead."""

    kind: str
    line: int
    """The first of them, from 1."""
    old: str
    new: str


def mutations(source: str) -> Iterator[Mutation]:
    """All of a file. Annotations, decorators, defaults of fields, messages and assertions stay as they are."""
    lines = source.encode().splitlines(keepends=True)
    for kind, node, text in _sites(ast.parse(source), None):
        first, last = node.lineno, node.end_lineno or node.lineno
        old = lines[first - 1 : last]
        new = old[0][: node.col_offset] + text.encode() + old[-1][node.end_col_offset :]
        yield Mutation(kind, first, b"".join(old).decode(), new.decode())


def applied(source: str, mutation: Mutation) -> str | None:
    """The file with the bug, at the place nearest to where its line was; None where there is no such line any more."""
    lines, old = source.splitlines(keepends=True), mutation.old.splitlines(keepends=True)
    places = [n for n in range(len(lines)) if lines[n : n + len(old)] == old]
    if not places:
        return None
    at = min(places, key=lambda n: abs(n + 1 - mutation.line))
    return "".join([*lines[:at], mutation.new, *lines[at + len(old) :]])


def _sites(node: ast.AST, parent: ast.AST | None) -> Iterator[tuple[str, ast.expr | ast.stmt, str]]:
    """(kind, what is replaced, by what) below a node."""
    if isinstance(node, ast.JoinedStr | ast.Assert) or (isinstance(node, ast.AnnAssign) and _is_class(parent)):
        return
    yield from ((kind, where, f"({text})") for kind, where, text in _of_expression(node))
    yield from _of_statement(node, parent)
    if isinstance(node, ast.Raise):
        return
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases", "keywords" if _is_class(node) else ""):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _sites(child, node)


def _is_class(node: ast.AST | None) -> bool:
    return isinstance(node, ast.ClassDef)


def _of_expression(node: ast.AST) -> Iterator[tuple[str, ast.expr, str]]:
    match node:
        case ast.Compare(left, [operator], [right]):
            yield "comparison", node, ast.unparse(ast.Compare(left, [_other(operator)], [right]))  # pyright: ignore
        case ast.BinOp(left, operator, right) if type(operator) in OPERATORS and not _of_types(node):
            yield "arithmetic", node, ast.unparse(ast.BinOp(left, _other(operator), right))  # pyright: ignore
        case ast.UnaryOp(ast.USub(), operand) if not isinstance(operand, ast.Constant):
            yield "arithmetic", node, ast.unparse(operand)
        case ast.BoolOp(operator, values):
            yield "boolean", node, ast.unparse(ast.BoolOp(_other(operator), values))  # pyright: ignore
        case ast.UnaryOp(ast.Not() | ast.Invert(), operand):
            yield "boolean", node, ast.unparse(operand)
        case ast.If(test) | ast.IfExp(test) | ast.While(test):
            yield "boolean", test, f"not ({ast.unparse(test)})"
        case ast.Constant(bool(value)):
            yield "constant", node, repr(not value)
        case ast.Constant(int(value) | float(value)):
            yield "constant", node, repr(value * 2 if value not in (0, 1) else value + 1)
        case ast.Call(function, [first, second, *rest], keywords) if not _is_symmetric(function):
            if not isinstance(first, ast.Starred) and not isinstance(second, ast.Starred):
                yield "arguments", node, ast.unparse(ast.Call(function, [second, first, *rest], keywords))


def _of_statement(node: ast.AST, parent: ast.AST | None) -> Iterator[tuple[str, ast.stmt, str]]:
    match node:
        case ast.Expr(ast.Constant()):
            return
        case ast.Expr() | ast.AugAssign() | ast.Raise() | ast.Continue() | ast.Break():
            yield "dropped", node, "pass"
        case ast.Assign([ast.Attribute() | ast.Subscript()]):
            yield "dropped", node, "pass"
        case ast.Return() if isinstance(parent, ast.If | ast.For | ast.While):
            yield "dropped", node, "pass"


def _other(operator: ast.AST) -> ast.AST:
    return OPERATORS[type(operator)]()


def _of_types(node: ast.BinOp) -> bool:
    """Whether `A | B` joins types."""
    parts = [node.left, node.right]
    return isinstance(node.op, ast.BitOr) and any(isinstance(p, ast.Name) and p.id[0].isupper() for p in parts)


def _is_symmetric(function: ast.expr) -> bool:
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    return name in SYMMETRIC
