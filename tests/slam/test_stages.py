"""The recorded stages of a frame, and the columns that sum their times."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
from slam_room import SlamRoom, another_place

from toolkit.base.options import validated
from toolkit.base.stages import COLUMNS, Stage
from toolkit.runs.building import build_slam
from toolkit.runs.settings import RunSettings

IN_COLUMNS = {stage for stages in COLUMNS.values() for stage in stages}


class Nesting:
    """A recorder that keeps which stages ran, and inside which others."""

    def __init__(self) -> None:
        self.open: list[str] = []
        self.outermost: set[str] = set()
        self.inside_column: set[tuple[str, str]] = set()

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        if not self.open:
            self.outermost.add(stage)
        if stage in IN_COLUMNS:
            self.inside_column |= {(stage, outer) for outer in self.open if outer in IN_COLUMNS}
        self.open.append(stage)
        yield
        self.open.pop()


@pytest.fixture(scope="module")
def recorded(room: SlamRoom) -> Nesting:
    """A run with a rolling shutter, labels and submaps, in which the camera is lost for a while."""
    recorder = Nesting()
    options = {
        "mapping": {"iterations": 2, "first_iterations": 4, "final_iterations": 1},
        "segmenter": {"kind": "geometric"},
        "submaps": {"allocation": {"rule": "motion", "max_keyframes": 3}},
        "loops": {"relocalisation": {"patience": 2}},
    }
    slam = build_slam(settings=validated(RunSettings, options), recorder=recorder)
    there = [replace(frame, readout_s=0.01) for frame in room.frames]
    elsewhere = [another_place(frame) for frame in there[:3]]
    shown = [*there[:8], *elsewhere, *there[7::-1]]
    for index, frame in enumerate(shown):
        slam.process_frame(replace(frame, index=index, timestamp_s=index / 30))
    return recorder


def test_each_stage_of_a_frame_is_in_one_column(recorded):
    # Depth priors are for sequences without depth, instances and the scene graph are off by
    # default, and no loop is found in so short a run.
    rare = {Stage.DEPTH_PRIOR, Stage.INSTANCES, Stage.SCENE_GRAPH}
    rare |= {Stage.LOOPS_WITHIN, Stage.LOOPS_BETWEEN}
    assert IN_COLUMNS - rare <= recorded.outermost <= IN_COLUMNS
    assert not recorded.inside_column
