"""The plan of the code: packages, layers, lines, options and names, at several commits.

    python -m benchmarks.structure --commits dbd490e 0dbd270

The working tree is the last column. Counts are of Python in `toolkit/`: packages are its folders,
layers the rows of the contract in setup.cfg, small modules those under 60 lines. Options are those
of `semsplat run`, with the names of the deepest one.
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
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.repository import ROOT
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.tables import Table

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


@dataclass(frozen=True)
class Options:
    """Count packages, layers, lines, options and names."""

    commits: tuple[str, ...] = ()
    """Commits to compare the working tree with."""
    write: bool = True
    """Write benchmarks/results/structure.md."""


def measure(checkout: Path) -> dict[str, int]:
    """The counts of a checkout."""
    package = checkout / "toolkit"
    modules = sorted(package.rglob("*.py"))
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules}
    named = [path for path in modules if path.name != "__init__.py"]
    classes = Counter(
        node.name
        for path in named
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    contracts = ConfigParser()
    contracts.read(checkout / "setup.cfg")
    options, deepest = _options(checkout)
    return {
        "packages": len({path.relative_to(package).parts[0] for path in named} - _files(package)),
        "modules beside them": len(_files(package)),
        "layers": len(contracts["importlinter:contract:layers"]["layers"].split("\n")) - 1,
        "modules": len(named),
        f"modules under {SMALL_LINES} lines": sum(lines[p] < SMALL_LINES for p in named),
        "lines": sum(lines.values()),
        "lines of the longest module": max(lines.values()),
        "public class names used twice": sum(count > 1 for count in classes.values()),
        "options of run": options,
        "names of the deepest option": deepest,
    }


def _files(package: Path) -> set[str]:
    return {path.name for path in package.glob("*.py")} - {"__init__.py"}


def _options(checkout: Path) -> tuple[int, int]:
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    run = subprocess.run(
        [sys.executable, "-c", _OPTIONS],
        cwd=checkout,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    count, deepest = run.stdout.split()
    return int(count), int(deepest)


def _at(commit: str, folder: Path) -> dict[str, int]:
    """The counts of a commit, which is unpacked into a folder."""
    archive = subprocess.run(
        ["git", "archive", commit], cwd=ROOT, check=True, capture_output=True
    ).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(folder, filter="data")
    return measure(folder)


def main() -> None:
    """Print and write the counts."""
    options = tyro.cli(Options)
    columns = {}
    for commit in options.commits:
        with tempfile.TemporaryDirectory() as folder:
            columns[commit] = _at(commit, Path(folder))
    columns["now"] = measure(ROOT)
    rows = tuple(
        (name, *(f"{column[name]:,}" for column in columns.values())) for name in columns["now"]
    )
    table = Table(("", *columns), rows)
    print(table.markdown())
    if options.write:
        header = current_header(measures=("toolkit", "setup.cfg"))
        description = (__doc__ or "").split("\n\n", 2)[2].strip()
        Results("structure", "Structure of the code", description, header, (table,)).write(RESULTS)


if __name__ == "__main__":
    main()
