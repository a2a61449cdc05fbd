"""ATE and RPE: by properties, against evo, and against published values."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.base.errors import DatasetError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.trajectory import (
    absolute_trajectory_error,
    align,
    associate,
    relative_pose_error,
)


def wandering_path(seed: int, poses: int = 40) -> Trajectory:
    generator = np.random.default_rng(seed)
    T = [np.eye(4)]
    for tangent in generator.normal(scale=0.05, size=(poses - 1, 6)):
        T.append(T[-1] @ se3.exp(tangent))
    return Trajectory(np.arange(poses) / 30.0, np.stack(T))


def disturbed(path: Trajectory, seed: int, sigma: float = 0.01) -> Trajectory:
    generator = np.random.default_rng(seed)
    noise = generator.normal(scale=sigma, size=(len(path), 6))
    T = np.stack([p @ se3.exp(n) for p, n in zip(path.T_world_camera, noise, strict=True)])
    return Trajectory(path.timestamps_s, T)


def read_tum(path: Path) -> Trajectory:
    rows = np.loadtxt(path)
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    T = np.stack(
        [
            se3.from_rotation_translation(se3.rotation_from_quaternion_xyzw(row[4:8]), row[1:4])
            for row in rows
        ]
    )
    return Trajectory(rows[:, 0], T)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.2, 5.0))
def test_alignment_undoes_any_similarity(seed: int, scale: float) -> None:
    truth = wandering_path(seed)
    T_map_world = se3.exp(np.random.default_rng(seed + 1).normal(size=6))
    moved = truth.transformed(T_map_world)
    poses = moved.T_world_camera.copy()
    poses[:, :3, 3] *= scale
    error = absolute_trajectory_error(Trajectory(truth.timestamps_s, poses), truth, "sim3")
    assert error.max_m < 1e-9
    assert error.alignment.scale == pytest.approx(1.0 / scale)


def test_rigid_alignment_does_not_hide_a_wrong_scale() -> None:
    truth = wandering_path(3)
    poses = truth.T_world_camera.copy()
    poses[:, :3, 3] *= 1.1
    estimate = Trajectory(truth.timestamps_s, poses)
    assert absolute_trajectory_error(estimate, truth, "se3").rmse_m > 1e-3
    assert absolute_trajectory_error(estimate, truth, "sim3").rmse_m < 1e-9


def test_alignment_is_a_rotation_even_for_a_mirrored_cloud() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    alignment = align(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(alignment.T_world_map[:3, :3]) == pytest.approx(1.0)


def test_a_camera_that_stood_still_has_an_error_not_a_crash() -> None:
    truth = wandering_path(5)
    still = Trajectory(truth.timestamps_s, np.tile(np.eye(4), (len(truth), 1, 1)))
    spread = truth.positions_m - truth.positions_m.mean(axis=0)
    expected = np.sqrt((spread**2).sum(axis=1).mean())
    assert absolute_trajectory_error(still, truth, "sim3").rmse_m == pytest.approx(expected)


@pytest.mark.parametrize("kind", ["none", "se3", "sim3"])
def test_ate_agrees_with_evo(kind: str) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    truth = wandering_path(11)
    estimate = disturbed(truth, 12).transformed(se3.exp(np.array([1.0, 2, 3, 0.3, 0.2, 0.1])))
    ours = absolute_trajectory_error(estimate, truth, kind)
    evo_truth, evo_estimate = as_evo(truth), as_evo(estimate)
    if kind != "none":
        evo_estimate.align(evo_truth, correct_scale=kind == "sim3")
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((evo_truth, evo_estimate))
    theirs = ape.get_all_statistics()
    assert ours.rmse_m == pytest.approx(theirs["rmse"], rel=1e-9)
    assert ours.mean_m == pytest.approx(theirs["mean"], rel=1e-9)
    assert ours.median_m == pytest.approx(theirs["median"], rel=1e-9)
    assert ours.max_m == pytest.approx(theirs["max"], rel=1e-9)


def test_rpe_agrees_with_evo() -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    truth = wandering_path(21)
    estimate = disturbed(truth, 22)
    ours = relative_pose_error(estimate, truth)
    assert ours is not None
    for relation, value in (
        (metrics.PoseRelation.translation_part, ours.translation_rmse_m),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation_rmse_deg),
    ):
        rpe = metrics.RPE(relation, 1, metrics.Unit.frames, all_pairs=True)
        rpe.process_data((as_evo(truth), as_evo(estimate)))
        assert value == pytest.approx(rpe.get_all_statistics()["rmse"], rel=1e-9)


def as_evo(path: Trajectory):
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(poses_se3=list(path.T_world_camera), timestamps=path.timestamps_s)


@pytest.mark.parametrize(
    ("truth_name", "estimate_name", "kind", "rmse_m"),
    [
        ("freiburg1_xyz-groundtruth", "freiburg1_xyz-rgbdslam", "se3", 0.01347),
        ("freiburg1_xyz-groundtruth", "freiburg1_xyz-rgbdslam", "sim3", 0.01339),
        ("fr2_desk_groundtruth", "fr2_desk_ORB", "se3", 0.00812),
        ("fr2_desk_groundtruth", "fr2_desk_ORB", "sim3", 0.00612),
    ],
)
def test_ate_of_published_estimates(
    truth_name: str, estimate_name: str, kind: str, rmse_m: float
) -> None:
    root = os.environ.get("SEMSPLAT_DATA")
    if not root:
        pytest.skip("SEMSPLAT_DATA is not set: the published trajectories are not at hand")
    folder = Path(root) / "trajectories"
    estimate, truth = (
        read_tum(folder / f"{estimate_name}.txt"),
        read_tum(folder / f"{truth_name}.txt"),
    )
    error = absolute_trajectory_error(estimate, truth, kind)
    assert error.rmse_m == pytest.approx(rmse_m, abs=6e-6)


def test_association_keeps_only_poses_near_in_time() -> None:
    truth = wandering_path(31)
    late = Trajectory(truth.timestamps_s[:10] + 0.004, truth.T_world_camera[:10])
    estimate, paired_truth = associate(late, truth, max_difference_s=0.005)
    assert len(estimate) == len(paired_truth) == 10
    np.testing.assert_array_equal(paired_truth.T_world_camera, truth.T_world_camera[:10])
    with pytest.raises(DatasetError, match="same clock"):
        associate(late, truth, max_difference_s=0.001)


def test_relative_error_of_a_single_pose_is_not_available() -> None:
    path = wandering_path(41, poses=1)
    assert relative_pose_error(path, path) is None
