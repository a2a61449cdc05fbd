"""Errors of a camera motion whose unit of length is unknown."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.monocular.motion_errors import (
    motion_errors,
    path_m,
    rotation_rms_deg,
    scale_drift_percent,
)
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory


def curve(frames: int = 40) -> Trajectory:
    t = np.linspace(0.0, 6.0, frames)
    T = np.array([se3.exp([np.sin(s), np.cos(2 * s), 0.3 * s, 0.2 * s, 0.1, -0.3 * s]) for s in t])
    return Trajectory(t, T)


def seen_from(truth: Trajectory, T: np.ndarray, scale: np.ndarray | float) -> Trajectory:
    """The same motion in other coordinates and another unit."""
    T_map_camera = T @ truth.T_world_camera
    T_map_camera[:, :3, 3] *= np.broadcast_to(scale, len(truth))[:, None]
    return Trajectory(truth.timestamps_s, T_map_camera)


OTHER = se3.exp([3.0, -1.0, 2.0, 0.5, -1.0, 0.7])


def test_other_coordinates_and_units_are_no_error():
    truth = curve()
    errors = motion_errors(seen_from(truth, OTHER, 0.3), truth)
    assert errors["ate_rmse_cm"] < 1e-6
    assert errors["rotation_rms_deg"] < 1e-5
    assert errors["still_cm"] > 10.0


def test_rotation_error_is_the_angle_in_the_camera():
    truth = curve()
    turned = truth.T_world_camera.copy()
    angles = np.radians(4.0) * np.resize([1.0, -1.0], len(truth))
    turned[:, :3, :3] = turned[:, :3, :3] @ Rotation.from_euler("z", angles[:, None]).as_matrix()
    found = seen_from(Trajectory(truth.timestamps_s, turned), OTHER, 1.0)
    assert rotation_rms_deg(found, truth) == pytest.approx(4.0, rel=0.01)


def test_scale_drift_compares_the_last_quarter_with_the_first():
    truth = curve()
    scale = np.where(np.arange(len(truth)) < 20, 2.0, 2.5)
    found = seen_from(truth, np.eye(4), scale)
    # Estimates enlarged by 2.5 need a scale of 0.4 where those enlarged by 2 need 0.5.
    assert scale_drift_percent(found, truth) == pytest.approx(20.0)
    few = Trajectory(truth.timestamps_s[:8], truth.T_world_camera[:8])
    assert scale_drift_percent(few, truth) is None


def test_too_few_poses_have_no_errors():
    truth = curve()
    few = Trajectory(truth.timestamps_s[:3], truth.T_world_camera[:3])
    assert motion_errors(few, truth) == {}
    assert path_m(few) < path_m(truth)
