"""The names that each room of the toolkit says are for others, and those that others import."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

# Whatever uses these rooms may use all of it.
OPEN = ("base", "io")


def rooms(checkout: Path) -> list[str]:
    return sorted(p.parent.name for p in (checkout / "toolkit").glob("*/__init__.py"))


def stated(checkout: Path, room: str) -> list[str]:
    """The names behind "For others" in the words of a room."""
    words = ast.get_docstring(ast.parse((checkout / "toolkit" / room / "__init__.py").read_text()))
    return re.findall(r"`([\w.]+)`", words.split("For others:")[1])


@cache
def imports(checkout: Path) -> list[tuple[str, str, str]]:
    """All imports from rooms: the importing file, the module, and the name."""
    found = []
    for path in sorted((checkout / "toolkit").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("toolkit."):
                file = str(path.relative_to(checkout / "toolkit"))
                found += [(file, str(node.module), alias.name) for alias in node.names]
    return found


def imported(checkout: Path, room: str) -> Iterator[tuple[str, str]]:
    """Modules of a room that other rooms import, with the importing file."""
    for file, module, name in imports(checkout):
        if file.startswith(f"{room}/"):
            continue
        if module == f"toolkit.{room}":
            yield name, file
        elif module.startswith(f"toolkit.{room}."):
            yield module.removeprefix(f"toolkit.{room}."), file


def is_within(module: str, name: str) -> bool:
    return module == name or module.startswith(f"{name}.")


@pytest.mark.parametrize(
    "room", ["datasets", "depth", "exports", "runs", "scene", "semantics", "slam"]
)
def test_rooms_import_only_what_others_offer(checkout, room):
    assert room in rooms(checkout)
    names = stated(checkout, room)
    found = list(imported(checkout, room))
    hidden = [(m, path) for m, path in found if not any(is_within(m, n) for n in names)]
    assert not hidden, f"toolkit/{room}/__init__.py does not offer these to other rooms"
    unused = [n for n in names if not any(is_within(m, n) for m, _ in found)]
    assert not unused, f"no other room imports what toolkit/{room}/__init__.py offers"


def test_every_room_is_checked_or_open(checkout):
    checked = {"datasets", "depth", "exports", "runs", "scene", "semantics", "slam", "splatting"}
    assert set(rooms(checkout)) == checked | set(OPEN) | {"tools"}
