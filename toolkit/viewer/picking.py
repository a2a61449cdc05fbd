"""The Gaussian that a ray hits, and its object."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from toolkit.viewer.scene import ShownObject, ShownSplats

_NEAR_M = 0.05
# Angle of a pixel of a common screen, so that Gaussians smaller than a pixel can be hit.
_PIXEL_RAD = 0.0006
# Gaussians end at this squared number of standard deviations, and at the smallest visible opacity.
_MAX_SQUARED = 11.0
_MIN_ALPHA = 1.0 / 255.0
# A Gaussian belongs to an object at most this far from its voxels, which are 5 cm large.
_REACH_M = 0.1


def pick(
    splats: ShownSplats, origin_m: NDArray[np.float64], direction: NDArray[np.float64]
) -> int | None:
    """Return the Gaussian at which the light has lost half of its strength along a ray.

    Args:
        splats: the Gaussians.
        origin_m: [3] start of the ray, in the frame of the map.
        direction: [3] direction of the ray, of any length > 0.

    Returns:
        Index of the Gaussian; None if the ray ends in the background.
    """
    direction = direction / np.linalg.norm(direction)
    offsets_m = splats.means_m - origin_m
    along_m = offsets_m @ direction
    index = np.flatnonzero(along_m > _NEAR_M)
    along_m = along_m[index]
    across = (offsets_m[index] ** 2).sum(axis=1) - along_m**2
    variance = splats.sigmas_m[index] ** 2 + (_PIXEL_RAD * along_m) ** 2
    squared = across / variance
    hit = squared <= _MAX_SQUARED
    index, along_m, squared = index[hit], along_m[hit], squared[hit]
    alpha = splats.opacities[index] * np.exp(-0.5 * squared)
    visible = alpha >= _MIN_ALPHA
    order = np.argsort(along_m[visible], kind="stable")
    index, alpha = index[visible][order], alpha[visible][order]
    light = np.cumprod(1.0 - alpha)
    below = np.flatnonzero(light < 0.5)
    return int(index[below[0]]) if len(below) else None


def object_at(
    objects: Iterable[ShownObject], point_m: NDArray[np.floating], class_path: tuple[str, ...]
) -> int | None:
    """Return the number of the object to which a Gaussian belongs.

    It is the object of its class with the nearest voxel. Of objects whose voxels are unknown, it
    is the one with the nearest box, and of several boxes around the Gaussian the smallest one.

    Args:
        objects: the objects.
        point_m: [3] centre of the Gaussian, in the frame of the map.
        class_path: its class or group, from the root of the class tree; empty if it is unknown.

    Returns:
        The number; None if no object of the class is near.
    """
    found = []
    for one in objects:
        if _may_be(one, class_path):
            distance_m = _distance_m(one, point_m)
            if distance_m <= _REACH_M:
                # Rounded, since 0 inside of a box is not exact.
                found.append((round(distance_m, 6), float(one.size_m.prod()), one.number))
    return min(found)[2] if found else None


def _may_be(one: ShownObject, class_path: tuple[str, ...]) -> bool:
    """Whether an object is of a class or group, or of an unknown one, which a box cannot tell."""
    if not class_path:
        return one.voxels_m is not None
    return one.path[: len(class_path)] == class_path


def _distance_m(one: ShownObject, point_m: NDArray[np.floating]) -> float:
    """Distance of a point [3] from the nearest voxel of an object, or else from its box."""
    edges_m = one.edges_m
    squared = np.maximum((edges_m**2).sum(axis=1), 1e-12)
    inside = np.clip(edges_m @ (point_m - one.corners_m[0]) / squared, 0.0, 1.0)
    box_m = float(np.linalg.norm(one.corners_m[0] + inside @ edges_m - point_m))
    if one.voxels_m is None or box_m > _REACH_M:
        return box_m
    return float(np.linalg.norm(one.voxels_m - point_m, axis=1).min())
