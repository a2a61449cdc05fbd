"""Places that a monocular sequence shows again: pairs of keyframes, verified by their keypoints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.visual_odometry.landmarks import OdometryView
from toolkit.depth.monocular.visual_odometry.sparse_map import MAX_ERROR_PX
from toolkit.depth.monocular.visual_odometry.two_view import depth_equations, parallax_rad, rays
from toolkit.semantics.features.keypoints import (
    Keypoints,
    detect_keypoints,
    match_keypoints,
    similarity_votes,
)

Array = NDArray[np.float64]
Matches = NDArray[np.int64]

_KEYPOINTS = 600
_RATIO = 0.8
# Views on each side with which keypoints are triangulated; views farther apart may be revisits.
NEAR = 3
_MIN_PARALLAX_RAD = np.radians(0.7)
_MAX_TRIANGULATION_PX = 2.0
# Earlier views, the most similar ones, that a view is compared with, and their minimum votes.
_CANDIDATES = 6
_MIN_VOTES = 8
# Matches that a pose must explain, also relative to those with a depth.
_MIN_INLIERS = 20
_MIN_INLIER_FRACTION = 0.4
# Matches with a depth in both views, which give the scale.
_MIN_DEPTH_PAIRS = 8
_RANSAC_ITERATIONS = 200


@dataclass(frozen=True, eq=False)
class Revisit:
    """Two views of one place.

    Attributes:
        first, second: numbers of the views, ascending.
        T_second_first: [4, 4] in the unit of the first view.
        scale: units of the second view per unit of the first.
        log_scale_sigma: standard deviation of its logarithm.
        matches: [M, 2] indices of their keypoints.
    """

    first: int
    second: int
    T_second_first: Array
    scale: float
    log_scale_sigma: float
    matches: Matches


@dataclass(frozen=True, eq=False)
class ViewKeypoints:
    """Keypoints of all views.

    Attributes:
        views: keypoints of each view.
        inverse_depth: [N] of each view's keypoints, 0 where unknown.
        neighbours: matches of views at most NEAR apart, by their numbers.
    """

    views: list[Keypoints]
    inverse_depth: list[Array]
    neighbours: dict[tuple[int, int], Matches]


def find_keypoints(
    camera: Camera,
    views: Sequence[OdometryView],
    image: Callable[[int], NDArray[np.uint8]],
    detected: dict[int, Keypoints] | None = None,
) -> ViewKeypoints:
    """Find keypoints in all views, and triangulate them with the views around.

    Args:
        image: returns the grey image [H, W] of a frame.
        detected: keypoints of frames by number; those of further frames are added.
    """
    detected = {} if detected is None else detected
    for view in views:
        if view.frame not in detected:
            detected[view.frame] = detect_keypoints(image(view.frame), _KEYPOINTS)
    found = [detected[view.frame] for view in views]
    neighbours = {
        (first, second): match_keypoints(found[first], found[second], _RATIO)
        for first in range(len(views))
        for second in range(first + 1, min(first + NEAR + 1, len(views)))
    }
    return triangulated(camera, views, found, neighbours)


def triangulated(
    camera: Camera,
    views: Sequence[OdometryView],
    keypoints: list[Keypoints],
    neighbours: dict[tuple[int, int], Matches],
) -> ViewKeypoints:
    """Triangulate the keypoints of all views from the present poses, with the views around."""
    lines = [_Lines(len(view)) for view in keypoints]
    for (first, second), matches in neighbours.items():
        for a, b, pairs in ((first, second, matches), (second, first, matches[:, ::-1])):
            T = se3.inverse(views[b].T_world_camera) @ views[a].T_world_camera
            rows, others = pairs.T
            lines[a].add(camera, T, rows, keypoints[a].px[rows], keypoints[b].px[others])
    return ViewKeypoints(keypoints, [line.inverse_depth() for line in lines], neighbours)


class _Lines:
    """Inverse depths of a view's keypoints by least squares over other views."""

    def __init__(self, count: int) -> None:
        self._numerator, self._denominator = np.zeros(count), np.zeros(count)
        self._parallax_rad = np.zeros(count)

    def add(
        self, camera: Camera, T_other_own: Array, rows: Matches, px: Array, other_px: Array
    ) -> None:
        """Add matches [M] with another view."""
        turned = rays(camera, px) @ T_other_own[:3, :3].T
        t = T_other_own[:3, 3]
        numerator, denominator = depth_equations(turned, t, rays(camera, other_px))
        points = turned + (numerator / np.maximum(denominator, 1e-18))[:, None] * t
        good = (numerator > 0) & (reprojection_px(camera, points, other_px) < _MAX_TRIANGULATION_PX)
        self._numerator[rows[good]] += numerator[good]
        self._denominator[rows[good]] += denominator[good]
        parallax = parallax_rad(camera, T_other_own[:3, :3], px, other_px)
        np.maximum.at(self._parallax_rad, rows[good], parallax[good])

    def inverse_depth(self) -> Array:
        """[N], 0 where there is not enough parallax."""
        known = self._parallax_rad > _MIN_PARALLAX_RAD
        return np.where(known, self._numerator / np.maximum(self._denominator, 1e-18), 0.0)


