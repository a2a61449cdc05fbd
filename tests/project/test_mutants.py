"""The changes of code that mutation testing makes."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks.code.mutants import Mutant, mutants
from benchmarks.code.mutations import Options, sample


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("def f(a, b):\n    return a < b", ["a < b -> a <= b"]),
        ("def f(a):\n    return 0 <= a != 3", ["0 <= a != 3 -> 0 < a != 3", "... -> 0 <= a == 3"]),
        ("def f(a, b):\n    return a is b", []),
        ("def f(a, b):\n    return a + b", ["a + b -> a - b", "a + b -> a", "a + b -> b"]),
        ("def f(a, b):\n    return a - b", ["a - b -> a + b", "a - b -> a", "a - b -> -b"]),
        ("def f(a):\n    return 'x' + a + 'y'", []),
        ("def f(a, b):\n    return a * b", ["a * b -> a", "a * b -> b"]),
        ("def f(a, b):\n    a += b", ["a += b -> a -= b"]),
        ("def f(a, b):\n    return a and b", ["a and b -> a or b"]),
        ("LIMIT: float = 1.5", ["1.5 -> 3.0", "1.5 -> -1.5"]),
        ("NAMES, ON, ZERO = {'a': (2, 'b')}, True, 0", ["2 -> 4", "2 -> -2"]),
        ("def f(a=2):\n    return 3", []),
    ],
)
def test_changes(code: str, expected: list[str]) -> None:
    found = mutants(code)
    assert len(found) == len(expected)
    for mutant, change in zip(found, expected, strict=True):
        assert mutant.change.endswith(change.removeprefix("..."))
        assert mutant.line == len(code.splitlines())


def test_a_mutant_differs_from_the_module_in_its_change_alone() -> None:
    code = "LIMIT = 2\n\ndef f(a, b):\n    if a < LIMIT and b:\n        return a + b\n    return a"
    lines = ast.unparse(ast.parse(code)).splitlines()
    found = mutants(code)
    assert len({mutant.source() for mutant in found}) == len(found) == 7
    for mutant in found:
        before, after = mutant.change.split(" -> ")
        changed = [
            (old, new)
            for old, new in zip(lines, mutant.source().splitlines(), strict=True)
            if old != new
        ]
        ((old, new),) = changed
        assert before in old and new == old.replace(before, after)


def changes(drawn: list[tuple[Path, Mutant]]) -> list[tuple[Path, int, str]]:
    return [(name, mutant.line, mutant.change) for name, mutant in drawn]


def test_the_sample_depends_on_the_seed_alone() -> None:
    drawn = sample(Options("splatting/alignment", count=10))
    assert len(drawn) == 10
    assert changes(drawn) == changes(sample(Options("splatting/alignment", count=10)))
    assert changes(drawn) != changes(sample(Options("splatting/alignment", count=10, seed=1)))
    name, line, change = changes(drawn)[0]
    only = (f"{name.relative_to('toolkit')}:{line}",)
    chosen = changes(sample(Options("splatting/alignment", count=10, only=only)))
    assert (name, line, change) in chosen and {row[:2] for row in chosen} == {(name, line)}
    without = sample(Options("splatting/alignment", count=0, exclude=("cuda", "joint.py")))
    assert {"toolkit/splatting/alignment/data.py"} < {str(name) for name, _ in without}
    assert not any("cuda" in name.parts or name.name == "joint.py" for name, _ in without)
    with pytest.raises(ValueError, match="toolkit/nothing is no Python package"):
        sample(Options("nothing"))
