"""Frames whose pose is wrong although nothing says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.accuracy.silent_errors import (
    Estimate,
    TruthError,
    in_wrong_part,
    motion_metrics,
    silently_wrong,
)
from toolkit.base.geometry import se3

FRAMES = 12
TRUTH = {i: se3.exp([0.1 * i, 0.02 * i**2, 0.0, 0.0, 0.1 * i, 0.05]) for i in range(FRAMES)}
OTHER_WORLD = se3.exp([3.0, -1.0, 2.0, 0.5, -1.0, 0.7])


def estimate(off: dict[int, np.ndarray] | None = None, **values: object) -> Estimate:
    """The truth in another world, apart from some frames that are off in the camera's frame."""
    poses = {i: OTHER_WORLD @ T for i, T in TRUTH.items()}
    poses |= {i: poses[i] @ T for i, T in (off or {}).items()}
    part = dict.fromkeys(range(FRAMES), 0)
    return replace(Estimate(np.arange(FRAMES) / 30.0, poses, part), **values)


def shift(metres: float) -> np.ndarray:
    return se3.exp([metres, 0.0, 0.0, 0.0, 0.0, 0.0])


def turn(degrees: float) -> np.ndarray:
    return se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(degrees)])


def test_another_world_is_no_error():
    found = motion_metrics(estimate(), TRUTH)
    assert found["silently_wrong"] == 0
    assert found["ate_cm"] == pytest.approx(0.0, abs=1e-6)
    assert (found["frames"], found["frames_lost"], found["parts"]) == (FRAMES, 0, 1)


@pytest.mark.parametrize(("off", "wrong"), [
    (shift(0.049), []), (shift(0.051), [5, 6]), (turn(1.9), []), (turn(2.1), [5, 6]),
])  # fmt: skip
def test_a_single_wrong_pose_is_wrong_before_and_after(off, wrong):
    assert silently_wrong(estimate({5: off}), TRUTH) == wrong


def test_a_jump_that_stays_counts_once():
    straight = {i: shift(0.1 * i) for i in range(FRAMES)}
    poses = {i: T @ shift(0.5) if i >= 5 else T for i, T in straight.items()}
    assert silently_wrong(estimate(T_world_camera=poses), straight) == [5]


def test_the_error_of_the_truth_is_allowed():
    found = estimate({5: shift(0.06)})
    assert silently_wrong(found, TRUTH, TruthError(0.015, 0.5)) == []
    assert silently_wrong(found, TRUTH, TruthError(0.005, 0.5)) == [5, 6]


def test_questioned_frames_are_neither_wrong_nor_compared_with():
    off = {5: shift(0.5)}
    assert silently_wrong(estimate(off, doubtful=frozenset({5})), TRUTH) == []
    assert silently_wrong(estimate(off, lost=frozenset({5})), TRUTH) == []
    # An error that stays is found by the next frame that is not questioned.
    stays = {i: OTHER_WORLD @ T for i, T in TRUTH.items() if i < 5}
    stays |= {i: shift(0.5) @ OTHER_WORLD @ T for i, T in TRUTH.items() if i >= 5}
    found = estimate(T_world_camera=stays, doubtful=frozenset({5, 6}))
    assert silently_wrong(found, TRUTH) == [7]


def test_frames_of_different_parts_are_not_compared():
    moved = {i: (OTHER_WORLD if i < 6 else np.eye(4)) @ T for i, T in TRUTH.items()}
    assert silently_wrong(estimate(T_world_camera=moved), TRUTH) == [6]
    part = {i: int(i >= 6) for i in range(FRAMES)}
    assert silently_wrong(estimate(T_world_camera=moved, part=part), TRUTH) == []
    # Back in the first part, the camera is compared with where it left that part.
    part |= {10: 0, 11: 0}
    assert silently_wrong(estimate(T_world_camera=moved, part=part), TRUTH) == [10]


def test_the_ate_is_that_of_the_main_part():
    moved = {i: (OTHER_WORLD if i < 7 else np.eye(4)) @ T for i, T in TRUTH.items()}
    part = {i: int(i >= 7) for i in range(FRAMES)}
    assert motion_metrics(estimate(T_world_camera=moved), TRUTH)["ate_cm"] > 10.0
    found = motion_metrics(estimate(T_world_camera=moved, part=part), TRUTH)
    assert found["ate_cm"] == pytest.approx(0.0, abs=1e-6)
    assert found["parts"] == 2
    few = {i: TRUTH[i] for i in range(2)}
    assert motion_metrics(estimate(), few)["ate_cm"] is None


def test_scenes_of_one_part_are_not_compared_but_in_the_wrong_part():
    scenes = [0] * 8 + [1] * 4
    moved = {i: (OTHER_WORLD if i < 8 else np.eye(4)) @ T for i, T in TRUTH.items()}
    found = estimate(T_world_camera=moved)
    assert silently_wrong(found, TRUTH, scenes=scenes) == []
    assert in_wrong_part(found, scenes) == [8, 9, 10, 11]
    assert in_wrong_part(replace(found, doubtful=frozenset({9})), scenes) == [8, 10, 11]
    part = dict(enumerate(scenes))
    assert in_wrong_part(replace(found, part=part), scenes) == []
