"""Read finished runs for a comparison page."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import RunFolderError
from toolkit.base.options import as_plain
from toolkit.io.images import read_rgb
from toolkit.runs.evaluation.comparison import ComparedRun
from toolkit.runs.evaluation.metrics import flattened, read_metrics
from toolkit.runs.folder import RunFolder
from toolkit.runs.settings import load_stored_settings


def compared_run(path: Path, name: str, page: Path) -> ComparedRun:
    """Read a finished run.

    Args:
        path: run folder.
        name: name of the run on the page.
        page: file of the page, from which the run's report is linked.

    Raises:
        ToolkitError: the folder contains no finished run.
    """
    folder = RunFolder.open(path)
    for file in (folder.metrics, folder.trajectory):
        if not file.is_file():
            raise RunFolderError(
                f"{path} has no {file.name}: the run is not finished; "
                "repeat its semsplat run command with --resume"
            )
    settings = as_plain(load_stored_settings(folder.config)[0])
    report = None
    if folder.report.is_file():
        report = quote(Path(os.path.relpath(folder.report, page.parent)).as_posix())
    return ComparedRun(
        name,
        flattened(settings),
        flattened(read_metrics(folder.metrics)),
        folder.read_trajectory(),
        {file.name: _rgb(file) for file in sorted(folder.renders.glob("frame??????.png"))},
        report,
    )


def _rgb(file: Path) -> NDArray[np.uint8]:
    return np.rint(255.0 * read_rgb(file)).astype(np.uint8)
