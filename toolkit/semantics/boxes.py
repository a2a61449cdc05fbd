"""Boxes around points, upright where the map tells what is up, and the ground they stand on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.open3d_bridge import open3d

Array = NDArray[np.float64]

# Edge of the cells that areas are counted in: above the spacing of Gaussians, or surfaces
# would have holes.
_CELL_M = 0.05
_FIT_ROUNDS = 20
# Points within 2 cm of a plane belong to it, however well the others fit.
_PLANE_M = 0.02
# What is narrower than this, or thicker than a fifth of it, tells no direction.
_LEAST_SPREAD_M = 0.1
_MOST_THICKNESS = 0.2


@dataclass(frozen=True)
class OrientedBox:
    """A box in the map's frame.

    Attributes:
        centre_m: [3].
        axes: [3, 3], its axes as columns, right-handed; the third is up if it is upright.
        size_m: [3], lengths along the axes; the first is not shorter than the second.
        upright: whether it stands on the ground's plane.
    """

    centre_m: Array
    axes: Array
    size_m: Array
    upright: bool


@dataclass(frozen=True)
class Ground:
    """The plane of the floor.

    Attributes:
        up: [3], unit vector.
        height_m: of the plane along `up`.
    """

    up: Array
    height_m: float

    @property
    def axes(self) -> Array:
        """A right-handed frame [3, 3] as columns, the third of them up."""
        # The axis of the map that is most level comes first, so that the frame is no
        # more turned than the ground is.
        start = np.eye(3)[np.abs(self.up).argmin()]
        first = start - self.up * (start @ self.up)
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.up, first), self.up], axis=1)

    @classmethod
    def below(cls, floor_m: Array, others_m: Array) -> Ground | None:
        """The plane of points [N, 3] that lie on the floor; up is where others are.

        None where the points do not spread along a plane.
        """
        plane = _fit_plane(floor_m)
        if plane is None:
            return None
        centre, normal = plane
        up = normal if (others_m - centre).mean(axis=0) @ normal > 0 else -normal
        return cls(up, float(centre @ up))


def oriented_box(points_m: Array, ground: Ground | None) -> OrientedBox:
    """The smallest box around points [N, 3], N >= 1, that stands on the ground if there is one.

    Standing boxes have the smallest area of floor, free ones (Open3D) the smallest volume.
    """
    if ground is None:
        axes = _free_axes(points_m)
        return _box(points_m, axes, upright=False)
    level = ground.axes
    (_, _, angle_deg) = cv2.minAreaRect((points_m @ level[:, :2]).astype(np.float32))
    angle = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    axes = np.column_stack([level[:, :2] @ turn, ground.up])
    return _box(points_m, axes, upright=True)


def floor_area_m2(points_m: Array, ground: Ground) -> float:
    """Area in square metres that points [N, 3] on surfaces cover, seen from above.

    Counted in cells of 5 cm, between the middles of those on the border: what is thinner
    than a cell, as a wall is from above, covers nothing.
    """
    cells = np.floor(points_m @ ground.axes[:, :2] / _CELL_M).astype(np.int64)
    # Two free cells all around, since closing does not shrink at the border.
    cells -= cells.min(axis=0) - 2
    image = np.zeros(cells.max(axis=0) + 3, np.uint8)
    image[cells[:, 0], cells[:, 1]] = 1
    # Holes of one cell are gaps between Gaussians.
    image = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    contours, hierarchy = cv2.findContours(image, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    area = 0.0
    for contour, (_, _, _, parent) in zip(contours, hierarchy[0], strict=True):
        area += cv2.contourArea(contour) * (1.0 if parent < 0 else -1.0)
    return area * _CELL_M**2


def _fit_plane(points_m: Array) -> tuple[Array, Array] | None:
    """Centre and unit normal of the plane that most of the points lie on, if they do."""
    kept = points_m
    for _ in range(_FIT_ROUNDS):
        if len(kept) < 3:
            return None
        centre = kept.mean(axis=0)
        variances, directions = np.linalg.eigh(np.cov((kept - centre).T))
        normal = directions[:, 0]
        distance_m = np.abs((points_m - centre) @ normal)
        # 2.5 standard deviations, by the median so that strays do not count.
        inside = distance_m <= max(2.5 * 1.4826 * float(np.median(distance_m)), _PLANE_M)
        if inside.sum() == len(kept) and (points_m[inside] == kept).all():
            break
        kept = points_m[inside]
    thickness_m, spread_m, _ = np.sqrt(np.maximum(variances, 0.0))
    if spread_m < _LEAST_SPREAD_M or thickness_m > _MOST_THICKNESS * spread_m:
        return None
    return centre, normal


def _free_axes(points_m: Array) -> Array:
    """Axes [3, 3] as columns of the smallest box, by Open3D; of flat sets by their spread."""
    o3d = open3d()
    try:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
        return np.array(cloud.get_minimal_oriented_bounding_box().R)
    except RuntimeError:  # points on a plane or a line have no hull
        return np.linalg.svd(points_m - points_m.mean(axis=0))[2].T


def _box(points_m: Array, axes: Array, upright: bool) -> OrientedBox:
    """The box around points along axes, these in the order and sense that is promised."""
    along = points_m @ axes
    size_m = np.ptp(along, axis=0)
    order = [0, 1, 2]
    free = 2 if upright else 3
    order[:free] = sorted(range(free), key=lambda i: -size_m[i])
    ordered = axes[:, order]
    lead = ordered[:, 0]
    if lead[np.abs(lead).argmax()] < 0:
        ordered[:, 0] = -lead
    # Right-handed, whatever the order and senses were.
    ordered[:, 1] = np.cross(ordered[:, 2], ordered[:, 0])
    centre_m = axes @ ((along.max(axis=0) + along.min(axis=0)) / 2)
    return OrientedBox(centre_m, ordered, size_m[order], upright)
