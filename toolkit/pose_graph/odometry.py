"""What the tracker's word is worth: covariances of odometry edges.

The tracker's information is that of Gauss-Newton: every pixel counts as a measurement of its
own. Pixels err together (calibration, exposure, wrong depth over whole surfaces, the map's own
errors), so the information is far too large, and no factor mends that alone: on a still camera
it goes on growing with the number of pixels while the error stays. An edge's covariance is
therefore

    scale * inverse(information)            the shape: which directions were seen badly
    + edge^2 + per_metre^2 * metres + per_radian^2 * radians       what no pixel count shows

the latter on the diagonal. The floors grow with the path as variances, so that cutting a path
into shorter edges changes nothing; the constant of an edge is the error of one alignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.pose_graph.graph import PoseEdge

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OdometryNoise:
    """From a tracker's information to the covariance of an odometry edge.

    Standard deviations; those along a path hold for 1 m or 1 rad and grow with its root.

    Attributes:
        scale: variance of the tracker's errors over that which it states, at least 1.
        edge_m, edge_rad: of every edge.
        per_metre_m, per_metre_rad: after a metre of path.
        per_radian_m, per_radian_rad: after a turn by one radian.
        unseen: of directions that the information says nothing about (m, rad).
    """

    scale: float = 100.0
    edge_m: float = 0.001
    edge_rad: float = 0.0005
    per_metre_m: float = 0.01
    per_metre_rad: float = 0.005
    per_radian_m: float = 0.01
    per_radian_rad: float = 0.01
    unseen: float = 1.0

    def covariance(self, information: Array, metres: float, radians: float) -> Array:
        """Covariance [6, 6] of an edge that ends at a tracked frame.

        Args:
            information: [6, 6] of the frame that the edge ends at, as the tracker gives it:
                positive semi-definite, and zero where poses were given.
            metres, radians: path and turns along the edge, as `path_between` sums them.
        """
        # A weak prior holds the directions that nothing was seen of.
        weak = np.eye(6) / self.unseen**2
        measured = np.linalg.inv(0.5 * (information + information.T) / self.scale + weak)
        floor_m2 = self.edge_m**2 + self.per_metre_m**2 * metres + self.per_radian_m**2 * radians
        floor_rad2 = (
            self.edge_rad**2 + self.per_metre_rad**2 * metres + self.per_radian_rad**2 * radians
        )
        return 0.5 * (measured + measured.T) + np.diag([floor_m2] * 3 + [floor_rad2] * 3)

    def edge(
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
        return PoseEdge(first, second, se3.orthonormalise(T_first_second), inverse(covariance))


def path_between(T_map_camera: Sequence[Array]) -> tuple[float, float]:
    """Length of a path (m) and the sum of its turns (rad), frame by frame."""
    poses = np.asarray(T_map_camera, dtype=np.float64)
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    metres = np.linalg.norm(steps[:, :3, 3], axis=1).sum()
    return float(metres), float(se3.rotation_angle_rad(steps[:, :3, :3]).sum())


def composed(edges: Sequence[PoseEdge]) -> PoseEdge:
    """One odometry edge for several that follow each other; their covariances add up.

    T_a_b exp(x) T_b_c exp(y) = T_a_b T_b_c exp(adjoint(T_c_b) x) exp(y), to first order.

    Raises:
        ValueError: there is no edge, or one does not start where the one before it ends.
    """
    if not edges:
        raise ValueError("nothing to compose: no edges")
    T, covariance, end = edges[0].T_first_second, edges[0].covariance, edges[0].second
    for edge in edges[1:]:
        if edge.first != end:
            raise ValueError(f"odometry breaks off: {edge} does not follow node {end}")
        A = se3.adjoint(se3.inverse(edge.T_first_second))
        T = se3.orthonormalise(T @ edge.T_first_second)
        covariance = A @ covariance @ A.T + edge.covariance
        end = edge.second
    return PoseEdge(edges[0].first, end, T, inverse(covariance))


def inverse(covariance: Array) -> Array:
    """Information [6, 6] of a covariance, symmetric to the bit."""
    information = np.linalg.inv(covariance)
    return 0.5 * (information + information.T)
