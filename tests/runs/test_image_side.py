"""The side of a recording's images that is up: stated, measured or estimated."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from box_room import FLOOR, walk

from toolkit.base.errors import RunFolderError
from toolkit.base.frame import Frame
from toolkit.base.geometry.image_sides import turned_upright
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.exports.selection import _lowest_layer
from toolkit.runs import image_side
from toolkit.runs.building import build_run_labeller
from toolkit.runs.image_side import find_side, side_seen_afterwards, up_side
from toolkit.runs.maps.finished import load_run
from toolkit.runs.settings import RunSettings
from toolkit.semantics.segmenters.geometric.image_side import SideJudgement
from toolkit.tools.viewer.reading import vertical

AUTO = RunSettings()


@dataclass
class Recorded:
    """A recording in memory."""

    frames: list[Frame]
    up_world: tuple[float, float, float] | None = None
    poses: np.ndarray | None = None
    label_names: dict[int, str] | None = None
    name: str = "recorded"
    recording: SimpleNamespace = field(init=False)

    def __post_init__(self):
        truth = None if self.poses is None else Trajectory(np.arange(len(self.poses)), self.poses)
        self.recording = SimpleNamespace(up_world=self.up_world, ground_truth=truth)


@pytest.fixture(scope="module")
def sideways():
    return Recorded([view.frame for view in walk(8, 90.0)])


def stated(side):
    return replace(AUTO.dataset, up=side)


def test_frames_with_depth_show_the_side(sideways):
    found = find_side(sideways, sideways.frames, AUTO.dataset)
    assert found.side == "left" and found.findings == ()
    assert found.notes == ("the left side of the images is up",)


def test_a_run_labels_frames_by_the_side_that_was_found(sideways):
    settings = find_side(sideways, sideways.frames, AUTO.dataset).chosen(AUTO)
    assert up_side(settings.dataset) == "left"
    floor = walk(8, 90.0)[0].classes == FLOOR
    for chosen, most in ((settings, True), (AUTO, False)):
        labelled = build_run_labeller(chosen, sideways).label(sideways.frames[0])
        assert ((labelled.labels == 1)[floor].mean() > 0.9) == most


def test_without_depth_the_top_is_assumed(sideways):
    assert find_side(sideways, [], AUTO.dataset).side == "top"
    assert up_side(AUTO.dataset) == "top"


def test_the_option_decides(sideways):
    assert find_side(sideways, sideways.frames, stated("right")).side == "right"


def test_gravity_decides_where_the_device_measures_it():
    poses = np.array([view.T_world_camera for view in walk(8, -90.0)])
    measured = Recorded([], up_world=(0.0, 0.0, 1.0), poses=poses)
    assert find_side(measured, measured.frames, AUTO.dataset).side == "right"
    assert find_side(measured, [], AUTO.dataset).side == "right"


def test_doubt_is_one_line_unless_labels_show_the_floor(sideways, monkeypatch):
    monkeypatch.setattr(image_side, "judge_side", lambda _: SideJudgement("top", "left"))
    found = find_side(sideways, sideways.frames, AUTO.dataset)
    (line,) = found.findings
    assert found.side == "top"
    assert "the vertical is in doubt" in line and "--dataset.up left" in line
    labelled = replace(sideways, label_names={1: "floor"})
    assert find_side(labelled, labelled.frames, AUTO.dataset).findings == ()


def test_a_live_camera_on_its_side_is_noticed_afterwards(sideways, monkeypatch):
    monkeypatch.setattr(image_side, "spread_frames", lambda recorded: recorded.frames)
    found = side_seen_afterwards(sideways, AUTO.dataset)
    (line,) = found.findings
    assert found.side == "left"
    assert "classes were found as if the top were; start with --dataset.up left" in line
    assert side_seen_afterwards(sideways, stated("right")).findings == ()


def test_floor_and_vertical_of_an_unlabelled_map_follow_the_side():
    # Floor, ceiling and a wall at the side, on which more points lie than on the floor.
    rng = np.random.default_rng(0)
    floor = rng.uniform((-2, -2, 0.0), (2, 2, 0.01), (3000, 3))
    wall = rng.uniform((-2, -2, 0.0), (-1.99, 2, 2.5), (6000, 3))
    crate = rng.uniform((0.5, 0.5, 0.0), (1, 1, 0.6), (1000, 3))
    points = np.concatenate([floor, wall, crate])
    poses = np.array([view.T_world_camera for view in walk(8)])
    poses[:, :3, :3] = poses[:, :3, :3] @ turned_upright("left").T
    run = SimpleNamespace(
        tracked=list(poses), trajectory=Trajectory(np.arange(8.0), poses), up_side="left"
    )
    ground = _lowest_layer(points, run)
    assert ground.up @ [0.0, 0.0, 1.0] > 0.99
    assert ground.height_m == pytest.approx(0.0, abs=0.1)
    assert vertical(poses, "left") @ [0.0, 0.0, 1.0] > 0.9
    assert vertical(poses[:0], "left") == pytest.approx([-1.0, 0.0, 0.0])


def test_a_finished_run_keeps_the_side(tiny_run, tmp_path):
    assert load_run(tiny_run).up_side == "top"
    shutil.copytree(tiny_run, tmp_path / "run")
    frames = json.loads((tiny_run / "frames.json").read_text())
    assert frames["up"] == "top"
    (tmp_path / "run/frames.json").write_text(json.dumps(frames | {"up": "left"}))
    assert load_run(tmp_path / "run").up_side == "left"
    (tmp_path / "run/frames.json").write_text(json.dumps(frames | {"up": "aside"}))
    with pytest.raises(RunFolderError, match="aside is not a side of an image"):
        load_run(tmp_path / "run")
