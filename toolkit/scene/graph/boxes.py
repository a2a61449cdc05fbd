"""Oriented bounding boxes, the ground plane, and floor areas."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.open3d_bridge import open3d

Array = NDArray[np.float64]

# Cell size of the floor area grid; larger than the spacing of Gaussians, to avoid holes.
_CELL_M = 0.05
_FIT_ROUNDS = 20
# Minimum inlier distance of the plane fit.
_PLANE_M = 0.02
# A plane fit is rejected below this spread, or above this ratio of thickness to spread.
_MIN_SPREAD_M = 0.1
_MAX_THICKNESS = 0.2


@dataclass(frozen=True)
class OrientedBox:
    """An oriented bounding box in the map frame.

    Attributes:
        centre_m: [3] centre in metres.
        axes: [3, 3] right-handed axes as columns; the third is up if the box is upright.
        size_m: [3] lengths along the axes in metres; the first is not shorter than the second.
        upright: whether the third axis is normal to the ground plane.
    """

    centre_m: Array
    axes: Array
    size_m: Array
    upright: bool

    def moved(self, T: Array) -> OrientedBox:
        """Return the box and its ground plane moved by a rigid motion [4, 4]."""
        centre_m = T[:3, :3] @ self.centre_m + T[:3, 3]
        return replace(self, centre_m=centre_m, axes=T[:3, :3] @ self.axes)

    def contains(self, point_m: Array, margin_m: float = 0.0) -> bool:
        """Whether a point [3] is inside, or outside by at most a margin along each axis."""
        along_m = (point_m - self.centre_m) @ self.axes
        return bool((np.abs(along_m) <= self.size_m / 2 + margin_m).all())


@dataclass(frozen=True)
class Ground:
    """The plane of the floor.

    Attributes:
        up: [3], unit vector.
        height_m: height of the plane along `up`, in metres.
    """

    up: Array
    height_m: float

    @cached_property
    def axes(self) -> Array:
        """Right-handed axes [3, 3] as columns; the third is up."""
        # Start from the most horizontal axis of the map, to rotate as little as possible.
        start = np.eye(3)[np.abs(self.up).argmin()]
        first = start - self.up * (start @ self.up)
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.up, first), self.up], axis=1)

    @classmethod
    def below(cls, floor_m: Array, others_m: Array) -> Ground | None:
        """Fit a plane to points [N, 3] of the floor; up points towards the other points.

        Returns None if the points do not form a plane.
        """
        plane = _fit_plane(floor_m)
        if plane is None:
            return None
        centre, normal = plane
        up = normal if (others_m - centre).mean(axis=0) @ normal > 0 else -normal
        return cls(up, float(centre @ up))


def oriented_box(points_m: Array, ground: Ground | None) -> OrientedBox:
    """Return the smallest bounding box of points [N, 3], N >= 1; upright if a ground is given.

    Upright boxes minimise the floor area, others the volume (Open3D).
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
    """Return the area in square metres of the vertical projection of points [N, 3].

    The area is computed on a grid of 5 cm, from the contours through the centres of the border
    cells. Structures thinner than a cell, such as walls, have no area.
    """
    cells = np.floor(points_m @ ground.axes[:, :2] / _CELL_M).astype(np.int64)
    # Pad by two cells: the closing is not symmetric at the image border.
    cells -= cells.min(axis=0) - 2
    image = np.zeros(cells.max(axis=0) + 3, np.uint8)
    image[cells[:, 0], cells[:, 1]] = 1
    # Close holes of one cell, which are gaps between Gaussians.
    image = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    contours, hierarchy = cv2.findContours(image, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    area = 0.0
    for contour, (_, _, _, parent) in zip(contours, hierarchy[0], strict=True):
        area += cv2.contourArea(contour) * (1.0 if parent < 0 else -1.0)
    return area * _CELL_M**2


def _fit_plane(points_m: Array) -> tuple[Array, Array] | None:
    """Fit a plane robustly; return centre and unit normal, or None if there is no clear plane."""
    kept = points_m
    for _ in range(_FIT_ROUNDS):
        if len(kept) < 3:
            return None
        centre = kept.mean(axis=0)
        variances, directions = np.linalg.eigh(np.cov((kept - centre).T))
        normal = directions[:, 0]
        distance_m = np.abs((points_m - centre) @ normal)
        # 2.5 standard deviations, estimated robustly from the median.
        inside = distance_m <= max(2.5 * 1.4826 * float(np.median(distance_m)), _PLANE_M)
        if inside.sum() == len(kept) and (points_m[inside] == kept).all():
            break
        kept = points_m[inside]
    thickness_m, spread_m, _ = np.sqrt(np.maximum(variances, 0.0))
    if spread_m < _MIN_SPREAD_M or thickness_m > _MAX_THICKNESS * spread_m:
        return None
    return centre, normal


def _free_axes(points_m: Array) -> Array:
    """Return the axes [3, 3] of the smallest box (Open3D); by PCA for planar points."""
    o3d = open3d()
    try:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
        return np.array(cloud.get_minimal_oriented_bounding_box().R)
    except RuntimeError:  # planar or collinear points have no convex hull
        return np.linalg.svd(points_m - points_m.mean(axis=0))[2].T


def _box(points_m: Array, axes: Array, upright: bool) -> OrientedBox:
    """Return the bounding box along some axes, with the axes sorted and signed consistently."""
    along = points_m @ axes
    size_m = np.ptp(along, axis=0)
    order = [0, 1, 2]
    free = 2 if upright else 3
    order[:free] = sorted(range(free), key=lambda i: -size_m[i])
    ordered = axes[:, order]
    lead = ordered[:, 0]
    if lead[np.abs(lead).argmax()] < 0:
        ordered[:, 0] = -lead
    # Make the axes right-handed.
    ordered[:, 1] = np.cross(ordered[:, 2], ordered[:, 0])
    centre_m = axes @ ((along.max(axis=0) + along.min(axis=0)) / 2)
    return OrientedBox(centre_m, ordered, size_m[order], upright)
