"""`semsplat compare`: compare runs on one HTML page."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np
import yaml
from numpy.typing import NDArray

from toolkit.cli.programs import CompareOptions
from toolkit.errors import RunFolderError
from toolkit.evaluation.comparison import ComparedRun, flattened, render_comparison, setting_rows
from toolkit.evaluation.metrics import read_metrics
from toolkit.io.atomic import write_bytes
from toolkit.io.images import read_rgb
from toolkit.runs.folder import RunFolder
from toolkit.runs.settings import dump_settings, load_settings


def main(options: CompareOptions) -> int:
    """Compare runs.

    Returns:
        0.

    Raises:
        ToolkitError: a folder contains no finished run, or the page cannot be written.
    """
    names = unique_names(options.runs)
    runs = [
        _compared(path, name, options.out) for path, name in zip(options.runs, names, strict=True)
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


def _compared(path: Path, name: str, page: Path) -> ComparedRun:
    folder = RunFolder.open(path)
    for file in (folder.metrics, folder.trajectory):
        if not file.is_file():
            raise RunFolderError(
                f"{path} has no {file.name}: the run is not finished; "
                "repeat its semsplat run command with --resume"
            )
    # Settings are read and written again, so that defaults of older files are filled in.
    settings = yaml.safe_load(dump_settings(load_settings(folder.config)))
    report = None
    if folder.report.is_file():
        report = quote(Path(os.path.relpath(folder.report, page.parent)).as_posix())
    return ComparedRun(
        name,
        flattened(settings),
        read_metrics(folder.metrics),
        folder.read_trajectory(),
        {file.name: _rgb(file) for file in sorted(folder.renders.glob("frame??????.png"))},
        report,
    )


def _rgb(file: Path) -> NDArray[np.uint8]:
    return np.rint(255.0 * read_rgb(file)).astype(np.uint8)
