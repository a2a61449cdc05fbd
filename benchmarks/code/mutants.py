"""Mutants of Python code: modules with one small change each."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}
_SIGNS: dict[type[ast.operator], type[ast.operator]] = {ast.Add: ast.Sub, ast.Sub: ast.Add}


@dataclass(frozen=True)
class Mutant:
    """A module with one change.

    Attributes:
        line: of the change, from 1.
        change: the changed code, before and after.
    """

    line: int
    change: str
    _tree: ast.Module
    _container: Any
    _place: Any
    _replacement: ast.AST

    def source(self) -> str:
        """The code of the module, without its comments."""
        node = self._container[self._place]
        self._container[self._place] = self._replacement
        try:
            return ast.unparse(self._tree) + "\n"
        finally:
            self._container[self._place] = node


def mutants(source: str) -> list[Mutant]:
    """All mutants of a module, in a fixed order."""
    tree = ast.parse(source)
    values = [s.value for s in tree.body if isinstance(s, ast.Assign | ast.AnnAssign) and s.value]
    constants = {id(part) for value in values for part in ast.walk(value)}
    return [
        Mutant(
            node.lineno, f"{ast.unparse(node)} -> {ast.unparse(new)}", tree, container, place, new
        )
        for container, place, node in _nodes(tree)
        for new in _replacements(node, id(node) in constants)
    ]


def _nodes(tree: ast.Module) -> Iterator[tuple[Any, Any, ast.expr | ast.stmt]]:
    """Expressions and statements, each with the container that holds it and its place there."""
    for parent in ast.walk(tree):
        for name, value in ast.iter_fields(parent):
            places = enumerate(value) if isinstance(value, list) else [(name, value)]
            container = value if isinstance(value, list) else vars(parent)
            for place, node in places:
                if isinstance(node, ast.expr | ast.stmt):
                    yield container, place, node


def _replacements(node: ast.AST, constant: bool) -> Iterator[ast.AST]:
    """What may stand in the place of a node."""
    match node:
        case ast.Compare(left, operators, right):
            for i, operator in enumerate(operators):
                if other := _COMPARISONS.get(type(operator)):
                    yield ast.Compare(left, [*operators[:i], other(), *operators[i + 1 :]], right)
        case ast.BinOp(left, ast.Add() | ast.Sub() as operator, right) if not _is_text(node):
            yield ast.BinOp(left, _SIGNS[type(operator)](), right)
            yield left
            yield right if isinstance(operator, ast.Add) else ast.UnaryOp(ast.USub(), right)
        case ast.BinOp(left, ast.Mult(), right):
            yield left
            yield right
        case ast.AugAssign(variable, ast.Add() | ast.Sub() as operator, value):
            yield ast.AugAssign(variable, _SIGNS[type(operator)](), value)
        case ast.BoolOp(ast.And(), values):
            yield ast.BoolOp(ast.Or(), values)
        case ast.Constant(int() | float() as number) if constant and type(number) is not bool:
            if number:
                yield ast.Constant(2 * number)
                yield ast.UnaryOp(ast.USub(), node)


def _is_text(node: ast.expr) -> bool:
    """Whether an expression joins texts or sequences, whose parts cannot be subtracted."""
    match node:
        case ast.Constant(str()) | ast.JoinedStr() | ast.List() | ast.Tuple() | ast.ListComp():
            return True
        case ast.BinOp(left, ast.Add(), right):
            return _is_text(left) or _is_text(right)
    return False
