"""Mutation testing: small changes of a package's code that its tests do not notice.

    python -m benchmarks.code.mutations splatting/alignment --count 25 --seed 0

Each mutant differs from the code in one place: a comparison, a term or sign of a sum, a factor of
a product, an `and`, or a numeric constant of the module. Mutants are tested in temporary copies of
the checkout with the tests of their package, `tests/PACKAGE`. A mutant survives if all of them
pass: a test is missing, or the mutant behaves as the code does.
"""

from __future__ import annotations

import importlib.util
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from benchmarks.code.mutants import Mutant, mutants
from benchmarks.shared.repository import ROOT
from benchmarks.shared.tables import Table

_COPIED = ("toolkit", "tests", "benchmarks", "data_tools", "apps", "setup.cfg", "pyproject.toml")


@dataclass(frozen=True)
class Options:
    """Change the code of a package in one place at a time and run its tests."""

    target: Annotated[str, tyro.conf.Positional]
    """A package of the toolkit such as `splatting/alignment`, or a file of it."""
    count: int = 25
    """Number of mutants, drawn at random from all; 0 for all."""
    seed: int = 0
    """Seed of the draw."""
    limit_s: float = 60.0
    """Time limit for the tests of one mutant, in seconds."""
    ignore: tuple[str, ...] = ()
    """Files of tests to leave out, from the root."""
    exclude: tuple[str, ...] = ()
    """Files and folders of the package to leave out, such as `cuda`, before mutants are drawn."""
    only: tuple[str, ...] = ()
    """Of the drawn mutants, those in these lines, such as `splatting/alignment/joint.py:35`."""


def sample(options: Options) -> list[tuple[Path, Mutant]]:
    """The drawn mutants with the path of their module below the root.

    Raises:
        ValueError: the package or file is unknown.
    """
    place = ROOT / "toolkit" / options.target
    modules = [place] if place.suffix == ".py" else sorted(place.rglob("*.py"))
    if not modules or not place.exists():
        raise ValueError(f"toolkit/{options.target} is no Python package or file")
    paths = [
        (path, path.relative_to(ROOT))
        for path in modules
        if not set(path.relative_to(ROOT).parts) & set(options.exclude)
    ]
    drawn = [(name, m) for path, name in paths for m in mutants(path.read_text(encoding="utf-8"))]
    if 0 < options.count < len(drawn):
        kept = sorted(random.Random(options.seed).sample(range(len(drawn)), options.count))
        drawn = [drawn[i] for i in kept]
    chosen = {f"toolkit/{line}" for line in options.only}
    return [(name, m) for name, m in drawn if not chosen or f"{name}:{m.line}" in chosen]


@contextmanager
def _changed(path: Path, source: str) -> Iterator[None]:
    """Give a module other code for a while."""
    original = path.read_text(encoding="utf-8")
    compiled = Path(importlib.util.cache_from_source(str(path)))

    def write(code: str) -> None:
        path.write_text(code, encoding="utf-8")
        compiled.unlink(missing_ok=True)  # Python compares only sizes and whole seconds

    write(source)
    try:
        yield
    finally:
        write(original)


def _outcome(checkout: Path, tests: list[str], limit_s: float) -> str:
    """Run tests in a copy of the checkout: "survived", "killed" or "timed out"."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    with subprocess.Popen(
        command,
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # with the processes that tests start
    ) as process:
        try:
            return "survived" if process.wait(limit_s) == 0 else "killed"
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return "timed out"


def measure(options: Options, drawn: list[tuple[Path, Mutant]], folder: Path) -> list[str]:
    """The outcome of each mutant, tested in a copy of the checkout in a folder.

    Raises:
        ValueError: the tests fail, or take too long, without a change.
    """
    tests = [f"tests/{options.target.split('/')[0]}", *(f"--ignore={p}" for p in options.ignore)]
    checkout, verdicts = _copy(folder / "checkout"), []
    if _outcome(checkout, tests, options.limit_s) != "survived":
        raise ValueError(f"{tests[0]} fails or exceeds {options.limit_s} s without a change")
    for name, mutant in drawn:
        with _changed(checkout / name, mutant.source()):
            verdicts.append(_outcome(checkout, tests, options.limit_s))
        print(f"{name}:{mutant.line} {verdicts[-1]}", file=sys.stderr)
    return verdicts


def _copy(checkout: Path) -> Path:
    """Copy what tests need from the working tree."""
    checkout.mkdir()
    for name in _COPIED:
        source, copy = ROOT / name, checkout / name
        if source.is_dir():
            shutil.copytree(source, copy, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, copy)
    return checkout


def main() -> int:
    """Print the survivors and the number of mutants with each outcome."""
    options = tyro.cli(Options)
    try:
        drawn = sample(options)
        with tempfile.TemporaryDirectory() as folder:
            verdicts = measure(options, drawn, Path(folder))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    rows = tuple(
        (f"{name.relative_to('toolkit')}:{mutant.line}", f"`{mutant.change}`")
        for (name, mutant), verdict in zip(drawn, verdicts, strict=True)
        if verdict == "survived"
    )
    print(Table(("survivor", "change"), rows).markdown())
    counts = Counter(verdicts)
    figures = [f"{counts[verdict]} {verdict}" for verdict in ("killed", "survived", "timed out")]
    print(f"\n{options.target}: {len(drawn)} mutants, {', '.join(figures)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
