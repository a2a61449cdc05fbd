"""Pose errors of accepted loop edges against the ground truth.

An edge is right if its relative pose is within 5 cm and 2 degrees of the true one, plus the ground
truth's own error. Whether two views overlap (`toolkit.runs.evaluation.loops`) says that a place was
recognised, and nothing about the pose that corrects the map.

Times of motion capture and of images often differ by a constant of 10 to 20 ms. In a turn of 180
degrees per second, 15 ms are 2.7 degrees, and twice that between turns in opposite directions. This
part of the ground truth's error is specified in seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.runs.evaluation.options import TruthErrorOptions

Array = NDArray[np.float64]

MAX_ERROR_M, MAX_ERROR_DEG = 0.05, 2.0


@dataclass(frozen=True)
class EdgeError:
    """Difference of an edge from the ground truth.

    Attributes:
        query, match: frame indices.
        metres, degrees: of the relative pose.
        allowed_m, allowed_deg: the largest errors of a right edge.
    """

    query: int
    match: int
    metres: float
    degrees: float
    allowed_m: float = MAX_ERROR_M
    allowed_deg: float = MAX_ERROR_DEG

    @property
    def right(self) -> bool:
        """Whether both errors are within what is allowed."""
        return self.metres <= self.allowed_m and self.degrees <= self.allowed_deg


def edge_errors(
    edges: Sequence[dict[str, Any]],
    T_world_camera: Array,
    timestamps_s: Array,
    own: TruthErrorOptions | None = None,
) -> list[EdgeError]:
    """Compare edges with the ground truth, where it is known for both frames.

    Args:
        edges: records of loops.jsonl with the measured relative pose (`T_match_query`).
        T_world_camera: [N, 4, 4] ground-truth poses by frame index; NaN where missing.
        timestamps_s: [N] times of the frames.
        own: error of the ground truth itself; none by default.
    """
    own = own or TruthErrorOptions()
    errors = []
    for edge in edges:
        query, match = int(edge["query"]), int(edge["match"])
        T_true = se3.inverse(T_world_camera[match]) @ T_world_camera[query]
        if not np.isfinite(T_true).all():
            continue
        error = se3.inverse(T_true) @ np.reshape(edge["T_match_query"], (4, 4))
        speed_m_s, speed_rad_s = _relative_speed(T_world_camera, timestamps_s, (match, query))
        errors.append(
            EdgeError(
                query,
                match,
                float(np.linalg.norm(error[:3, 3])),
                float(np.degrees(se3.rotation_angle_rad(error[:3, :3]))),
                MAX_ERROR_M + own.truth_error_m + own.truth_error_s * speed_m_s,
                MAX_ERROR_DEG
                + own.truth_error_deg
                + float(np.degrees(own.truth_error_s * speed_rad_s)),
            )
        )
    return errors


def edge_metrics(errors: Sequence[EdgeError], own: TruthErrorOptions | None = None) -> Metrics:
    """Number of edges and of right ones, and the errors; None without edges.

    Args:
        own: error of the ground truth itself, for the convention.
    """
    own = own or TruthErrorOptions()
    right = sum(error.right for error in errors)
    cm = [100.0 * error.metres for error in errors]
    deg = [error.degrees for error in errors]
    return {
        "count": len(errors),
        "right": right,
        "right_percent": 100.0 * right / len(errors) if errors else None,
        "error_median_cm": float(np.median(cm)) if errors else None,
        "error_max_cm": max(cm, default=None),
        "error_median_deg": float(np.median(deg)) if errors else None,
        "error_max_deg": max(deg, default=None),
        "convention": (
            "accepted edges between two frames with ground truth; right within "
            f"{100 * MAX_ERROR_M:g} cm and {MAX_ERROR_DEG:g} degrees, plus the ground truth's own "
            f"error: {100 * own.truth_error_m:g} cm, {own.truth_error_deg:g} degrees, and the "
            f"relative motion in {1e3 * own.truth_error_s:g} ms"
        ),
    }


def _relative_speed(T: Array, timestamps_s: Array, frames: tuple[int, int]) -> tuple[float, float]:
    """Change of the true relative pose of two frames if both times are shifted alike.

    Returns:
        m/s and rad/s; 0 where no neighbour has a pose.
    """
    first, second = (_velocity(T, timestamps_s, frame) for frame in frames)
    T_second_first = se3.inverse(T[frames[1]]) @ T[frames[0]]
    # The first camera's velocity, seen from the second.
    difference = second - se3.adjoint(T_second_first) @ first
    return float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))


def _velocity(T: Array, timestamps_s: Array, frame: int) -> Array:
    """Velocity [6] (m/s, rad/s) of a frame in its own coordinates, from its neighbours."""
    around = range(max(frame - 1, 0), min(frame + 2, len(T)))
    known = [k for k in around if np.isfinite(T[k]).all()]
    elapsed_s = timestamps_s[known[-1]] - timestamps_s[known[0]]
    if elapsed_s <= 0.0:
        return np.zeros(6)
    return np.asarray(se3.log(se3.inverse(T[known[0]]) @ T[known[-1]]) / elapsed_s)
