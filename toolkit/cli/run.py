"""`semsplat run`: track and map a dataset, evaluate, write a run folder."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.frame import Frame
from toolkit.runs.execution import run
from toolkit.settings.files import load
from toolkit.settings.run import RunSettings


@dataclass(frozen=True)
class RunProgram:
    """Track and map an RGB-D sequence."""

    out: Path
    """Run folder to write."""
    settings: Annotated[RunSettings, tyro.conf.arg(name="")] = field(default_factory=RunSettings)
    config: Path | None = None
    """YAML settings to start from, or the preset `gausem` (the values of GauSem-SLAM's paper).
    Options on the command line override them."""
    resume: bool = False
    """Go on from the last checkpoint of an interrupted run."""


def main(argv: Sequence[str]) -> int:
    """Run SLAM on a dataset.

    Raises:
        ToolkitError: bad settings, data or output folder.
    """
    program = _parse(list(argv))
    run(program.settings, program.out, program.resume, _with_progress)
    return 0


def _parse(argv: list[str]) -> RunProgram:
    start = RunSettings()
    if "--config" in argv[:-1]:
        start = load(Path(argv[argv.index("--config") + 1]))
    default = RunProgram(out=tyro.MISSING, settings=start)
    return parse_arguments(RunProgram, argv, "run", default=default)


def _with_progress(frames: Iterable[Frame], total: int, first: int) -> Iterable[Frame]:
    return tqdm(frames, total=total, initial=first, unit="frame", file=sys.stderr)
