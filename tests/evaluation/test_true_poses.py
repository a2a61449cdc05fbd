"""The clock and the unit of true poses."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.metrics import trajectory_metrics, truth_lines
from toolkit.runs.evaluation.true_poses import pose_delay, pose_scale

INTERVAL_S = 0.04


def walk(delay_s: float = 0.0, drift_m: float = 0.0, frames: int = 60) -> Trajectory:
    """A curved path whose poses are recorded late; the clock of the images is right."""
    times_s = INTERVAL_S * np.arange(frames)
    moved_s = times_s - delay_s
    positions = np.stack([np.sin(1.7 * moved_s), np.cos(2.3 * moved_s), 0.3 * moved_s**2], axis=1)
    positions += drift_m * np.linspace(0.0, 1.0, frames)[:, None] ** 2
    poses = [se3.from_rotation_translation(np.eye(3), position) for position in positions]
    return Trajectory(times_s, np.stack(poses))


@pytest.mark.parametrize("intervals", [1, 3, -2, 1.5])
def test_the_delay_and_the_error_without_it_are_found(intervals):
    delay_s = intervals * INTERVAL_S
    found = pose_delay(walk(drift_m=0.01), walk(delay_s), "se3")
    assert found.delay_s == pytest.approx(delay_s, abs=0.25 * INTERVAL_S)
    assert found.rmse_m < 0.01


def test_a_scale_is_estimated_with_the_delay():
    found = pose_delay(scaled(walk(), 0.3), walk(2 * INTERVAL_S), "sim3")
    assert found.delay_s == pytest.approx(2 * INTERVAL_S)


# The drift of a metre is like a delay of two frames in positions.
@pytest.mark.parametrize("drift_m", [0.0, 0.05, 1.0])
def test_drift_is_no_delay(drift_m):
    assert pose_delay(walk(drift_m=drift_m), walk(), "se3") is None


def test_few_poses_tell_nothing():
    assert pose_delay(walk(frames=20), walk(0.1, frames=20), "se3") is None


def test_it_is_a_line_with_both_errors():
    metrics = trajectory_metrics(walk(), walk(3 * INTERVAL_S))
    assert metrics["ate_rmse_cm"] > 5.0 > 1.0 > metrics["ate_rmse_without_delay_cm"]
    (line,) = truth_lines(metrics)
    assert "0.120 s late" in line and "--dataset.pose-delay 0.120" in line
    assert truth_lines(trajectory_metrics(walk(), walk())) == []


def scaled(trajectory, factor):
    poses = trajectory.T_world_camera.copy()
    poses[:, :3, 3] *= factor
    return Trajectory(trajectory.timestamps_s, poses)


@pytest.mark.parametrize("factor", [1.25, 0.9])
def test_another_unit_of_the_truth_is_a_line_with_both_errors(factor):
    estimate = walk(drift_m=0.01)
    found = pose_scale(estimate, scaled(walk(), factor))
    assert found.factor == pytest.approx(factor, rel=0.01) and found.rmse_m < 0.01
    (line,) = truth_lines(trajectory_metrics(estimate, scaled(walk(), factor)))
    assert f"multiplied by {found.factor:.3f}" in line


@pytest.mark.parametrize(("factor", "drift_m"), [(1.02, 0.0), (1.0, 0.3), (1.0, 2.0)])
def test_drift_and_calibration_are_no_unit(factor, drift_m):
    assert pose_scale(walk(drift_m=drift_m), scaled(walk(), factor)) is None


def test_poses_are_not_compared_with_themselves():
    metrics = trajectory_metrics(walk(), walk(), "none")
    assert metrics["ate_rmse_cm"] is None and metrics["ate_pairs"] is None
