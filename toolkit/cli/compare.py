"""`semsplat compare`: compare runs on one HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from toolkit.cli.programs import CompareOptions
from toolkit.evaluation.comparison import render_comparison, setting_rows
from toolkit.io.atomic import write_bytes
from toolkit.runs.comparing import compared_run


def main(options: CompareOptions) -> int:
    """Compare runs.

    Returns:
        0.

    Raises:
        ToolkitError: a folder contains no finished run, or the page cannot be written.
    """
    names = unique_names(options.runs)
    runs = [
        compared_run(path, name, options.out)
        for path, name in zip(options.runs, names, strict=True)
    ]
    write_bytes(options.out, render_comparison(runs).encode())
    print(f"compared {len(runs)} runs, {len(setting_rows(runs))} settings differ: {options.out}")
    return 0


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Return names of folders: as many of their last parts as are needed to differ."""
    parts = [path.resolve().parts for path in paths]
    longest = max(map(len, parts))
    for length in range(1, longest + 1):
        names = ["/".join(p[-length:]) for p in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{name} ({number})" for number, name in enumerate(names, start=1)]
