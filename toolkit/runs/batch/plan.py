"""Plans of many runs: a YAML file of sequences, settings and seeds."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from toolkit.base.errors import SettingsError
from toolkit.base.options import NonNegativeInt, PositiveFloat, PositiveInt, as_plain, validated
from toolkit.datasets.options import DatasetOptions
from toolkit.io.guarded.documents import read_yaml
from toolkit.runs.maps.locations import with_absolute_paths
from toolkit.runs.settings import PresetName, RunSettings, load_settings, overridden

# Names of sequences and settings become names of folders.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")

# Keys of settings that a plan specifies by keys of its own.
_PLAN_KEYS = {"dataset": "sequences", "seed": "seeds"}


@dataclass(frozen=True)
class PlannedSequence:
    """One sequence of a plan."""

    dataset: DatasetOptions
    """Dataset, as in the settings of a run."""
    options: dict[str, Any] = field(default_factory=dict)
    """Settings of all runs on this sequence. They take precedence over those of `settings`."""


@dataclass(frozen=True)
class PlannedSettings:
    """One set of settings of a plan."""

    preset: PresetName = "default"
    """Settings to start from."""
    config: Path | None = None
    """YAML file of settings, which take precedence over the preset."""
    options: dict[str, Any] = field(default_factory=dict)
    """Settings that take precedence over both."""


@dataclass(frozen=True)
class Resources:
    """What each run may use."""

    threads: PositiveInt = 1
    """Number of threads. Results are only reproducible with the same number."""
    memory_gb: PositiveFloat = 3.0
    """Memory in GB that the scheduler reserves on a cluster."""
    retries: NonNegativeInt = 3
    """How often a run is resumed on a cluster after its worker was lost or ran out of memory."""


@dataclass(frozen=True)
class Plan:
    """Sequences x settings x seeds."""

    sequences: dict[str, PlannedSequence]
    """Sequences by name."""
    settings: dict[str, PlannedSettings] = field(
        default_factory=lambda: {"default": PlannedSettings()}
    )
    """Sets of settings by name."""
    seeds: tuple[NonNegativeInt, ...] = (0,)
    """Seeds of each sequence and set of settings."""
    out: Path | None = None
    """Folder of the runs, relative to the plan. By default, the name of the plan."""
    resources: Resources = Resources()


@dataclass(frozen=True)
class PlannedRun:
    """One run of a plan.

    Attributes:
        sequence, settings_name, seed: its place in the plan.
        settings: complete settings, with absolute paths.
        folder: run folder.
    """

    sequence: str
    settings_name: str
    seed: int
    settings: RunSettings
    folder: Path

    @property
    def name(self) -> str:
        """Unique name within the plan, which is also the path of its folder."""
        return f"{self.sequence}/{self.settings_name}/seed{self.seed}"


@dataclass(frozen=True)
class PlannedRuns:
    """All runs of a plan.

    Attributes:
        runs: in the order of the plan.
        out: folder of the runs and of the table.
        resources: of each run.
    """

    runs: tuple[PlannedRun, ...]
    out: Path
    resources: Resources


def load_plan(path: Path) -> PlannedRuns:
    """Read a plan and the settings of all its runs; paths are relative to the plan's folder.

    Raises:
        SettingsError: the file cannot be read, a key is unknown, or a value is invalid.
    """
    plan = _read_plan(path)
    base = path.absolute().parent
    out = base / (plan.out or path.stem)
    runs = [
        PlannedRun(
            sequence,
            name,
            seed,
            replace(_settings(path, base, sequence, name, plan), seed=seed),
            out / sequence / name / f"seed{seed}",
        )
        for sequence in plan.sequences
        for name in plan.settings
        for seed in plan.seeds
    ]
    return PlannedRuns(tuple(runs), out, plan.resources)


def _read_plan(path: Path) -> Plan:
    try:
        content = read_yaml(path)
    except OSError as error:
        raise SettingsError(f"cannot read the plan {path}: {error.strerror}") from error
    except ValueError as error:
        raise SettingsError(f"{path} is not YAML: {error}") from error
    if not isinstance(content, dict):
        raise SettingsError(f"{path} must contain keys and values; see docs/guides/many-runs.md")
    if isinstance(content.get("settings"), dict):
        # `default:` without content is an empty set of settings.
        content["settings"] = {k: v or {} for k, v in content["settings"].items()}
    for part in ("sequences", "settings"):
        _check_names(path, part, content.get(part))
    plan = validated(Plan, content, str(path), "key '{}'".format)
    for part, entries in (("sequences", plan.sequences), ("settings", plan.settings)):
        if not entries:
            raise SettingsError(f"{path}: '{part}' is empty; add at least one")
    if not plan.seeds or len(set(plan.seeds)) < len(plan.seeds):
        raise SettingsError(f"{path}: 'seeds' must be different numbers, got {list(plan.seeds)}")
    return plan


def _check_names(path: Path, part: str, entries: Any) -> None:
    for name in entries if isinstance(entries, dict) else ():
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise SettingsError(
                f"{path}: the name {name!r} in '{part}' becomes a folder; use letters, digits, "
                "'.', '-' and '_' (quote numbers)"
            )


def _settings(path: Path, base: Path, sequence: str, name: str, plan: Plan) -> RunSettings:
    """Return the settings of one sequence with one set of settings, seed 0."""
    chosen, planned = plan.settings[name], plan.sequences[sequence]
    for where, options in (
        (f"settings.{name}.options", chosen.options),
        (f"sequences.{sequence}.options", planned.options),
    ):
        for key, place in _PLAN_KEYS.items():
            if key in options:
                raise SettingsError(f"{path}: key '{where}.{key}' belongs into '{place}'")
        # Validated on their own first, so that the message names their place.
        validated(RunSettings, options, str(path), f"key '{where}.{{}}'".format)
    config = None if chosen.config is None else base / chosen.config
    values = as_plain(load_settings(config, chosen.preset))
    values = overridden(overridden(values, chosen.options), planned.options)
    if planned.dataset.path is None:
        raise SettingsError(f"{path}: key 'sequences.{sequence}.dataset.path' is missing")
    values["dataset"] = as_plain(planned.dataset)
    settings = validated(RunSettings, values, f"{path}: {sequence} with {name}")
    return with_absolute_paths(settings, base)
