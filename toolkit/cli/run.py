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
from toolkit.runs.settings import PresetName, RunSettings, load_settings

if TYPE_CHECKING:
    from toolkit.frame import Frame


@dataclass(frozen=True, kw_only=True)
class RunProgram(RunSettings):
    """Track and map a sequence, with or without depth, evaluate it and write a run folder."""

    out: Path
    """Folder of the run, new or empty unless the run is resumed."""
    preset: PresetName = "default"
    """Settings to start from: fast, default or best, or those of the papers' systems: hier-slam,
    hier-slam-mono and gausem."""
    config: Path | None = None
    """YAML file of settings. They take precedence over the preset, and options on the command line
    over both."""
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
    config, preset = _value(argv, "--config"), _value(argv, "--preset")
    settings = load_settings(Path(config) if config else None, preset or "default")
    default = RunProgram(out=tyro.MISSING, **vars(settings))
    return parse_arguments(RunProgram, argv, "run", default=default)


def _value(argv: list[str], flag: str) -> str | None:
    """The last value of an option on the command line; None where it is not given."""
    found = None
    for word, following in zip(argv, [*argv[1:], ""], strict=True):
        if word == flag:
            found = following
        elif word.startswith(f"{flag}="):
            found = word.partition("=")[2]
    return found or None


def _with_progress(frames: Iterable[Frame], total: int | None, first: int) -> Iterable[Frame]:
    bar = {"unit": "frame", "file": sys.stderr, "disable": not sys.stderr.isatty()}
    return tqdm(frames, total=total, initial=first, **bar)
