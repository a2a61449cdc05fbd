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
measured instead, of the frame against the map (`view`):

    drift_ratio^2 * view * (metres + radians)    between two views of the same surfaces
    + frame_ratio^2 * view * (1 + step / moved)  of the frame itself, after a step of this motion

Trackers that only know the information give that of one pixel, since errors that are correlated
over the whole image do not average out over its pixels: view = pixels * inverse(information).

A camera that moves fast between two frames blurs and bends them, and the velocity by which that is
undone is less certain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.graph import PoseEdge, information_of

Array = NDArray[np.float64]

# Information of an alignment without noise of its own.
_NO_NOISE = np.eye(6) * 1e9


@dataclass(frozen=True)
class LoopNoise:
    """Covariances of loop edges from the information of registrations.

    Attributes:
        scale: factor applied to the variance that an alignment reports. The squared errors of image
            pairs in synthetic rooms are 2 to 4 times the expected ones.
        edge_m, edge_rad: minimum standard deviations of an edge.
        unseen: standard deviation of directions without information, in metres and radians.
    """

    scale: float = 4.0
    edge_m: float = 0.01
    edge_rad: float = 0.005
    unseen: float = 1.0

    def alignment(self, information: Array) -> Array:
        """Covariance [6, 6] of an alignment.

        Args:
            information: [6, 6] positive semi-definite, of (translation m, rotation rad).
        """
        # A weak prior constrains unobserved directions.
        weak = np.eye(6) / self.unseen**2
        measured = np.linalg.inv(0.5 * (information + information.T) / self.scale + weak)
        floor = np.diag([self.edge_m**2] * 3 + [self.edge_rad**2] * 3)
        return 0.5 * (measured + measured.T) + floor

    def edge(self, first: int, second: int, T_first_second: Array, information: Array) -> PoseEdge:
        """Make the loop edge of a registration; `T_target_source` is the edge target-source."""
        covariance = self.alignment(information)
        return PoseEdge.loop(first, second, T_first_second, information_of(covariance))


@dataclass(frozen=True)
class OdometryNoise(LoopNoise):
    """Covariances of odometry edges from the information of a tracker.

    The variance grows linearly with the path. The terms of edge and path were set on one hand-held
    sequence, TUM's fr1_rpy: over 5 to 40 frames the errors of the dense tracker (those of the
    ground truth included) are 0.7 to 1.2 of what they state without the information. They are
    conservative on rendered sequences. The terms of drift and frame were set by `python -m
    benchmarks.accuracy.uncertainty` on all recordings at every first, fourth and eighth frame.

    Attributes:
        per_metre_m, per_metre_rad: standard deviations after a path of 1 m.
        per_radian_m, per_radian_rad: standard deviations after a rotation by 1 rad.
        drift_ratio: standard deviation of a frame's drift over 1 m or 1 rad of motion between views
            of the same surfaces, relative to that of the view.
        frame_ratio: that of a frame against the map, while the camera hardly moves.
        moved: motion between two frames that doubles the variance of a frame against the map, in
            metres plus radians.
    """

    scale: float = 100.0
    edge_m: float = 0.002
    edge_rad: float = 0.001
    per_metre_m: float = 0.015
    per_metre_rad: float = 0.01
    per_radian_m: float = 0.015
    per_radian_rad: float = 0.02
    drift_ratio: float = 0.5
    frame_ratio: float = 0.5
    moved: float = 0.05

    def covariance(self, information: Array, metres: float, radians: float) -> Array:
        """Covariance [6, 6] of an edge that ends at a tracked frame.

        Args:
            information: [6, 6] of that frame, zero for given poses.
            metres, radians: length and total rotation of the path (`path_between`).
        """
        drift_m2 = self.per_metre_m**2 * metres + self.per_radian_m**2 * radians
        drift_rad2 = self.per_metre_rad**2 * metres + self.per_radian_rad**2 * radians
        return self.alignment(information) + np.diag([drift_m2] * 3 + [drift_rad2] * 3)

    def drift(self, view: Array, metres: float, radians: float) -> Array:
        """Covariance [6, 6] of the drift between two views of the same surfaces.

        Args:
            view: [6, 6] covariance by what the later view determines; 0 if it is unknown.
            metres, radians: motion between them.
        """
        if not view.any():
            return self.covariance(_NO_NOISE, metres, radians)
        return self.drift_ratio**2 * (metres + radians) * view

    def of_frame(self, view: Array, step: float) -> Array:
        """Covariance [6, 6] of a frame against the map.

        Args:
            view: [6, 6] covariance by what the frame's view determines; 0 if it is unknown.
            step: motion since the frame before, metres plus radians.
        """
        return np.asarray(self.frame_ratio**2 * (1.0 + step / self.moved) * view)

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
