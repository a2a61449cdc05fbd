"""What an alignment's word is worth: covariances of odometry and loop edges.

The information that tracking and registration give is that of Gauss-Newton, where each pixel
is a measurement of its own. But pixels err together (calibration, exposure, depth that is
wrong over whole surfaces, the map itself), which no number of them averages out, so the
information is far too large. An edge's covariance is therefore

    scale * inverse(information)      its shape: which directions were seen badly
    + edge^2                          the least error of an alignment, on the diagonal
    + per_metre^2 * metres + per_radian^2 * radians      of odometry, on the diagonal

What grows with the path grows as a variance, so that cutting a path into shorter edges adds
no more than the constant of an edge.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.pose_graph.graph import PoseEdge, information_of
from toolkit.pose_graph.options import LoopNoiseOptions, OdometryNoiseOptions

Array = NDArray[np.float64]


class LoopNoise:
    """Covariances of loop edges from the information of registrations."""

    def __init__(self, options: LoopNoiseOptions | None = None) -> None:
        self.options = options or LoopNoiseOptions()

    def alignment(self, information: Array) -> Array:
        """Covariance [6, 6] of an alignment.

        Args:
            information: [6, 6] positive semi-definite, of (translation m, rotation rad).
        """
        # A weak prior holds the directions that nothing was seen of.
        weak = np.eye(6) / self.options.unseen**2
        measured = np.linalg.inv(0.5 * (information + information.T) / self.options.scale + weak)
        floor = np.diag([self.options.edge_m**2] * 3 + [self.options.edge_rad**2] * 3)
        return 0.5 * (measured + measured.T) + floor

    def edge(self, first: int, second: int, T_first_second: Array, information: Array) -> PoseEdge:
        """The loop edge of a registration: `T_target_source` is the edge target-source."""
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
            information: [6, 6] of that frame, zero where poses were given.
            metres, radians: path and turns along the edge, as `path_between` sums them.
        """
        drift_m2 = self.options.per_metre_m**2 * metres + self.options.per_radian_m**2 * radians
        drift_rad2 = (
            self.options.per_metre_rad**2 * metres + self.options.per_radian_rad**2 * radians
        )
        return self.alignment(information) + np.diag([drift_m2] * 3 + [drift_rad2] * 3)

    def along(
        self, first: int, second: int, T_map_camera: Sequence[Array], information: Array
    ) -> PoseEdge:
        """The odometry edge of the frames from one node to the next.

        The map that a frame is aligned to was built from the keyframes before it and has
        their errors, so of the frames only the last one's alignment counts.

        Args:
            T_map_camera: [4, 4] of each frame, from the first node's to the second's.
            information: [6, 6] of the last frame.
        """
        T_first_second = se3.inverse(T_map_camera[0]) @ T_map_camera[-1]
        covariance = self.covariance(information, *path_between(T_map_camera))
        return PoseEdge(first, second, T_first_second, information_of(covariance))


def path_between(T_map_camera: Sequence[Array]) -> tuple[float, float]:
    """Length of a path (m) and the sum of its turns (rad), frame by frame."""
    poses = np.asarray(T_map_camera, dtype=np.float64)
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    metres = np.linalg.norm(steps[:, :3, 3], axis=1).sum()
    return float(metres), float(se3.rotation_angle_rad(steps[:, :3, :3]).sum())
