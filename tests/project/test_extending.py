"""The pages on adding a part to semsplat, followed literally in a copy of the checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import documentation
import pytest
from documentation import PAGES, Block

CHANGING = [page for page in PAGES if documentation.changes(page)]


def follow(folder: Path, block: Block) -> Path:
    """Create or change the file of a block; returns it."""
    path = folder / block.file
    if block.language != "diff":
        assert not path.exists(), f"{block.place}: {block.file} exists"
        path.parent.mkdir(exist_ok=True)
        path.write_text(block.text + "\n", encoding="utf-8")
        return path
    lines = [line or " " for line in block.text.splitlines()]
    old, new = (
        "".join(f"{line[1:]}\n" for line in lines if line[0] in kept) for kept in (" -", " +")
    )
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1, f"{block.place}: {block.file} has {text.count(old)} such places"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def extended(checkout, tmp_path_factory) -> Path:
    """A copy of the checkout without other programs."""
    folder = tmp_path_factory.mktemp("extended")
    unused = shutil.ignore_patterns("__pycache__", "src")
    for name in ("toolkit", "tests"):
        shutil.copytree(checkout / name, folder / name, ignore=unused)
    for name in ("setup.cfg", "pyproject.toml"):
        shutil.copy(checkout / name, folder)
    return folder


def call(folder: Path, *words: str | Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(folder)}
    result = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("page", CHANGING, ids=lambda page: page.stem)
def test_following_a_page_works(page: Path, extended: Path):
    files = {follow(extended, block) for block in documentation.changes(page)}
    ruff = Path(sys.executable).with_name("ruff")
    if ruff.exists():
        call(extended, ruff, "check", "--no-cache", *files)
        call(extended, ruff, "format", "--no-cache", "--check", *files)
    commands = [command.words for command in documentation.commands(page)]
    assert commands
    for program, *words in commands:
        assert program == "python"
        call(extended, sys.executable, *words)


def test_a_change_that_has_no_place_is_reported(tmp_path):
    (tmp_path / "a.py").write_text("x = 1\n")
    with pytest.raises(AssertionError, match=r"here: a.py has 0 such places"):
        follow(tmp_path, Block("here", "diff", "-x = 2\n+x = 3", file="a.py"))
