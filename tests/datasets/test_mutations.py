"""Random damage to good recordings of every layout: each is read, or one line names the fault."""

from __future__ import annotations

import contextlib
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit.base.errors import ToolkitError
from toolkit.datasets.registry import open_dataset
from toolkit.tools.cli.main import main

LAYOUTS = (
    *("folder", "tum", "replica", "seven-scenes", "scannet"),
    *("nerfstudio", "stray-scanner", "polycam"),
)
MUTATIONS = 25
_TEXT = (".txt", ".json", ".yaml", ".csv")
_NUMBERS = ("nan", "inf", "-1", "0", "1e400", "99999999999", "x", "", "0x1F", "1,5", "٣")


def _file(folder: Path, chance: random.Random, suffixes: tuple[str, ...] = ()) -> Path:
    files = sorted(f for f in folder.rglob("*") if f.is_file() and f.stat().st_size)
    if not files:
        pytest.skip("the first mutation has left no file")
    return chance.choice([f for f in files if not suffixes or f.suffix in suffixes] or files)


def flip_bytes(folder: Path, chance: random.Random) -> None:
    file = _file(folder, chance)
    content = bytearray(file.read_bytes())
    for _ in range(chance.randint(1, 20)):
        content[chance.randrange(len(content))] = chance.randrange(256)
    file.write_bytes(content)


def truncate(folder: Path, chance: random.Random) -> None:
    file = _file(folder, chance)
    content = file.read_bytes()
    file.write_bytes(content[: chance.randrange(len(content))])


def insert_bytes(folder: Path, chance: random.Random) -> None:
    file = _file(folder, chance)
    content, place = file.read_bytes(), chance.randrange(file.stat().st_size + 1)
    file.write_bytes(content[:place] + chance.randbytes(chance.randint(1, 300)) + content[place:])


def remove(folder: Path, chance: random.Random) -> None:
    _file(folder, chance).unlink()


def rename(folder: Path, chance: random.Random) -> None:
    file = _file(folder, chance)
    file.rename(file.with_name(chance.choice(["0", "x" * 200, "名前", "a b", "-1"]) + file.suffix))


def exchange(folder: Path, chance: random.Random) -> None:
    """Another file's content, of another type or size."""
    first, second = _file(folder, chance), _file(folder, chance)
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)


def replace_by_folder(folder: Path, chance: random.Random) -> None:
    file = _file(folder, chance)
    file.unlink()
    file.mkdir()


def replace_by_link(folder: Path, chance: random.Random) -> None:
    file = _file(folder, chance)
    file.unlink()
    file.symlink_to(folder / chance.choice(["nothing", file.name, "."]))


def change_number(folder: Path, chance: random.Random) -> None:
    file = _file(folder, chance, _TEXT)
    words = file.read_text(errors="replace").split(" ")
    words[chance.randrange(len(words))] = chance.choice(_NUMBERS)
    file.write_text(" ".join(words))


def shuffle_lines(folder: Path, chance: random.Random) -> None:
    file = _file(folder, chance, _TEXT)
    lines = file.read_text(errors="replace").splitlines()
    lines = (
        chance.choices(lines or [""], k=len(lines) + 1) if chance.random() < 0.5 else lines[::-1]
    )
    file.write_text("\n".join(lines))


def empty_folder(folder: Path, chance: random.Random) -> None:
    folders = sorted(f for f in folder.rglob("*") if f.is_dir() and not f.is_symlink()) or [folder]
    chosen = chance.choice(folders)
    shutil.rmtree(chosen)
    chosen.mkdir()


KINDS: tuple[Callable[[Path, random.Random], None], ...] = (
    *(flip_bytes, truncate, insert_bytes, remove, rename, exchange),
    *(replace_by_folder, replace_by_link, change_number, shuffle_lines, empty_folder),
)


@pytest.mark.parametrize("seed", range(MUTATIONS))
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_damaged_recording_is_read_or_explained(layout, seed, request, capsys):
    folder = request.getfixturevalue(f"make_{layout.replace('-', '_')}")()
    chance = random.Random(f"{layout} {seed}")
    mutations = chance.sample(KINDS, k=1 if seed % 3 else 2)
    for mutation in mutations:
        mutation(folder, chance)
    status = main(["check-data", "--kind", layout, "--path", str(folder)])
    output = capsys.readouterr()
    assert status in (0, 1, 2)
    if status == 2:
        (line,) = output.err.strip().splitlines()
        assert line.startswith("semsplat: error: ")
        assert len(line) < 700
        # It names the place, or a file in it.
        names = [folder.name, *(f.name for f in folder.rglob("*"))]
        assert any(name in line for name in names), line
    if status == 1:
        assert "error: " in output.out
    with contextlib.suppress(ToolkitError):
        for frame in open_dataset(layout, folder):
            assert frame.depth_m.shape == frame.rgb.shape[:2]
