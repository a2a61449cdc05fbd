"""How sure the poses of a run are: of anchors by the pose graph, of frames by the way from them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.pose_graph.graph import covariance_in_frame
from toolkit.pose_graph.noise import OdometryNoise

Array = NDArray[np.float64]

# Between neighbouring frames the tracker is sure; what counts is how far they are from the anchor.
SURE = np.eye(6) * 1e9


def frame_covariances(
    anchors: Sequence[Array],
    submaps: Sequence[int],
    T_submap_camera: Sequence[Array],
    noise: OdometryNoise,
) -> Array:
    """Covariances [M, 6, 6] of x in T_world_camera exp(x), x = (translation m, rotation rad).

    A frame has its anchor's covariance, and odometry's of the way that the camera took since.
    Loops inside a submap make its frames surer than this says.

    Args:
        anchors: [6, 6] of each submap's anchor, by number.
        submaps: number of each frame's submap. T_submap_camera: [4, 4] of each frame.
    """
    found = []
    metres = radians = 0.0
    before: tuple[int, Array] | None = None
    for number, T in zip(submaps, T_submap_camera, strict=True):
        if before is None or before[0] != number:
            metres = radians = 0.0
            before = (number, np.eye(4))
        step = se3.inverse(before[1]) @ T
        metres += float(np.linalg.norm(step[:3, 3]))
        radians += float(se3.rotation_angle_rad(step[:3, :3]))
        before = (number, T)
        spread = covariance_in_frame(anchors[number], T)
        found.append(spread + noise.covariance(SURE, metres, radians))
    return np.array(found).reshape(-1, 6, 6)
