"""How far an estimated path lies from the true one: ATE and RPE.

Both papers and the TUM benchmark (Sturm et al. 2012) report the root mean square of
the distances between camera centres after a best-fitting alignment: rigid (SE(3))
where the sensor gives metres, with scale (Sim(3)) for a monocular camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DatasetError
from toolkit.geometry import se3
from toolkit.geometry.trajectory import Trajectory

Array = NDArray[np.float64]
AlignmentKind = Literal["none", "se3", "sim3"]

# evo's default. Sparse truth and a wider window change the figure: 0.02 s, the default of
# TUM's own script, adds 1 % to the ATE of its fr2/desk, so reports name the difference.
MAX_TIME_DIFFERENCE_S = 0.01


@dataclass(frozen=True)
class Alignment:
    """The motion that lays an estimated path over the true one.

    Attributes:
        T_world_map: [4, 4] rigid part, estimate's frame to the truth's frame.
        scale: factor on the estimate's lengths, 1 unless the alignment is Sim(3).

    A point moves as `p_world = scale * R @ p_map + t`.
    """

    T_world_map: Array
    scale: float = 1.0

    def applied_to(self, estimate: Trajectory) -> Trajectory:
        """The estimate in the truth's frame and scale; rotations keep their form."""
        scaled = estimate.T_world_camera.copy()
        scaled[:, :3, 3] *= self.scale
        return Trajectory(estimate.timestamps_s, self.T_world_map @ scaled)


@dataclass(frozen=True)
class AbsoluteTrajectoryError:
    """Distances between true and aligned estimated camera centres.

    Attributes:
        rmse_m, mean_m, median_m, max_m: metres, over all pairs.
        kind: the alignment's name, "none", "se3" or "sim3".
        alignment: the motion itself.
        pairs: poses compared.
        timestamps_s: [pairs] times of the estimate.
        errors_m: [pairs] the distances.
    """

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    kind: AlignmentKind
    alignment: Alignment
    pairs: int
    timestamps_s: Array
    errors_m: Array


@dataclass(frozen=True)
class RelativePoseError:
    """Drift over a fixed number of frames; it needs no alignment.

    Attributes:
        delta_frames: associated poses between the two ends of a step.
        translation_rmse_m, translation_median_m: metres a step.
        rotation_rmse_deg, rotation_median_deg: degrees a step.
        pairs: steps compared (overlapping ones for delta_frames > 1).
    """

    delta_frames: int
    translation_rmse_m: float
    translation_median_m: float
    rotation_rmse_deg: float
    rotation_median_deg: float
    pairs: int


def associate(
    estimate: Trajectory,
    truth: Trajectory,
    max_difference_s: float = MAX_TIME_DIFFERENCE_S,
) -> tuple[Trajectory, Trajectory]:
    """The poses of both paths at the estimate's times, nearest in time, of equal length.

    Raises:
        DatasetError: no estimated pose has a true one near it in time.
    """
    near_truth = truth.associated_to(estimate.timestamps_s, max_difference_s)
    if len(near_truth) == 0:
        raise DatasetError(
            f"no estimated pose ({estimate}) lies within {max_difference_s:g} s of a true one "
            f"({truth}): both need the same clock, or raise the allowed difference"
        )
    kept = np.isin(estimate.timestamps_s, near_truth.timestamps_s)
    return Trajectory(estimate.timestamps_s[kept], estimate.T_world_camera[kept]), near_truth


def align(points_map: Array, points_world: Array, with_scale: bool = False) -> Alignment:
    """Least-squares motion from one point set to another (Umeyama 1991).

    Args:
        points_map: [N, 3] points to be moved, N >= 1.
        points_world: [N, 3] where they should come to lie.
        with_scale: also fit a scale (Sim(3)); it stays 1 for points that coincide.

    Raises:
        ValueError: shapes disagree or there are no points.
    """
    if points_map.shape != points_world.shape or points_map.ndim != 2 or len(points_map) == 0:
        raise ValueError(
            f"points must both have shape [N, 3] with N >= 1, got {list(points_map.shape)} "
            f"and {list(points_world.shape)}"
        )
    mean_map, mean_world = points_map.mean(axis=0), points_world.mean(axis=0)
    centred_map, centred_world = points_map - mean_map, points_world - mean_world
    U, singular, Vt = np.linalg.svd(centred_world.T @ centred_map / len(points_map))
    # A reflection fits a flat path as well as a rotation does; turn the weakest axis back.
    signs = np.array([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)])
    R = U @ np.diag(signs) @ Vt
    variance = float((centred_map**2).sum() / len(points_map))
    fits_scale = with_scale and variance > 0.0
    scale = float((singular * signs).sum() / variance) if fits_scale else 1.0
    translation = mean_world - scale * R @ mean_map
    return Alignment(se3.from_rotation_translation(R, translation), scale)


def absolute_trajectory_error(
    estimate: Trajectory,
    truth: Trajectory,
    kind: AlignmentKind = "se3",
    max_difference_s: float = MAX_TIME_DIFFERENCE_S,
) -> AbsoluteTrajectoryError:
    """ATE of an estimate against the truth, over the poses that pair up in time.

    Raises:
        DatasetError: no poses pair up.
    """
    estimate, truth = associate(estimate, truth, max_difference_s)
    if kind == "none":
        alignment = Alignment(np.eye(4))
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


def relative_pose_error(
    estimate: Trajectory,
    truth: Trajectory,
    delta_frames: int = 1,
    max_difference_s: float = MAX_TIME_DIFFERENCE_S,
) -> RelativePoseError | None:
    """RPE over all steps of `delta_frames` paired poses; None where the path is shorter.

    Raises:
        DatasetError: no poses pair up.
        ValueError: delta_frames is below 1.
    """
    if delta_frames < 1:
        raise ValueError(f"delta_frames must be at least 1, got {delta_frames}")
    estimate, truth = associate(estimate, truth, max_difference_s)
    if len(estimate) <= delta_frames:
        return None
    steps_true = _steps(truth.T_world_camera, delta_frames)
    steps_estimated = _steps(estimate.T_world_camera, delta_frames)
    difference = se3.inverse(steps_true) @ steps_estimated
    translation_m = np.linalg.norm(difference[:, :3, 3], axis=1)
    rotation_deg = np.degrees(se3.rotation_angle_rad(difference[:, :3, :3]))
    return RelativePoseError(
        delta_frames=delta_frames,
        translation_rmse_m=_root_mean_square(translation_m),
        translation_median_m=float(np.median(translation_m)),
        rotation_rmse_deg=_root_mean_square(rotation_deg),
        rotation_median_deg=float(np.median(rotation_deg)),
        pairs=len(difference),
    )


def _steps(T_world_camera: Array, delta_frames: int) -> Array:
    """Motions [N - delta, 4, 4] from each pose to the one `delta_frames` later."""
    return se3.inverse(T_world_camera[:-delta_frames]) @ T_world_camera[delta_frames:]


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
