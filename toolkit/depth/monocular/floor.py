"""Height of a camera above the floor, from points of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.image_sides import ImageSide, mean_up

Array = NDArray[np.float64]

_SAMPLES = 500
# Largest angle between the normal of the floor and the mean upward direction of the images.
_MAX_TILT_RAD = np.radians(50.0)
# Largest angle between the normals by three points and by all points of the floor.
_MAX_CORRECTION_RAD = np.radians(10.0)
# Distance of a point from its plane relative to the median distance from the cameras.
_THICKNESS = 0.02
# The floor is the lowest horizontal surface with this share of the points of the largest one, of
# which tables have many, too. Of all points, it must have the second share.
_MIN_SHARE_OF_LARGEST, _MIN_SHARE = 0.3, 0.03
# The standard deviation of a normal distribution by its median absolute deviation.
_SIGMA_OF_MAD = 1.4826


@dataclass(frozen=True)
class FloorHeight:
    """Height of the camera above the floor in the unit of the poses.

    Attributes:
        height: mean over the poses.
        sigma: relative standard deviation by the distances of points from the plane.
    """

    height: float
    sigma: float


def height_above_floor(
    points_world: Array,
    T_world_camera: Array,
    rng: np.random.Generator,
    side: ImageSide = "top",
) -> FloorHeight | None:
    """Find the floor and the mean height of the cameras above it.

    Horizontal is the plane with most points whose normal is at most 50 degrees from the upward
    direction of the images and which is below the cameras. The floor is the lowest parallel plane
    with at least 30 % as many points.

    Args:
        points_world: [N, 3].
        T_world_camera: poses [M, 4, 4] of the cameras.
        rng: for the choice of samples.
        side: the side of their images that is up on average.

    Returns:
        None if there is no such plane.
    """
    if len(points_world) < 3 or len(T_world_camera) == 0:
        return None
    centres = T_world_camera[:, :3, 3]
    upward = mean_up(T_world_camera, side)
    distance = float(np.median(np.linalg.norm(points_world - centres.mean(0), axis=1)))
    thickness = _THICKNESS * distance
    normal = _common_normal(points_world, centres, upward, thickness, rng)
    if normal is None:
        return None
    heights = np.sort(points_world @ normal)
    heights = heights[heights < np.median(centres @ normal) - thickness]
    # Points within the thickness above each point: the density along the normal.
    counts = np.searchsorted(heights, heights + 2 * thickness) - np.arange(len(heights))
    if len(counts) == 0 or counts.max() < _MIN_SHARE * len(points_world):
        return None
    enough = counts >= max(_MIN_SHARE_OF_LARGEST * counts.max(), _MIN_SHARE * len(points_world))
    first = int(np.argmax(enough))
    # The densest place of the lowest surface, whose lower edge is found first.
    near = heights <= heights[first] + 2 * thickness
    level = heights[int(np.argmax(np.where(near, counts, 0)))] + thickness
    floor = points_world[np.abs(points_world @ normal - level) <= thickness]
    centre, fitted = _fitted(floor, normal)
    if fitted @ normal < np.cos(_MAX_CORRECTION_RAD):
        return None  # the points are a strip of a wall
    above = (centres - centre) @ fitted
    mean = float(above.mean())
    if mean <= thickness:
        return None
    residual = (floor - centre) @ fitted
    spread = _SIGMA_OF_MAD * float(np.median(np.abs(residual - np.median(residual))))
    return FloorHeight(mean, spread / mean)


def _common_normal(
    points: Array, centres: Array, upward: Array, thickness: float, rng: np.random.Generator
) -> Array | None:
    """Upward normal of the horizontal plane with most points, by random samples."""
    upward = upward / max(float(np.linalg.norm(upward)), 1e-12)
    best, most = None, 0
    for _ in range(_SAMPLES):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-12:
            continue
        normal *= np.sign(normal @ upward) / length
        if normal @ upward < np.cos(_MAX_TILT_RAD) or np.median((centres - a) @ normal) <= 0:
            continue
        count = int((np.abs((points - a) @ normal) < thickness).sum())
        if count > most:
            best, most = normal, count
    return best


def _fitted(points: Array, normal: Array) -> tuple[Array, Array]:
    """A point and the normal of the plane with least squares, on the side of `normal`."""
    centre = points.mean(0)
    fitted = np.linalg.svd(points - centre, full_matrices=False)[2][-1]
    return centre, fitted * np.sign(fitted @ normal)
