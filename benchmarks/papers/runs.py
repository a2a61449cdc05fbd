"""The runs behind the papers' tables: plans of `semsplat run-many`, and their metrics."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from benchmarks.shared.indoor_labels import with_indoor_labels
from benchmarks.shared.programs import semsplat_command
from benchmarks.shared.recordings import source_of
from benchmarks.shared.repository import source_digest
from benchmarks.shared.runner import WORK
from benchmarks.shared.tables import Metrics
from toolkit.runs.evaluation.metrics import flattened, read_metrics

Values = dict[str, Any]

# Frames of each sequence in a quick check.
QUICK_FRAMES = 12


@dataclass(frozen=True)
class Effort:
    """How much of the plans is executed.

    Attributes:
        quick: only the first sequence of each group, with few frames.
        seeds: maximum number of seeds, of rooms too.
    """

    quick: bool = False
    seeds: int = 5


@dataclass(frozen=True)
class Place:
    """A sequence of a plan.

    Attributes:
        name: a key of RECORDINGS or of ROOMS.
        size: width and height of the images in pixels.
        frames: number of frames from the start; all if None.
        room_seed: seed of a synthetic room.
        options: settings of all runs on it.
        indoor: whether its labels are renamed to the classes of the indoor segmenter.
    """

    name: str
    size: tuple[int, int]
    frames: int | None = None
    room_seed: int = 0
    options: Values = field(default_factory=dict)
    indoor: bool = False

    def planned(self, quick: bool) -> Values:
        """The sequence as a plan describes it; a room is rendered if it does not exist yet."""
        kind, path, _ = source_of(self.name, self.room_seed)
        path = with_indoor_labels(path) if self.indoor else path
        dataset = {"kind": kind, "path": str(path)}
        options = {"image_size": list(self.size), **self.options}
        frames = QUICK_FRAMES if quick else self.frames
        if frames is not None:
            options["max_frames"] = frames
        return {"dataset": dataset, "options": options}


@dataclass(frozen=True)
class Group:
    """Runs of one plan: sequences x settings x seeds.

    Attributes:
        sequences: by name, which becomes a folder.
        settings: entries of a plan by name.
        seeds: number of seeds, 0, 1, ...
    """

    sequences: Mapping[str, Place]
    settings: Mapping[str, Values]
    seeds: int = 1

    def plan(self, effort: Effort) -> Values:
        """The content of the plan."""
        return {
            "sequences": {
                name: place.planned(effort.quick) for name, place in self.places(effort).items()
            },
            "settings": dict(self.settings),
            "seeds": list(range(min(self.seeds, effort.seeds))),
            "resources": {"threads": 1},
        }

    def places(self, effort: Effort) -> dict[str, Place]:
        """The sequences of the plan by name."""
        kept = [entry for entry in self.sequences.items() if entry[1].room_seed < effort.seeds]
        return dict(kept[: 1 if effort.quick else None])


class PaperRuns:
    """Runs of all groups, in a folder for this version of the code.

    Finished runs are kept, so that an interrupted call can be repeated.

    Args:
        groups: by name.
        effort: how much of them is executed.
    """

    def __init__(self, groups: Mapping[str, Group], effort: Effort) -> None:
        self._groups, self._effort = groups, effort
        self._folder = WORK / "tables" / f"{source_digest()[:12]}{'-quick' if effort.quick else ''}"

    def execute(self, names: Sequence[str], processes: int) -> None:
        """Execute the plans of some groups, several at a time.

        Args:
            processes: number of plans that are executed at the same time, one thread each.

        Raises:
            SystemExit: a group does not exist.
        """
        for name in names:
            if name not in self._groups:
                sys.exit(f"no group '{name}'; groups: {', '.join(self._groups)}")
        self._remove_older()
        plans = [self._write_plan(name) for name in names]
        with ThreadPoolExecutor(processes) as pool:
            for plan, status in zip(plans, pool.map(_run_many, plans), strict=True):
                print(f"{plan.stem}: {'finished' if status == 0 else 'some runs failed'}")

    def metrics(self, group: str, settings: str, sequence: str | None = None) -> list[Metrics]:
        """Metrics of the finished runs of a group by dotted key.

        Args:
            sequence: the sequences whose name begins so; all by default.
        """
        found = (self._folder / group).glob(f"{sequence or ''}*/{settings}/seed*/metrics.json")
        return [flattened(read_metrics(path)) for path in sorted(found)]

    def expected(self, group: str, sequence: str | None = None) -> int:
        """Number of runs with each of the settings of a group, whatever the effort."""
        plan = self._groups[group]
        places = plan.places(self._effort) if self._effort.quick else plan.sequences
        return plan.seeds * sum(name.startswith(sequence or "") for name in places)

    def _write_plan(self, name: str) -> Path:
        path = self._folder / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(self._groups[name].plan(self._effort), sort_keys=False))
        return path

    def _remove_older(self) -> None:
        """Remove the runs of other versions of the code, which take gigabytes."""
        for folder in self._folder.parent.glob("*"):
            same_kind = folder.is_dir() and folder.name.endswith("-quick") == self._effort.quick
            if same_kind and folder != self._folder:
                shutil.rmtree(folder)


def _run_many(plan: Path) -> int:
    """Execute a plan; the output is in a file beside it."""
    with plan.with_suffix(".log").open("a") as log:
        command = semsplat_command("run-many", str(plan))
        return subprocess.run(command, stdout=log, stderr=log, check=False).returncode
