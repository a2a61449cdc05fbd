"""The comparison of reported covariances with true errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.accuracy.uncertainty import Compared, TruthError, compare
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory

SIGMA = np.array([0.02, 0.01, 0.03, 0.01, 0.02, 0.005])


@dataclass
class Result:
    trajectory: Trajectory
    covariances: np.ndarray


def walk(count: int) -> Trajectory:
    step = se3.exp(np.array([0.01, 0.0, 0.005, 0.0, 0.02, 0.0]))
    T = np.array([np.linalg.matrix_power(step, k) for k in range(count)])
    return Trajectory(np.arange(count) / 30.0, T)


def noisy(truth: Trajectory, scale: float = 1.0) -> Result:
    """Poses whose errors follow their covariances, those reported divided by a squared scale."""
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(len(truth), 6)) * SIGMA
    errors[0] = 0.0
    T = np.array(
        [T @ se3.inverse(se3.exp(x)) for T, x in zip(truth.T_world_camera, errors, strict=True)]
    )
    covariances = np.tile(np.diag((SIGMA / scale) ** 2), (len(truth), 1, 1))
    return Result(Trajectory(truth.timestamps_s, T), covariances)


@pytest.mark.parametrize(("scale", "ratio"), [(1.0, 1.0), (2.0, 2.0), (0.5, 0.5)])
def test_a_correct_model_has_a_ratio_of_one(scale, ratio):
    truth = walk(400)
    found = compare(noisy(truth, scale), truth, TruthError())
    assert found.ratio() == pytest.approx(ratio, rel=0.08)
    assert found.ratio(slice(0, 3)) == pytest.approx(ratio, rel=0.12)
    expected = {1.0: (0.92, 0.98), 2.0: (0.15, 0.28), 0.5: (1.0, 1.0)}[scale]
    assert expected[0] <= found.inside.mean() <= expected[1]


def test_the_error_of_the_truth_counts_in_both_frames():
    truth = walk(50)
    found = compare(noisy(truth), truth, TruthError(metres=0.03))
    # The same rotation: no lever arm.
    assert found.truth[0][0, 0] == pytest.approx(2 * 0.03**2 / 3, rel=1e-3)
    assert found.truth[0][3, 3] < 1e-10


def test_a_constant_delay_cancels_on_a_constant_turn_only():
    truth = walk(60)
    same = compare(noisy(truth), truth, TruthError(seconds=0.01)).truth
    assert same[20][4, 4] < 1e-10
    back = np.concatenate([truth.T_world_camera, truth.T_world_camera[-2::-1]])
    returning = Trajectory(np.arange(len(back)) / 30.0, back)
    found = compare(noisy(returning), returning, TruthError(seconds=0.01)).truth
    # 0.02 rad a frame in either direction.
    assert found[90][4, 4] == pytest.approx((2 * 0.02 * 30 * 0.01) ** 2, rel=1e-3)


def test_truth_of_left_out_frames_is_used_for_velocities_only():
    truth = walk(61)
    every = noisy(truth)
    kept = slice(None, None, 4)
    strided = Result(
        Trajectory(truth.timestamps_s[kept], every.trajectory.T_world_camera[kept]),
        every.covariances[kept],
    )
    assert len(compare(strided, truth, TruthError()).errors) == 15


def test_a_part_of_the_components():
    one = Compared(np.ones((1, 6)), np.eye(6)[None], np.zeros((1, 6, 6)))
    assert one.squared_distances()[0] == pytest.approx(6.0)
    assert one.squared_distances(slice(3, 6))[0] == pytest.approx(3.0)
