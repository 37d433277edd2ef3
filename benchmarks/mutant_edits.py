"""Small faults put into Python source, one at a time: what a test run is to notice."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

_OPERATORS: dict[type[Any], type[Any]] = {
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
    ast.FloorDiv: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.And: ast.Or,
    ast.Or: ast.And,
}


@dataclass(frozen=True)
class Edit:
    """A fault: a range of the source and what takes its place."""

    line: int  # from 1
    kind: str
    before: str
    after: str
    span: tuple[int, int]  # offsets in the source as UTF-8

    def apply(self, source: bytes) -> bytes:
        """The source with the fault."""
        return source[: self.span[0]] + self.after.encode() + source[self.span[1] :]


def edits(source: bytes) -> list[Edit]:
    """Every fault that can be put inside the functions of a module.

    Messages, docstrings, annotations, defaults, decorators, raised errors and code for type checkers alone stay as they
    are: a fault there is none in what is computed.
    """
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found: list[Edit] = []
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                if not isinstance(statement, ast.FunctionDef):  # one inside another has a turn of its own
                    found += (edit for node in _executed(statement) for edit in _of_node(node, source, starts))
    return sorted(set(found), key=lambda edit: (edit.span, edit.after))


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes below one whose faults change results."""
    if isinstance(
        node, ast.Raise | ast.FunctionDef | ast.ClassDef | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom
    ):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name != "annotation":
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from _executed(child)


def _of_node(node: ast.AST, source: bytes, starts: list[int]) -> Iterator[Edit]:
    kind, place, after = _change(node)
    if kind and place.end_lineno is not None and place.end_col_offset is not None:
        span = (starts[place.lineno - 1] + place.col_offset, starts[place.end_lineno - 1] + place.end_col_offset)
        yield Edit(place.lineno, kind, source[slice(*span)].decode(), after, span)


def _change(node: ast.AST) -> tuple[str, Any, str]:
    """The kind of a fault, the node that it takes the place of, and its text; no kind where there is none."""
    match node:
        case ast.Compare(left, [operator], right) if type(operator) in _OPERATORS:
            return "comparison", node, _text(ast.Compare(left, [_OPERATORS[type(operator)]()], right))
        case ast.BinOp(left, operator, right) if type(operator) in _OPERATORS and not isinstance(left, ast.JoinedStr):
            return "arithmetic", node, _text(ast.BinOp(left, _OPERATORS[type(operator)](), right))
        case ast.BoolOp(operator, values):
            return "logic", node, _text(ast.BoolOp(_OPERATORS[type(operator)](), values))
        case ast.UnaryOp(ast.USub() | ast.Not(), operand):
            return "sign", node, _text(operand)
        case ast.Constant(bool(value)):
            return "constant", node, str(not value)
        case ast.Constant(int(value)):
            return "constant", node, f"({value} + 1)"
        case ast.Constant(float(value)):
            return "constant", node, repr(value * 1.5 if value else 1.0)
        case ast.If(test) | ast.IfExp(test):
            return "condition", test, f"(not {_text(test)})"
        case ast.AugAssign() | ast.Expr(ast.Call()):
            return "statement", node, "pass"
    return "", None, ""


def _text(node: ast.AST) -> str:
    return f"({ast.unparse(node)})"
