"""What exists already of a planned run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from toolkit.io.guarded.documents import read_json
from toolkit.runs.batch.plan import PlannedRun
from toolkit.runs.folder import RunFolder
from toolkit.runs.lock import LOCK
from toolkit.runs.maps.locations import with_absolute_paths
from toolkit.runs.settings import dump_settings

State = Literal["new", "unfinished", "finished", "conflict"]

# Files and folders of a run that was killed before it wrote its settings.
_BEGUN = frozenset(("renders", "checkpoint", "loops.jsonl", LOCK))


@dataclass(frozen=True)
class RunState:
    """What exists of a run.

    Attributes:
        state: "conflict" if its folder contains something else.
        text: one line about it.
    """

    state: State
    text: str


def run_state(run: PlannedRun) -> RunState:
    """Examine the folder of a run."""
    folder = run.folder
    config = folder / "config.yaml"
    if not folder.exists():
        return RunState("new", "new")
    if not config.is_file():
        if folder.is_dir() and {p.name for p in folder.iterdir()} <= _BEGUN:
            return RunState("new", "new")
        return RunState("conflict", f"{folder} is not a run folder; move it away")
    if not _same_settings(run, config):
        return RunState(
            "conflict",
            f"{folder} is a run with other settings; move it away or choose another 'out'",
        )
    if RunFolder(folder).is_finished:
        return RunState("finished", "finished")
    frame = checkpoint_frame(folder)
    return RunState("unfinished", "unfinished" if frame is None else f"unfinished, frame {frame}")


def checkpoint_frame(folder: Path) -> int | None:
    """Return the frame at which a run would be resumed, None without a readable checkpoint."""
    frames = []
    for path in (folder / "checkpoint").glob("[01]/metadata.json"):
        try:
            frames.append(int(read_json(path)["next_frame"]))
        except (OSError, ValueError, KeyError, TypeError):
            continue  # being replaced, or damaged
    return max(frames, default=None)


def planned_config(run: PlannedRun) -> str:
    """Return the text that the run writes to its config.yaml."""
    return dump_settings(with_absolute_paths(run.settings))


def _same_settings(run: PlannedRun, config: Path) -> bool:
    try:
        return config.read_text(encoding="utf-8") == planned_config(run)
    except (OSError, UnicodeDecodeError):
        return False