def reprojection_px(camera: Camera, points: Array, px: Array) -> Array:
    """Distances [N] of projections from pixels; infinite behind the camera."""
    ahead = points[:, 2] > 0
    projected = camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0]))
    return np.where(ahead, np.linalg.norm(projected - px, axis=1), np.inf)


def find_revisits(camera: Camera, keypoints: ViewKeypoints) -> list[Revisit]:
    """Find pairs of views, more than NEAR apart, that show the same place."""
    votes = similarity_votes(keypoints.views)
    revisits = []
    for second in range(NEAR + 1, len(votes)):
        for first in best_candidates(votes[second, : second - NEAR]):
            found = verified(camera, keypoints, first, second)
            if found is not None:
                revisits.append(found)
    return revisits


def best_candidates(votes: NDArray[np.int64]) -> list[int]:
    """The views with the most votes [N], best first."""
    order = np.argsort(-votes, kind="stable")[:_CANDIDATES]
    return [int(number) for number in order[votes[order] >= _MIN_VOTES]]


def verified(camera: Camera, keypoints: ViewKeypoints, first: int, second: int) -> Revisit | None:
    """The similarity of two views if the keypoints of one fit the other."""
    before, after = keypoints.views[first], keypoints.views[second]
    matches = match_keypoints(before, after, _RATIO)
    depth_known = keypoints.inverse_depth[first][matches[:, 0]] > 0
    matches = matches[depth_known]
    if len(matches) < _MIN_INLIERS:
        return None
    points = keypoint_points(camera, keypoints, first, matches[:, 0])
    px = after.px[matches[:, 1]]
    found = _pose(camera, points, px)
    if found is None:
        return None
    good = reprojection_px(camera, se3.transform_points(found, points), px) < MAX_ERROR_PX
    if good.sum() < max(_MIN_INLIERS, _MIN_INLIER_FRACTION * len(matches)):
        return None
    depth = se3.transform_points(found, points[good])[:, 2]
    own = keypoints.inverse_depth[second][matches[good, 1]]
    both = own > 0
    if both.sum() < _MIN_DEPTH_PAIRS:
        return None
    log_scale = -np.log(own[both] * depth[both])
    middle = float(np.median(log_scale))
    deviation = 1.4826 * float(np.median(np.abs(log_scale - middle)))
    sigma = deviation / np.sqrt(both.sum())
    return Revisit(first, second, found, float(np.exp(middle)), float(sigma), matches[good])


def keypoint_points(camera: Camera, keypoints: ViewKeypoints, view: int, rows: Matches) -> Array:
    """Points [M, 3] of some keypoints with known depth in the coordinates of their view."""
    inverse_depth = keypoints.inverse_depth[view][rows]
    return np.asarray(rays(camera, keypoints.views[view].px[rows]) / inverse_depth[:, None])


def _pose(camera: Camera, points: Array, px: Array) -> Array | None:
    """T_camera_points [4, 4] by RANSAC."""
    K = camera.matrix
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        px,
        K,
        None,
        iterationsCount=_RANSAC_ITERATIONS,
        reprojectionError=MAX_ERROR_PX,
        confidence=0.999,
    )
    if not ok or inliers is None or len(inliers) < _MIN_INLIERS:
        return None
    good = inliers.ravel()
    rotation, translation = cv2.solvePnPRefineLM(
        points[good], px[good], K, None, rotation, translation
    )
    R, _ = cv2.Rodrigues(rotation)
    return se3.from_rotation_translation(R, translation.ravel())
