"""How well the image points determine the scale of a monocular map along the sequence."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.monocular.visual_odometry.landmarks import bundle
from toolkit.depth.monocular.visual_odometry.sparse_map import MAX_ERROR_PX, SparseMap
from toolkit.depth.monocular.visual_odometry.two_view import rays

Array = NDArray[np.float64]

# A camera that has moved less on one side of a gap, relative to the median depth, has no scale.
_MIN_EXTENT = 0.02
# Information of an undetermined scale, so that its standard deviation is finite.
_NO_INFORMATION = 1e-6
_MIN_DEPTH = 1e-6


def scale_sigma(sparse_map: SparseMap) -> Array:
    """Standard deviations [V - 1] of the relative scale on both sides of each gap between views.

    If everything after a gap is scaled about the last camera before it, image points move, unless
    they are shown on one side only, or without parallax on one of the sides. The value is the
    relative change of scale that image errors of one pixel (standard deviation) can cause, given
    the rest of the map. It is large where a camera turns without moving, or sees little.

    Revisits from behind a gap to before it count as well.
    """
    views = sparse_map.views
    camera = sparse_map.camera
    everything = range(len(views))
    problem, _, number = bundle(camera, sparse_map.table, views, everything, everything)
    seen, marks, T = problem.observations, problem.landmarks, problem.T_world_camera
    anchor, pose = marks.anchor[seen.landmark], seen.pose
    R = T[pose, :3, :3]
    inverse_depth = marks.inverse_depth[seen.landmark]
    direction = np.einsum(
        "nij,nj->ni", T[anchor, :3, :3], rays(camera, marks.anchor_px)[seen.landmark]
    )
    centres = T[:, :3, 3]
    baseline = centres[anchor] - centres[pose]
    points = _turned(R, direction + inverse_depth[:, None] * baseline)
    ahead = points[:, 2] > _MIN_DEPTH
    points = np.where(ahead[:, None], points, [0.0, 0.0, 1.0])
    fits = ahead & (np.linalg.norm(camera.project(points) - seen.px, axis=1) < MAX_ERROR_PX)

    def moved_px(change: Array) -> Array:
        """Motion [O, 2] in the image for changes [O, 3] of the points in world directions."""
        local, z = _turned(R, change), points[:, 2:]
        motion = (local[:, :2] - points[:, :2] * local[:, 2:] / z) / z
        return np.where(fits[:, None], motion * [camera.fx, camera.fy], 0.0)

    # A landmark's inverse depth follows where it explains the motion.
    count = len(marks)
    by_depth = moved_px(baseline)
    depth_information = np.bincount(seen.landmark, (by_depth**2).sum(1), count)
    sigma = np.empty(max(len(views) - 1, 0))
    for gap in range(len(sigma)):
        after = number > gap
        shift = np.where(after[:, None], centres - views[gap].T_world_camera[:3, 3], 0.0)
        motion = moved_px(inverse_depth[:, None] * (shift[anchor] - shift[pose]))
        total = np.bincount(seen.landmark, (motion**2).sum(1), count)
        mixed = np.bincount(seen.landmark, (motion * by_depth).sum(1), count)
        information = (total - mixed**2 / np.maximum(depth_information, 1e-12)).sum()
        sigma[gap] = 1.0 / np.sqrt(max(float(information), _NO_INFORMATION))
    return sigma


def scale_matters(sparse_map: SparseMap) -> NDArray[np.bool_]:
    """Gaps [V - 1] between views on both sides of which the camera has moved."""
    centres = np.array([view.T_world_camera[:3, 3] for view in sparse_map.views]).reshape(-1, 3)
    known = sparse_map.table.inverse_depth[sparse_map.table.measured]
    least = _MIN_EXTENT / float(np.median(known)) if len(known) else 0.0
    gaps = range(len(centres) - 1)
    return np.array([min(map(_reach, (centres[: n + 1], centres[n + 1 :]))) > least for n in gaps])


def _reach(centres: Array) -> float:
    """Largest distance from the first position."""
    return float(np.linalg.norm(centres - centres[0], axis=1).max())


def _turned(R_world_camera: Array, vectors: Array) -> Array:
    """World directions [N, 3] in the coordinates of cameras with rotations [N, 3, 3]."""
    return np.asarray(np.einsum("nji,nj->ni", R_world_camera, vectors))
