"""`semsplat run`: track and map a dataset, evaluate the result and write a run folder."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.runs.settings import RunSettings, load_settings

if TYPE_CHECKING:
    from toolkit.frame import Frame


@dataclass(frozen=True, kw_only=True)
class RunProgram(RunSettings):
    """Track and map an RGB-D sequence, evaluate the result and write a run folder."""

    out: Path
    """Folder of the run, new or empty unless the run is resumed."""
    config: Path | None = None
    """YAML file of settings, or the preset gausem (the values of GauSem-SLAM's paper). Options on
    the command line take precedence."""
    resume: bool = False
    """Continue an interrupted run from its last checkpoint."""

    @property
    def settings(self) -> RunSettings:
        """The settings of the run."""
        return RunSettings(**{f.name: getattr(self, f.name) for f in fields(RunSettings)})


def main(argv: Sequence[str]) -> int:
    """Run SLAM on a dataset.

    Raises:
        ToolkitError: bad settings, data or output folder.
    """
    program = _parse(list(argv))
    # Imports torch, which takes seconds; wrong arguments are reported before.
    from toolkit.runs.execution import run

    run(program.settings, program.out, program.resume, _with_progress)
    return 0


def _parse(argv: list[str]) -> RunProgram:
    settings = RunSettings()
    if "--config" in argv[:-1]:
        settings = load_settings(Path(argv[argv.index("--config") + 1]))
    default = RunProgram(out=tyro.MISSING, **vars(settings))
    return parse_arguments(RunProgram, argv, "run", default=default)


def _with_progress(frames: Iterable[Frame], total: int, first: int) -> Iterable[Frame]:
    bar = {"unit": "frame", "file": sys.stderr, "disable": not sys.stderr.isatty()}
    return tqdm(frames, total=total, initial=first, **bar)
