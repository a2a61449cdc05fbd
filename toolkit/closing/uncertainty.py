"""Pose covariances of a run: anchors from the pose graph, frames from the path since the anchor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.pose_graph.graph import covariance_in_frame
from toolkit.pose_graph.noise import OdometryNoise

Array = NDArray[np.float64]

# Information of tracking between neighbouring frames. Its noise is negligible compared with the
# drift along the path from the anchor.
NEGLIGIBLE_NOISE = np.eye(6) * 1e9


def frame_covariances(
    anchors: Sequence[Array],
    submaps: Sequence[int],
    T_submap_camera: Sequence[Array],
    noise: OdometryNoise,
) -> Array:
    """Covariances [M, 6, 6] of x in T_world_camera exp(x), x = (translation m, rotation rad).

    The covariance of a frame is its anchor's plus that of the odometry along the camera's path
    since the anchor. Loops inside a submap are not taken into account; they reduce it.

    Args:
        anchors: covariance [6, 6] of each submap's anchor, by number.
        submaps: number of each frame's submap.
        T_submap_camera: pose [4, 4] of each frame in its submap.
    """
    covariances = []
    metres = radians = 0.0
    previous: tuple[int, Array] | None = None
    for number, T in zip(submaps, T_submap_camera, strict=True):
        if previous is None or previous[0] != number:
            metres = radians = 0.0
            previous = (number, np.eye(4))
        step = se3.inverse(previous[1]) @ T
        metres += float(np.linalg.norm(step[:3, 3]))
        radians += float(se3.rotation_angle_rad(step[:3, :3]))
        previous = (number, T)
        anchor = covariance_in_frame(anchors[number], T)
        covariances.append(anchor + noise.covariance(NEGLIGIBLE_NOISE, metres, radians))
    return np.array(covariances).reshape(-1, 6, 6)
