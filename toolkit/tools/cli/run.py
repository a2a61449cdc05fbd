"""`semsplat run`: track and map a dataset, evaluate the result and write a run folder."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import tyro
from tqdm import tqdm

from toolkit.base.errors import SettingsError, Stopped
from toolkit.runs.settings import PresetName, RunSettings, load_settings
from toolkit.runs.stopping import StopSignals
from toolkit.tools.cli.arguments import parse_arguments

if TYPE_CHECKING:
    from toolkit.runs.observers import ProgressObserver


@dataclass(frozen=True, kw_only=True)
class RunArguments(RunSettings):
    """The arguments of programs that create a run."""

    out: Path
    """Folder of the run, new or empty unless the run is resumed."""
    preset: PresetName = "default"
    """Settings to start from: fast, default or best, or those of the papers' systems: hier-slam,
    hier-slam-mono and gausem."""
    config: Path | None = None
    """YAML file of settings. They take precedence over the preset, and options on the command line
    over both."""
    record: Path | None = None
    """File (.rrd) to record the run to, for the viewer of Rerun."""

    @property
    def settings(self) -> RunSettings:
        """The settings of the run."""
        return RunSettings(**{f.name: getattr(self, f.name) for f in fields(RunSettings)})


@dataclass(frozen=True, kw_only=True)
class RunProgram(RunArguments):
    """Track and map a sequence, with or without depth, evaluate it and write a run folder."""

    resume: bool = False
    """Continue an interrupted run from its last checkpoint."""


Program = TypeVar("Program", bound=RunArguments)
Item = TypeVar("Item")


def main(argv: Sequence[str]) -> int:
    """Run SLAM on a dataset.

    Raises:
        ToolkitError: bad settings, data or output folder.
    """
    program = parse_run(RunProgram, list(argv), "run")
    # Imports torch, which takes seconds; wrong arguments are reported before.
    from toolkit.runs.execution import run

    observers, stop = progress_observers(program), StopSignals()
    try:
        with stop.handled():
            run(program.settings, program.out, program.resume, with_progress, observers, stop)
    except Stopped as stopped:
        raise Stopped(stopped.number, resumption(program.out, argv)) from None
    return 0


def resumption(out: Path, argv: Sequence[str]) -> str:
    """How a run that was ended by a signal is continued.

    Args:
        out: the run folder.
        argv: arguments of `semsplat run`.
    """
    from toolkit.runs.folder import RunFolder

    folder = RunFolder(out)
    if not folder.config.is_file():
        return "nothing was written"
    words = [*argv, *(["--resume"] if "--resume" not in argv else [])]
    state = "a checkpoint is saved" if folder.checkpoints else "there is no checkpoint yet"
    return f"{state}; continue with: {shlex.join(['semsplat', 'run', *words])}"


def parse_run(kind: type[Program], argv: list[str], job: str) -> Program:
    """Parse the arguments of a program that creates a run.

    Raises:
        SettingsError: an option, the preset or the file of settings is invalid.
    """
    config, preset = _value(argv, "--config"), _value(argv, "--preset")
    try:
        settings = load_settings(Path(config) if config else None, preset or "default")
    except SettingsError:
        if config and "--resume" in argv:
            _check_version(Path(config))
        raise
    return parse_arguments(kind, argv, job, default=kind(out=tyro.MISSING, **vars(settings)))


def _check_version(config: Path) -> None:
    """Check that the settings of a run that is resumed are not those of another version."""
    from toolkit.runs.folder import RunFolder

    folder = RunFolder(config.parent)
    if folder.config == config and folder.loops.is_file():
        folder.check_version()


def progress_observers(program: RunArguments) -> list[ProgressObserver]:
    """Build the observers that the arguments ask for.

    Raises:
        DependencyError: the package of one is missing.
        SettingsError: its file exists or has another suffix.
    """
    if program.record is None:
        return []
    from toolkit.tools.viewer.rerun_recorder import RerunRecorder

    return [RerunRecorder(program.record)]


def _value(argv: list[str], flag: str) -> str | None:
    """The last value of an option on the command line; None where it is not given."""
    found = None
    for word, following in zip(argv, [*argv[1:], ""], strict=True):
        if word == flag:
            found = following
        elif word.startswith(f"{flag}="):
            found = word.partition("=")[2]
    return found or None


def with_progress(
    items: Iterable[Item], total: int | None, first: int, unit: str = "frame", /
) -> Iterable[Item]:
    """Wrap items in a progress bar, which is only displayed in terminals."""
    return tqdm(items, total=total, initial=first, unit=unit, disable=None)
