"""Attempts to harm a reader: a valid sample with one file that was crafted or changed at random."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks.inputs.hostile_edits import (
    TO_THE_BASE_OF_60,
    TWICE,
    Edit,
    Edits,
    archive_edits,
    binary_edits,
    json_edits,
    members,
    png_edits,
    table_edits,
    with_member,
    yaml_edits,
)

_ARCHIVES = (".npz", ".sog", ".usdz")
_EDITS: Mapping[str, Callable[[], Edits]] = {
    **dict.fromkeys((".json", ".jsonl", ".gltf"), json_edits),
    ".yaml": yaml_edits,
    **dict.fromkeys((".txt", ".csv"), table_edits),
    ".png": png_edits,
    **dict.fromkeys(_ARCHIVES, archive_edits),
}


@dataclass(frozen=True)
class Attempt:
    """One file to damage.

    Attributes:
        name: what is done, for the list of failures.
        file: the file below the folder of the sample.
        change: called with its path.
        must_fail: whether a reader that reads it without an error is wrong.
    """

    name: str
    file: str
    change: Callable[[Path], object]
    must_fail: bool = False


def crafted(folder: Path, patterns: tuple[str, ...], chance: random.Random) -> list[Attempt]:
    """All crafted attacks on the files of a sample, in random order."""
    found = []
    for name in _targets(folder, patterns):
        content = (folder / name).read_bytes()
        found += [Attempt(f"{name}: {title}", name, act) for title, act in _REPLACEMENTS.items()]
        edits = _edits_of(name)
        inside = members(content) if Path(name).suffix in _ARCHIVES else {}
        for member in _of_each_kind(list(inside)):
            changes = _edits_of(member).items()
            edits |= {f"{member}: {title}": _inside(member, edit) for title, edit in changes}
        found += [_edited(name, *edit, chance.randrange(2**32)) for edit in edits.items()]
    chance.shuffle(found)
    return found


def mutated(
    folder: Path, patterns: tuple[str, ...], chance: random.Random, count: int
) -> list[Attempt]:
    """Random changes of the files of a sample."""
    names = _targets(folder, patterns)
    found = []
    for number in range(count):
        title, edit = chance.choice(list(_MUTATIONS.items()))
        seed = chance.randrange(2**32)
        found.append(_edited(chance.choice(names), f"{title} {number}", edit, seed))
    return found


def _edited(name: str, title: str, edit: Edit, seed: int) -> Attempt:
    def change(path: Path) -> None:
        path.write_bytes(edit(path.read_bytes(), random.Random(seed)))

    # A text of this form may be the name of a class.
    numbers = name.endswith("intrinsics.yaml")
    is_wrong = title.endswith(TWICE) or (numbers and title.endswith(TO_THE_BASE_OF_60))
    return Attempt(f"{name}: {title}", name, change, is_wrong)


def _inside(member: str, edit: Edit) -> Edit:
    return lambda content, chance: with_member(
        content, member, edit(members(content)[member], chance)
    )


def _edits_of(name: str) -> Edits:
    return _EDITS.get(Path(name).suffix, dict)() | binary_edits()


def _targets(folder: Path, patterns: tuple[str, ...]) -> list[str]:
    """A file of each suffix and folder, and every document, below a folder."""
    found: set[Path] = set()
    for pattern in patterns:
        place, _, last = pattern.rpartition("/")
        found |= {path for path in (folder / place).rglob(last) if path.is_file()}
    return _of_each_kind([path.relative_to(folder).as_posix() for path in sorted(found)])


def _of_each_kind(names: list[str]) -> list[str]:
    """Of names that differ in their digits only, the first."""
    kinds: dict[str, str] = {}
    for name in names:
        kinds.setdefault("".join(c for c in name if not c.isdigit()), name)
    return list(kinds.values())


def _replaced(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        path.unlink()
        make(path)

    return change


_REPLACEMENTS: Mapping[str, Callable[[Path], object]] = {
    "a device": _replaced(lambda path: path.symlink_to("/dev/zero")),
    "a pipe": _replaced(lambda path: os.mkfifo(path)),
    "a folder": _replaced(lambda path: path.mkdir()),
    "a link to itself": _replaced(lambda path: path.symlink_to(path.name)),
    "missing": lambda path: path.unlink(),
    "20 GB long": lambda path: os.truncate(path, 20 * 2**30),
}


def _flipped(content: bytes, chance: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(chance.randint(1, 16) if content else 0):
        changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def _part(change: Callable[[bytes, bytes, bytes, random.Random], bytes]) -> Edit:
    """Changes what lies before, in and behind a short part at a random place."""

    def edit(content: bytes, chance: random.Random) -> bytes:
        start = chance.randint(0, len(content))
        end = min(len(content), start + chance.choice((1, 2, 4, 8, 64, 1024)))
        return change(content[:start], content[start:end], content[end:], chance)

    return edit


_MUTATIONS: Mapping[str, Edit] = {
    "flipped": _flipped,
    "cut": _part(lambda before, *_: before),
    "removed": _part(lambda before, _, after, __: before + after),
    "repeated": _part(lambda a, part, b, chance: a + part * chance.randint(2, 51) + b),
    "inserted": _part(lambda a, p, b, chance: a + chance.randbytes(chance.randint(1, 64)) + p + b),
    "filled": _part(lambda a, p, b, chance: a + bytes([chance.choice((0, 255))]) * len(p) + b),
}
