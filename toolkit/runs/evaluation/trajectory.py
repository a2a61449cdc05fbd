"""Trajectory errors: absolute trajectory error (ATE) and relative pose error (RPE).

Both papers and the TUM benchmark (Sturm et al. 2012) report the root mean square of the distances
between camera centres after a least-squares alignment: rigid (SE(3)) for sensors with metric
depth, with scale (Sim(3)) for monocular cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory

Array = NDArray[np.float64]
AlignmentKind = Literal["none", "se3", "sim3"]

# The default of evo. The value affects results: with 0.02 s, the default of the TUM script, the
# ATE of fr2/desk is 1 % larger. It is therefore reported with the metrics.
MAX_TIME_DIFFERENCE_S = 0.01


@dataclass(frozen=True)
class TrajectoryAlignment:
    """Transformation that aligns an estimated trajectory with the ground truth.

    A point is transformed as `p_world = scale * R @ p_map + t`.

    Attributes:
        T_world_map: [4, 4] rigid part, from the estimate's frame to the ground truth's frame.
        scale: scale of the estimate, 1 unless the alignment is Sim(3).
    """

    T_world_map: Array
    scale: float = 1.0

    def applied_to(self, estimate: Trajectory) -> Trajectory:
        """Transform the estimate to the frame and scale of the ground truth."""
        scaled = estimate.T_world_camera.copy()
        scaled[:, :3, 3] *= self.scale
        return Trajectory(estimate.timestamps_s, self.T_world_map @ scaled)


@dataclass(frozen=True)
class AbsoluteTrajectoryError:
    """Distances between true and aligned estimated camera centres.

    Attributes:
        rmse_m, mean_m, median_m, max_m: statistics over all pairs, in metres.
        kind: kind of the alignment, "none", "se3" or "sim3".
        alignment: the transformation.
        pairs: number of compared poses.
        timestamps_s: [pairs] timestamps of the estimate.
        errors_m: [pairs] distances in metres.
    """

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    kind: AlignmentKind
    alignment: TrajectoryAlignment
    pairs: int
    timestamps_s: Array
    errors_m: Array


@dataclass(frozen=True)
class RelativePoseError:
    """Drift between neighbouring poses; independent of the alignment.

    Attributes:
        translation_rmse_m: metres per step.
        rotation_rmse_deg: degrees per step.
    """

    translation_rmse_m: float
    rotation_rmse_deg: float


def associate(
    estimate: Trajectory,
    truth: Trajectory,
    max_difference_s: float = MAX_TIME_DIFFERENCE_S,
) -> tuple[Trajectory, Trajectory]:
    """Associate each estimated pose with the ground truth at its timestamp.

    Returns:
        Two trajectories of equal length.

    Raises:
        DatasetError: no estimated pose has a ground-truth pose within the time difference.
    """
    near_truth = truth.associated_to(estimate.timestamps_s, max_difference_s)
    if len(near_truth) == 0:
        raise DatasetError(
            f"no estimated pose ({estimate}) is within {max_difference_s:g} s of a ground-truth "
            f"pose ({truth}); both need the same clock, or increase the maximum time difference"
        )
    kept = np.isin(estimate.timestamps_s, near_truth.timestamps_s)
    return Trajectory(estimate.timestamps_s[kept], estimate.T_world_camera[kept]), near_truth


def align(points_map: Array, points_world: Array, with_scale: bool = False) -> TrajectoryAlignment:
    """Compute the least-squares transformation between point sets (Umeyama 1991).

    Args:
        points_map: [N, 3] points to transform, N >= 1.
        points_world: [N, 3] corresponding target points.
        with_scale: estimate a scale as well (Sim(3)); it is 1 if all points coincide.

    Raises:
        ValueError: shapes differ or there are no points.
    """
    if points_map.shape != points_world.shape or points_map.ndim != 2 or len(points_map) == 0:
        raise ValueError(
            f"points must both have shape [N, 3] with N >= 1, got {list(points_map.shape)} "
            f"and {list(points_world.shape)}"
        )
    mean_map, mean_world = points_map.mean(axis=0), points_world.mean(axis=0)
    centred_map, centred_world = points_map - mean_map, points_world - mean_world
    U, singular, Vt = np.linalg.svd(centred_world.T @ centred_map / len(points_map))
    # A reflection may fit best if the points are nearly coplanar; flip the weakest axis then.
    signs = np.array([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)])
    R = U @ np.diag(signs) @ Vt
    variance = float((centred_map**2).sum() / len(points_map))
    estimate_scale = with_scale and variance > 0.0
    scale = float((singular * signs).sum() / variance) if estimate_scale else 1.0
    translation = mean_world - scale * R @ mean_map
    return TrajectoryAlignment(se3.from_rotation_translation(R, translation), scale)


def absolute_trajectory_error(
    estimate: Trajectory,
    truth: Trajectory,
    kind: AlignmentKind = "se3",
) -> AbsoluteTrajectoryError:
    """Compute the ATE of an estimate over the poses that are associated in time.

    Raises:
        DatasetError: no poses can be associated.
    """
    estimate, truth = associate(estimate, truth)
    if kind == "none":
        alignment = TrajectoryAlignment(np.eye(4))
    else:
        alignment = align(estimate.positions_m, truth.positions_m, with_scale=kind == "sim3")
    aligned = alignment.applied_to(estimate)
    errors_m = np.linalg.norm(aligned.positions_m - truth.positions_m, axis=1)
    return AbsoluteTrajectoryError(
        rmse_m=_root_mean_square(errors_m),
        mean_m=float(errors_m.mean()),
        median_m=float(np.median(errors_m)),
        max_m=float(errors_m.max()),
        kind=kind,
        alignment=alignment,
        pairs=len(errors_m),
        timestamps_s=estimate.timestamps_s,
        errors_m=errors_m,
    )


def relative_pose_error(estimate: Trajectory, truth: Trajectory) -> RelativePoseError | None:
    """Compute the RPE over all steps between neighbouring associated poses.

    Returns:
        The error; None without two associated poses.

    Raises:
        DatasetError: no poses can be associated.
    """
    estimate, truth = associate(estimate, truth)
    if len(estimate) < 2:
        return None
    difference = se3.inverse(_steps(truth.T_world_camera)) @ _steps(estimate.T_world_camera)
    translation_m = np.linalg.norm(difference[:, :3, 3], axis=1)
    rotation_deg = np.degrees(se3.rotation_angle_rad(difference[:, :3, :3]))
    return RelativePoseError(
        translation_rmse_m=_root_mean_square(translation_m),
        rotation_rmse_deg=_root_mean_square(rotation_deg),
    )


def _steps(T_world_camera: Array) -> Array:
    """Return the motions [N - 1, 4, 4] from each pose to the next one."""
    return se3.inverse(T_world_camera[:-1]) @ T_world_camera[1:]


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
