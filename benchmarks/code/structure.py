"""The plan of the code: packages, layers, lines, options and names, at several commits.

    python -m benchmarks.code.structure --commits dbd490e 0dbd270

The working tree is the last column. Counts are of Python in `toolkit/`: packages are its folders,
layers the rows of the contract in setup.cfg, small modules those under 60 lines. Options are those
of `semsplat run`, with the names of the deepest one. Prints only.
"""

from __future__ import annotations

import ast
import io
import os
import subprocess
import sys
import tarfile
import tempfile
from collections import Counter
from configparser import ConfigParser
from pathlib import Path

import tyro

from benchmarks.shared.repository import ROOT
from benchmarks.shared.tables import Table

SMALL_LINES = 60
# Prints the number of options, and the length of the longest path of names.
_OPTIONS = """
from dataclasses import fields, is_dataclass
from typing import get_type_hints
from toolkit.runs.settings import RunSettings

def depths(kind, depth):
    for name, hint in get_type_hints(kind).items():
        yield from depths(hint, depth + 1) if is_dataclass(hint) else [depth + 1]

found = list(depths(RunSettings, 0))
print(len(found), max(found))
"""


def measure(checkout: Path) -> dict[str, int]:
    """The counts of a checkout."""
    package = checkout / "toolkit"
    modules = {path: path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
    lines = {path: len(text.splitlines()) for path, text in modules.items()}
    named = [path for path in modules if path.name != "__init__.py"]
    classes = Counter(
        node.name
        for path in named
        for node in ast.parse(modules[path]).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    beside = [path for path in named if path.parent == package]
    contracts = ConfigParser()
    contracts.read(checkout / "setup.cfg")
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    command = [sys.executable, "-c", _OPTIONS]
    printed = subprocess.check_output(command, cwd=checkout, env=environment, text=True)
    options, deepest = map(int, printed.split())
    rooms = {path.relative_to(package).parts[0] for path in named if path not in beside}
    return {
        "packages": len(rooms),
        "modules beside them": len(beside),
        "layers": len(contracts["importlinter:contract:layers"]["layers"].split("\n")) - 1,
        "modules": len(named),
        f"modules under {SMALL_LINES} lines": sum(lines[p] < SMALL_LINES for p in named),
        "lines": sum(lines.values()),
        "lines of the longest module": max(lines.values()),
        "public class names used twice": sum(count > 1 for count in classes.values()),
        "options of run": options,
        "names of the deepest option": deepest,
    }


def main(commits: tuple[str, ...] = ()) -> None:
    """Print the counts of some commits and of the working tree."""
    columns = {}
    for commit in commits:
        archive = subprocess.check_output(["git", "archive", commit], cwd=ROOT)
        with tempfile.TemporaryDirectory() as folder:
            with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
                tar.extractall(folder, filter="data")
            columns[commit] = measure(Path(folder))
    columns["now"] = measure(ROOT)
    rows = [
        (name, *(f"{column[name]:,}" for column in columns.values())) for name in columns["now"]
    ]
    print(Table(("", *columns), tuple(rows)).markdown())


if __name__ == "__main__":
    tyro.cli(main)
