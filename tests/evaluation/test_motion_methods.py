"""The benchmark of motion: rows, targets, and the methods beside semsplat."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.accuracy import motion
from benchmarks.accuracy.motion_cases import CASES, CaseDataset
from benchmarks.accuracy.motion_methods import (
    OpenCvOdometry,
    frame_to_frame,
    largest_first,
    semsplat,
)
from benchmarks.accuracy.silent_errors import motion_metrics
from benchmarks.shared import recordings
from toolkit.base.geometry import se3
from toolkit.datasets.registry import describe
from toolkit.datasets.synthetic_rooms import tiny_room


def test_rows_name_sequences_and_cases_that_exist():
    jobs = motion.all_jobs()
    for sequence in motion.SEQUENCES.values():
        assert sequence.name in {*recordings.RECORDINGS, *recordings.ROOMS}
        assert set(sequence.all_cases) <= set(CASES)
    assert set(motion.SUBSET) <= set(jobs)
    assert {job[0] for job in jobs.values()} == {"bad input", "semsplat", *motion.LABELS}


def chosen(**values):
    return motion.chosen(motion.Options(**values), motion.all_jobs())


def test_options_restrict_the_rows():
    assert chosen() == ()
    names = chosen(only=("RedKitchen, stride 8",))
    assert names == (
        "RedKitchen, stride 8",
        *(f"RedKitchen, stride 8: {label}" for label in motion.LABELS.values()),
    )
    assert chosen(only=names[:1], methods=("opencv",)) == ("RedKitchen, stride 8: OpenCV",)
    assert {name.split(", ")[0] for name in chosen(only=("fr1/rpy",))} == {"fr1/rpy"}
    assert set(chosen(subset=True)) == set(motion.SUBSET)
    with pytest.raises(SystemExit, match="--only: no 'fr1/rpy, stride 3'"):
        chosen(only=("fr1/rpy, stride 3",))


def row(ate_cm, lost=0, wrong=0, frames=50):
    return [
        {"ate_cm": ate_cm, "frames": frames, "frames_lost": lost, "silently_wrong": wrong},
    ]  # fmt: skip


def test_targets_compare_with_rivals_that_keep_tracking():
    rows = {
        "office0, stride 1": row(0.5),
        "office0, stride 1: Open3D": row(0.4, lost=1),
        "office0, stride 1: OpenCV": row(0.6),
        "room, stride 1": row(0.5, wrong=2),
        "room, stride 1: Open3D": row(0.4),
        "room, stride 1: ORB-SLAM3": [{"outcome": "not installed"}],
        "fr1/rpy, stride 1": row(None),
        "fr1/rpy, stride 1: OpenCV": row(9.0),
        "fr1/rpy, stride 16": row(1.0, wrong=1, frames=80),
        "office0, stride 24": row(1.0, wrong=1, frames=20),
    }
    found = {target.label: target.value for target in motion.targets(rows)}
    # On the room, Open3D is better; on fr1/rpy, semsplat has no trajectory.
    label = "stride {}, sequences where a rival that keeps tracking has a lower ATE"
    assert found[label.format(1)] == 2
    assert found[label.format(2)] is None
    assert found["silently wrong at strides 1 to 8"] == 2
    assert found["silently wrong at strides 16 and 24, in % of all frames"] == 2.0
    assert found["bad inputs, silently wrong"] is None


def test_the_table_beside_rivals_states_why_one_has_no_figures():
    rows = {
        "room, stride 1": row(0.5),
        "room, stride 1: Open3D": row(0.4),
        "room, stride 1: ORB-SLAM3": [{"outcome": "not installed"}],
        "room, half speed": row(0.5),
    }
    table = motion.rivals_table(rows)
    assert [cells[0] for cells in table.rows] == ["room, stride 1"]
    assert table.cell("room, stride 1", "Open3D: ate_cm") == "0.4"
    assert table.cell("room, stride 1", "OpenCV: ate_cm") == "n/a"
    assert table.cell("room, stride 1", "ORB-SLAM3: ate_cm") == "not installed"
    assert table.cell("room, stride 1", "semsplat: silently_wrong") == "0"


def test_opencv_finds_the_motion_from_the_camera_to_the_frame_before():
    frames, truth = tiny_room(4, 160, 120)
    method = OpenCvOdometry(frames[0].camera.matrix)
    found = [method.process(frame).copy() for frame in frames]
    true = se3.inverse(truth.T_world_camera[0]) @ truth.T_world_camera[3]
    off = se3.inverse(true) @ found[3]
    assert np.linalg.norm(off[:3, 3]) < 0.2 * np.linalg.norm(true[:3, 3])
    assert method.failures == 0
    black = replace(
        frames[0], rgb=np.zeros_like(frames[0].rgb), depth_m=np.zeros_like(frames[0].depth_m)
    )
    np.testing.assert_array_equal(method.process(black), found[3])
    assert method.failures == 1


class FailsOnThird:
    """A method that fails on the third frame, and finds that the camera stands still."""

    failures = 0

    def process(self, frame):
        self.failures += frame.index == 2
        return np.eye(4)


def test_a_failure_starts_another_part(tiny_recording: Path):
    dataset = CaseDataset(describe("folder", tiny_recording), None, "stride 1")
    estimate = frame_to_frame(dataset, FailsOnThird())
    assert estimate.lost == {2}
    assert dict(estimate.part) == {0: 1, 1: 1, 3: 0, 4: 0, 5: 0}
    assert largest_first({0: 7, 1: 3, 2: 3}) == {0: 1, 1: 0, 2: 0}


def test_semsplat_is_measured_on_a_case(tiny_recording: Path):
    dataset = CaseDataset(describe("folder", tiny_recording), None, "stride 2")
    found = motion_metrics(semsplat(dataset, 0, motion.SETTINGS), dataset.truth)
    assert (found["frames"], found["frames_lost"], found["silently_wrong"]) == (3, 0, 0)
    assert found["ate_cm"] < 2.0
    assert found["keyframes"] >= 1
