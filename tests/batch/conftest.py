"""Two tiny recordings, and a plan over them that has been executed."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest
from programs import semsplat
from tiny_plans import write_plan

from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence


@pytest.fixture(scope="session")
def rooms(tmp_path_factory) -> Path:
    """A folder with the recordings `a` and `b`: both ways through one room."""
    folder = tmp_path_factory.mktemp("rooms")
    frames, truth = tiny_room(8, 64, 48)
    for name, step in (("a", 1), ("b", -1)):
        prepare_folder(folder / name)
        camera = frames[0].camera
        write_sequence(folder / name, frames, camera, truth.T_world_camera[::step])
    return folder


@dataclass(frozen=True)
class ExecutedPlan:
    """A plan over `a`, `missing` (which does not exist) and `b`, executed one after the other.

    Attributes:
        plan: its file. out: folder of the runs. done: the process.
    """

    plan: Path
    out: Path
    done: subprocess.CompletedProcess[str]


@pytest.fixture(scope="session")
def night(rooms, tmp_path_factory) -> ExecutedPlan:
    folder = tmp_path_factory.mktemp("plans")
    plan = write_plan(folder / "night.yaml", rooms, "a", "missing", "b")
    return ExecutedPlan(plan, folder / "night", semsplat("run-many", plan))
