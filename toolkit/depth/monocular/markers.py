"""Side length of square markers, from the views of a moving camera."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.options import MarkerDictionary

Array = NDArray[np.float64]

_DICTIONARIES = {
    "apriltag-36h11": cv2.aruco.DICT_APRILTAG_36H11,
    "apriltag-25h9": cv2.aruco.DICT_APRILTAG_25H9,
    "apriltag-16h5": cv2.aruco.DICT_APRILTAG_16H5,
    "aruco-4x4": cv2.aruco.DICT_4X4_1000,
    "aruco-5x5": cv2.aruco.DICT_5X5_1000,
    "aruco-6x6": cv2.aruco.DICT_6X6_1000,
    "aruco-7x7": cv2.aruco.DICT_7X7_1000,
    "aruco-original": cv2.aruco.DICT_ARUCO_ORIGINAL,
}
# A marker is used if its corners fit all views within this, and its sides differ by no more.
_MAX_ERROR_PX = 3.0
_MAX_SIDE_DIFFERENCE = 0.2
_MIN_VIEWS = 2
# Smallest angle between the rays of the farthest views. Depth, thus size, is uncertain below.
_MIN_PARALLAX_RAD = np.radians(3.0)


@dataclass(frozen=True)
class MarkerView:
    """A marker in an image.

    Attributes:
        marker: its number in the dictionary.
        T_world_camera: pose of the camera [4, 4].
        corners_px: [4, 2] corners in the order of the marker's outline.
    """

    marker: int
    T_world_camera: Array
    corners_px: Array


@dataclass(frozen=True)
class SideLength:
    """Length of the sides of markers in the unit of the poses.

    Attributes:
        length: mean of the markers.
        sigma: relative standard deviation of it.
        markers: number of markers that it is the mean of.
    """

    length: float
    sigma: float
    markers: int


def detect_markers(
    rgb: NDArray[np.float32], T_world_camera: Array, dictionary: MarkerDictionary
) -> list[MarkerView]:
    """Detect the markers in an image [H, W, 3] with values in [0, 1]."""
    parameters = cv2.aruco.DetectorParameters()
    # On drawn markers of 20 to 75 pixels, this method's sides are right to 0.2 %; those of the
    # others are 0.3 to 3 % too short.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    known = cv2.aruco.getPredefinedDictionary(_DICTIONARIES[dictionary])
    detector = cv2.aruco.ArucoDetector(known, parameters)
    grey = cv2.cvtColor(np.round(255.0 * rgb).astype(np.uint8), cv2.COLOR_RGB2GRAY)
    corners, numbers, _ = detector.detectMarkers(grey)
    if numbers is None:
        return []
    return [
        # The method has the centre of the first pixel at 0.5.
        MarkerView(int(number), T_world_camera, corner.reshape(4, 2).astype(np.float64) - 0.5)
        for number, corner in zip(np.ravel(numbers), corners, strict=True)
    ]


def side_length(views: Iterable[MarkerView], camera: Camera) -> SideLength | None:
    """Estimate the length of the sides of all markers, which must have one size.

    The corners of each marker are triangulated from all of its views.

    Returns:
        None if no marker was seen from two places with enough parallax, or none consistently: two
        markers with the same number, or a marker that moved.
    """
    by_marker: dict[int, list[MarkerView]] = defaultdict(list)
    for view in views:
        by_marker[view.marker].append(view)
    found = [sides for seen in by_marker.values() if (sides := _sides(seen, camera)) is not None]
    if not found:
        return None
    lengths = np.array([sides.mean() for sides in found])
    within = [float(sides.std()) / float(sides.mean()) / np.sqrt(len(sides)) for sides in found]
    sigma = float(np.sqrt(np.mean(np.square(within)) / len(found)))
    if len(found) > 1:
        sigma = max(sigma, float(lengths.std(ddof=1) / lengths.mean() / np.sqrt(len(found))))
    return SideLength(float(lengths.mean()), sigma, len(found))


def _sides(views: list[MarkerView], camera: Camera) -> Array | None:
    """The four sides of a marker; None if its views do not determine them."""
    if len(views) < _MIN_VIEWS:
        return None
    T_camera_world = np.array([se3.inverse(view.T_world_camera) for view in views])
    px = np.array([view.corners_px for view in views])
    points = np.array([_triangulated(T_camera_world, px[:, n], camera) for n in range(4)])
    seen = np.einsum("vij,cj->vci", T_camera_world[:, :3, :3], points)
    seen += T_camera_world[:, None, :3, 3]
    if not np.isfinite(points).all() or (seen[..., 2] <= 0).any():
        return None
    if np.linalg.norm(camera.project(seen) - px, axis=-1).max() > _MAX_ERROR_PX:
        return None
    rays = points.mean(0) - np.array([view.T_world_camera[:3, 3] for view in views])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if np.arccos(np.clip(rays @ rays.T, -1.0, 1.0)).max() < _MIN_PARALLAX_RAD:
        return None
    sides = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    return sides if np.ptp(sides) < _MAX_SIDE_DIFFERENCE * sides.mean() else None


def _triangulated(T_camera_world: Array, px: Array, camera: Camera) -> Array:
    """The point whose projections [V, 2] minimise the algebraic error; infinite if degenerate."""
    x = (px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rows = x[..., None] * T_camera_world[:, None, 2] - T_camera_world[:, :2]
    homogeneous = np.linalg.svd(rows.reshape(-1, 4))[2][-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(homogeneous[:3] / homogeneous[3])
