"""Errors of an estimated camera motion whose unit of length is unknown."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.shared.tables import Metrics
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error, align, associate

# Fewer poses determine no alignment.
_MIN_POSES = 4


def motion_errors(estimate: Trajectory, truth: Trajectory) -> Metrics:
    """Errors of positions and rotations; nothing for fewer than four poses.

    Returns:
        `ate_rmse_cm` after Sim(3) alignment, `still_cm` of a camera that never moves, and
        `rotation_rms_deg`, see `rotation_rms_deg`.
    """
    if len(estimate) < _MIN_POSES:
        return {}
    found = absolute_trajectory_error(estimate, truth, "sim3")
    return {
        "ate_rmse_cm": 100.0 * found.rmse_m,
        "still_cm": 100.0 * still_m(associate(estimate, truth)[1]),
        "rotation_rms_deg": rotation_rms_deg(estimate, truth),
    }


def still_m(truth: Trajectory) -> float:
    """RMS distance from the mean position in metres: the error of a camera that never moves."""
    centres = truth.positions_m
    return float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))


def path_m(truth: Trajectory) -> float:
    """Length of the path in metres."""
    return float(np.linalg.norm(np.diff(truth.positions_m, axis=0), axis=1).sum())


def rotation_rms_deg(estimate: Trajectory, truth: Trajectory) -> float:
    """RMS angle between orientations in degrees, after the rotation that fits all of them best.

    Positions have no influence: those of a camera that only turns determine no alignment.
    """
    estimate, truth = associate(estimate, truth)
    R_found, R_true = estimate.T_world_camera[:, :3, :3], truth.T_world_camera[:, :3, :3]
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", R_true, R_found))
    R_world_map = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    angles = se3.rotation_angle_rad(np.swapaxes(R_true, 1, 2) @ R_world_map @ R_found)
    return float(np.degrees(np.sqrt(np.mean(np.square(angles)))))


def scale_drift_percent(estimate: Trajectory, truth: Trajectory) -> float | None:
    """Change of the scale from the first quarter of the frames to the last one in percent.

    Returns:
        The change; None where a quarter has too few poses.
    """
    estimate, truth = associate(estimate, truth)
    quarter = len(estimate) // 4
    if quarter < _MIN_POSES:
        return None
    found, true = estimate.positions_m, truth.positions_m
    first = _scale(found[:quarter], true[:quarter])
    last = _scale(found[-quarter:], true[-quarter:])
    return 100.0 * abs(last / first - 1.0)


def _scale(found: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    return align(found, true, with_scale=True).scale
