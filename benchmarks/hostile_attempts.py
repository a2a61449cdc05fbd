"""Attempts to harm a reader: a valid sample with one file that was crafted or changed at random."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks.hostile_binary import (
    archive_edits,
    array_edits,
    binary_edits,
    jpeg_edits,
    members,
    png_edits,
    with_member,
)
from benchmarks.hostile_documents import (
    Edit,
    json_edits,
    table_edits,
    yaml_edits,
)
from benchmarks.hostile_scenes import depth_edits, ply_edits, usd_edits

_LARGE = 20 * 2**30
_ARCHIVES = (".npz", ".r3d", ".sog", ".usdz")
_EDITS: Mapping[str, Callable[[], dict[str, Edit]]] = {
    **dict.fromkeys((".json", ".gltf", "metadata"), json_edits),
    ".jsonl": json_edits,
    ".yaml": yaml_edits,
    **dict.fromkeys((".txt", ".csv"), table_edits),
    ".png": png_edits,
    **dict.fromkeys((".jpg", ".jpeg"), jpeg_edits),
    ".npy": array_edits,
    **dict.fromkeys(_ARCHIVES, archive_edits),
    ".ply": ply_edits,
    ".usda": usd_edits,
    **dict.fromkeys((".depth", ".conf"), depth_edits),
}
# What must not be read without an error, whatever the file is.
_MUST_FAIL = ("a key given twice", "to the base of 60")


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
    change: Callable[[Path], None]
    must_fail: bool = False


def crafted(folder: Path, patterns: tuple[str, ...], chance: random.Random) -> list[Attempt]:
    """All crafted attacks on the files of a sample, in random order."""
    found = []
    for path in _targets(folder, patterns):
        name, content = path.relative_to(folder).as_posix(), path.read_bytes()
        for title, replace in _REPLACEMENTS.items():
            found.append(Attempt(f"{name}: {title}", name, replace))
        for title, edit in _edits_of(path.name).items():
            seed = chance.randrange(2**32)
            found.append(_edited(name, title, edit, seed))
        inside = members(content) if path.suffix in _ARCHIVES else {}
        for member in _of_each_kind(list(inside)):
            for title, edit in _edits_of(member).items():
                whole = _inside(member, edit)
                found.append(_edited(name, f"{member}: {title}", whole, chance.randrange(2**32)))
    chance.shuffle(found)
    return found


def mutated(
    folder: Path, patterns: tuple[str, ...], chance: random.Random, count: int
) -> list[Attempt]:
    """Random changes of the files of a sample."""
    names = [path.relative_to(folder).as_posix() for path in _targets(folder, patterns)]
    found = []
    for number in range(count):
        title, edit = chance.choice(list(_MUTATIONS.items()))
        name = chance.choice(names)
        found.append(_edited(name, f"{title} {number}", edit, chance.randrange(2**32)))
    return found


def _edited(name: str, title: str, edit: Edit, seed: int) -> Attempt:
    def change(path: Path) -> None:
        path.write_bytes(edit(path.read_bytes(), random.Random(seed)))

    is_wrong = any(title.endswith(each) for each in _MUST_FAIL)
    return Attempt(f"{name}: {title}", name, change, is_wrong)


def _inside(member: str, edit: Edit) -> Edit:
    def whole(content: bytes, chance: random.Random) -> bytes:
        return with_member(content, member, edit(members(content)[member], chance))

    return whole


def _edits_of(name: str) -> dict[str, Edit]:
    suffix = Path(name).suffix.lower() or name
    edits = _EDITS.get(suffix, binary_edits)()
    return edits if edits.keys() >= binary_edits().keys() else edits | binary_edits()


def _targets(folder: Path, patterns: tuple[str, ...]) -> list[Path]:
    """A file of each suffix and folder, and every document."""
    found = {
        path
        for pattern in patterns
        for path in (folder.rglob("*") if pattern == "*" else _matching(folder, pattern))
        if path.is_file()
    }
    names = _of_each_kind([path.relative_to(folder).as_posix() for path in sorted(found)])
    return [folder / name for name in names]


def _matching(folder: Path, pattern: str) -> list[Path]:
    """Files that match a pattern below its folder."""
    place, _, last = pattern.rpartition("/")
    return [*(folder / place).rglob(last)]


def _of_each_kind(names: list[str]) -> list[str]:
    """Of names that differ in their digits only, the first."""
    kinds: dict[tuple[str, ...], str] = {}
    for name in names:
        kinds.setdefault(tuple("".join(c for c in name if not c.isdigit()).split("/")), name)
    return list(kinds.values())


def _replaced(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        path.unlink()
        make(path)

    return change


def _enlarged(path: Path) -> None:
    os.truncate(path, _LARGE)


_REPLACEMENTS: Mapping[str, Callable[[Path], None]] = {
    "a device": _replaced(lambda path: path.symlink_to("/dev/zero")),
    "a pipe": _replaced(lambda path: os.mkfifo(path)),
    "a folder": _replaced(lambda path: path.mkdir()),
    "a link to itself": _replaced(lambda path: path.symlink_to(path.name)),
    "missing": _replaced(lambda _: None),
    "20 GB long": _enlarged,
}


def _flipped(content: bytes, chance: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(chance.randint(1, 16) if content else 0):
        changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def _cut(content: bytes, chance: random.Random) -> bytes:
    return content[: chance.randint(0, len(content))]


def _without_part(content: bytes, chance: random.Random) -> bytes:
    start, end = _range(content, chance)
    return content[:start] + content[end:]


def _repeated(content: bytes, chance: random.Random) -> bytes:
    start, end = _range(content, chance)
    return content[:end] + content[start:end] * chance.randint(1, 50) + content[end:]


def _inserted(content: bytes, chance: random.Random) -> bytes:
    place = chance.randint(0, len(content))
    return content[:place] + chance.randbytes(chance.randint(1, 64)) + content[place:]


def _filled(content: bytes, chance: random.Random) -> bytes:
    start, end = _range(content, chance)
    return content[:start] + bytes([chance.choice((0, 255))]) * (end - start) + content[end:]


def _exchanged(content: bytes, chance: random.Random) -> bytes:
    a, b = _range(content, chance)
    c = chance.randint(b, len(content))
    return content[:a] + content[b:c] + content[a:b] + content[c:]


def _range(content: bytes, chance: random.Random) -> tuple[int, int]:
    """A place and the end of a short part there."""
    start = chance.randint(0, len(content))
    return start, min(len(content), start + chance.choice((1, 2, 4, 8, 64, 1024)))


_MUTATIONS: Mapping[str, Edit] = {
    "flipped": _flipped,
    "cut": _cut,
    "removed": _without_part,
    "repeated": _repeated,
    "inserted": _inserted,
    "filled": _filled,
    "exchanged": _exchanged,
}
