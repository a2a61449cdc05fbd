"""Overlap of a view with the volume that the keyframes of a submap observed (G-III.A)."""

from __future__ import annotations

from collections.abc import Sequence

from toolkit.geometry import se3
from toolkit.geometry.frustum_occupancy import inside_frustum
from toolkit.keyframe import Keyframe


def view_overlap(keyframe: Keyframe, others: Sequence[Keyframe]) -> float:
    """Fraction of a keyframe's observed points inside the union of viewing volumes (r_olap).

    A viewing volume is the part of a camera's frustum in front of the surface that the camera
    measured, so it does not extend through walls.

    Args:
        others: keyframes of the same submap.

    Returns:
        Value in [0, 1]; 0 if the keyframe observed no points.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    remaining = keyframe.points_in_map()
    count = len(remaining)
    # The latest keyframes see most of the view; few others are then tested.
    for other in reversed(others):
        if not len(remaining):
            break
        points = se3.transform_points(se3.inverse(other.T_map_camera), remaining)
        inside = inside_frustum(other.camera, points)
        inside[inside] = other.in_front_of_surface(points[inside])
        remaining = remaining[~inside]
    return 1.0 - len(remaining) / count if count else 0.0
