"""Shape statistics of the points of an object."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.open3d_bridge import open3d

Array = NDArray[np.float64]

# Names of the values returned by `shape_statistics`.
STATISTICS = (
    "middle extent by longest",
    "shortest extent by longest",
    "linearity",
    "planarity",
    "sphericity",
    "height by longest extent",
    "levelness",
    "bottom above floor (m)",
)

_MIN_POINTS = 10
# Minimum number of points of an object, unless all objects of a class are smaller.
_OBJECT_POINTS = 30
# Noise added because Qhull fails for coplanar points; smaller than depth noise.
_NOISE_M = 1e-3


def shape_statistics(points_m: Array, up: Array, floor_m: float = 0.0) -> Array:
    """Compute the STATISTICS of an object.

    Extents are those of the oriented box (Open3D). Linearity (l1-l2)/l1, planarity (l2-l3)/l1
    and sphericity l3/l1 are computed from the eigenvalues l1 >= l2 >= l3 of the points'
    covariance. Levelness is 1 if the flat side of the object is horizontal (table), and 0 if it is
    vertical (picture).

    Args:
        points_m: [N, 3], N >= 10.
        up: unit vector [3].
        floor_m: height of the floor along `up`.

    Raises:
        DependencyError: Open3D is missing.
    """
    noisy = points_m + np.random.default_rng(0).normal(0.0, _NOISE_M, points_m.shape)
    geometry = open3d().geometry
    box = geometry.OrientedBoundingBox.create_from_points_minimal(
        open3d().utility.Vector3dVector(noisy)
    )
    shortest, middle, longest = np.sort(np.asarray(box.extent))
    values, axes = np.linalg.eigh(np.cov(noisy.T))
    l3, l2, l1 = np.maximum(values, 0.0)
    heights = points_m @ up
    return np.array(
        [
            middle / longest,
            shortest / longest,
            (l1 - l2) / l1,
            (l2 - l3) / l1,
            l3 / l1,
            np.ptp(heights) / longest,
            abs(axes[:, 0] @ up),
            heights.min() - floor_m,
        ]
    )


def instances(points_m: Array, gap_m: float) -> list[Array]:
    """Split the points of a class into objects (Open3D's DBSCAN), largest first.

    Args:
        points_m: [N, 3] points of the class.
        gap_m: minimum distance between different objects in metres; radius of DBSCAN.
    """
    if len(points_m) < _MIN_POINTS:
        return []
    cloud = open3d().geometry.PointCloud(open3d().utility.Vector3dVector(points_m))
    labels = np.asarray(cloud.cluster_dbscan(eps=gap_m, min_points=_MIN_POINTS // 2))
    pieces = [points_m[labels == label] for label in range(labels.max() + 1)]
    pieces = sorted((p for p in pieces if len(p) >= _MIN_POINTS), key=len, reverse=True)
    return [p for p in pieces if len(p) >= _OBJECT_POINTS] or pieces[:1]
