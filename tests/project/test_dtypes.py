"""Dtypes of tensors do not depend on torch's default dtype, which belongs to the caller."""

from __future__ import annotations

import ast
from pathlib import Path

_FACTORIES = ("empty", "eye", "full", "linspace", "ones", "rand", "randn", "tensor", "zeros")


def without_dtype(source: str) -> list[int]:
    """Lines that create a tensor of torch's default dtype, unless its values are integers."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    return [
        call.lineno
        for call in calls
        if ast.unparse(call.func) in {f"torch.{name}" for name in _FACTORIES}
        and "dtype" not in {keyword.arg for keyword in call.keywords}
    ]


def test_new_tensors_have_a_dtype(checkout: Path):
    found = [
        f"{path.relative_to(checkout)}:{line}"
        for path in sorted((checkout / "toolkit").rglob("*.py"))
        for line in without_dtype(path.read_text(encoding="utf-8"))
    ]
    assert found == []
