"""Noise models: covariances of odometry and loop edges.

Tracking and registration return the Gauss-Newton information, which treats pixels as independent
measurements. Pixel errors are correlated (calibration, exposure, depth bias over whole surfaces,
errors of the map), so this information is far too large. The covariance of an edge is therefore

    scale * inverse(information)      shape: weakly constrained directions
    + edge^2                          minimum error of an alignment, on the diagonal
    + per_metre^2 * metres + per_radian^2 * radians      odometry only, on the diagonal

Path-dependent terms grow linearly in variance. Splitting a path into shorter edges therefore only
adds the constant term of each edge.

The pose graph is given the terms with constants. They are upper bounds for hand-held sensors, so
that correct loops pass its tests. The covariances of frames that a run reports follow from what was
measured instead. Errors that are correlated over the whole image do not average out over its
pixels, so that their size is that of one pixel's residual:

    pixel = pixels * inverse(information)       of the tracked frame
    drift^2 * pixel * (metres + radians)        between two views of the same surfaces
    + frame^2 * pixel * (1 + step / moved)      of the frame itself, after a step of this motion

A camera that moves fast between two frames blurs and bends them, and the velocity by which that is
undone is less certain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.loops.pose_graph.graph import PoseEdge, information_of
from toolkit.loops.pose_graph.options import LoopNoiseOptions, OdometryNoiseOptions

Array = NDArray[np.float64]

# Information of an alignment without noise of its own.
_NO_NOISE = np.eye(6) * 1e9


class LoopNoise:
    """Covariances of loop edges from the information of registrations."""

    def __init__(self, options: LoopNoiseOptions | None = None) -> None:
        self.options = options or LoopNoiseOptions()

    def alignment(self, information: Array) -> Array:
        """Covariance [6, 6] of an alignment.

        Args:
            information: [6, 6] positive semi-definite, of (translation m, rotation rad).
        """
        # A weak prior constrains unobserved directions.
        weak = np.eye(6) / self.options.unseen**2
        measured = np.linalg.inv(0.5 * (information + information.T) / self.options.scale + weak)
        floor = np.diag([self.options.edge_m**2] * 3 + [self.options.edge_rad**2] * 3)
        return 0.5 * (measured + measured.T) + floor

    def edge(self, first: int, second: int, T_first_second: Array, information: Array) -> PoseEdge:
        """Make the loop edge of a registration; `T_target_source` is the edge target-source."""
        covariance = self.alignment(information)
        return PoseEdge.loop(first, second, T_first_second, information_of(covariance))


class OdometryNoise(LoopNoise):
    """Covariances of odometry edges from the information of a tracker."""

    options: OdometryNoiseOptions

    def __init__(self, options: OdometryNoiseOptions | None = None) -> None:
        super().__init__(options or OdometryNoiseOptions())

    def covariance(self, information: Array, metres: float, radians: float) -> Array:
        """Covariance [6, 6] of an edge that ends at a tracked frame.

        Args:
            information: [6, 6] of that frame, zero for given poses.
            metres, radians: length and total rotation of the path (`path_between`).
        """
        drift_m2 = self.options.per_metre_m**2 * metres + self.options.per_radian_m**2 * radians
        drift_rad2 = (
            self.options.per_metre_rad**2 * metres + self.options.per_radian_rad**2 * radians
        )
        return self.alignment(information) + np.diag([drift_m2] * 3 + [drift_rad2] * 3)

    def drift(self, pixel: Array, metres: float, radians: float) -> Array:
        """Covariance [6, 6] of the drift between two views of the same surfaces.

        Args:
            pixel: [6, 6] of `pixel_covariance` of the later view; 0 if it is unknown.
            metres, radians: motion between them.
        """
        if not pixel.any():
            return self.covariance(_NO_NOISE, metres, radians)
        return self.options.drift**2 * (metres + radians) * pixel

    def of_frame(self, pixel: Array, step: float) -> Array:
        """Covariance [6, 6] of a frame against the map.

        Args:
            pixel: [6, 6] of `pixel_covariance`; 0 if it is unknown.
            step: motion since the frame before, metres plus radians.
        """
        return np.asarray(self.options.frame**2 * (1.0 + step / self.options.moved) * pixel)

    def along(
        self, first: int, second: int, T_map_camera: Sequence[Array], information: Array
    ) -> PoseEdge:
        """Make the odometry edge between two nodes from the tracked frames between them.

        Frames are aligned to a map that contains the errors of the previous keyframes, so only
        the information of the last frame is used.

        Args:
            first, second: node numbers.
            T_map_camera: [4, 4] pose of each frame, from the first node to the second.
            information: [6, 6] of the last frame.
        """
        T_first_second = se3.inverse(T_map_camera[0]) @ T_map_camera[-1]
        covariance = self.covariance(information, *path_between(T_map_camera))
        return PoseEdge(first, second, T_first_second, information_of(covariance))


def pixel_covariance(information: Array, pixels: int, unseen: float) -> Array:
    """Covariance [6, 6] of a pose from one pixel's residuals; 0 without information.

    Args:
        information: [6, 6] of an alignment that treats pixels as independent.
        pixels: number of pixels of the image.
        unseen: standard deviation of directions without information, in metres and radians.
    """
    if not information.any() or not np.isfinite(information).all():
        return np.zeros((6, 6))
    mean = 0.5 * (information + information.T) / pixels
    return np.asarray(np.linalg.inv(mean + np.eye(6) / unseen**2))


def path_between(T_map_camera: Sequence[Array]) -> tuple[float, float]:
    """Length (m) and total rotation (rad) of a path, summed over consecutive frames."""
    poses = np.asarray(T_map_camera, dtype=np.float64)
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    metres = np.linalg.norm(steps[:, :3, 3], axis=1).sum()
    return float(metres), float(se3.rotation_angle_rad(steps[:, :3, :3]).sum())
