"""Initialisation of visual odometry: the first views with parallax, and their structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.bundle_adjustment.problem import BundleOptions, BundleResult
from toolkit.depth.monocular.bundle_adjustment.solver import adjust
from toolkit.depth.monocular.visual_odometry.landmarks import LandmarkTable, OdometryView, bundle
from toolkit.depth.monocular.visual_odometry.two_view import (
    fit_rotation,
    relative_motion,
    triangulate,
)
from toolkit.semantics.features.tracks import Features

Array = NDArray[np.float64]

# Median depth of the first views in the unit of length. Without another measurement, the scale of
# a monocular map is arbitrary; this one suits defaults in metres indoors.
MEDIAN_DEPTH = 2.0

_MIN_MATCHES = 40
# Median distance in pixels that a rotation leaves unexplained, relative to the image's width.
# Relative to the image motion it is no criterion: a camera that turns while it passes a wall leaves
# only 2 to 5 %, as does unmodelled distortion under pure rotation.
_MIN_UNEXPLAINED = 1.0 / 320.0
# Length of the motion relative to the median depth. Distortion makes a rotation look like one of up
# to 1 %, and below 3 % the direction can flip.
_MIN_BASELINE = 0.05
_MIN_INLIERS = 0.5
# Maximum cost of the motion relative to that of its mirror image.
_MAX_COST_RATIO = 0.8
_MAX_ERROR_PX = 1.5
# Views between the first and the newest one.
_BETWEEN = 3


@dataclass(frozen=True)
class Initialisation:
    """The first views and landmarks.

    Attributes:
        views: in order, the first at the identity; their median depth is MEDIAN_DEPTH.
        table: landmarks of all features so far.
    """

    views: list[OdometryView]
    table: LandmarkTable


@dataclass(frozen=True)
class Refusal:
    """Why two views are not enough yet."""

    reason: str


def initialise(camera: Camera, frames: Sequence[tuple[int, Features]]) -> Initialisation | Refusal:
    """Estimate motion and structure of the first frames.

    Args:
        frames: numbers and features of all frames since the first one, whose features are followed.
    """
    (_, first), (_, newest) = frames[0], frames[-1]
    first_px, newest_px = _matched(first, newest)
    if len(first_px) < _MIN_MATCHES:
        return Refusal("too few features are followed")
    R, unexplained_px = fit_rotation(camera, first_px, newest_px)
    if np.median(unexplained_px) < _MIN_UNEXPLAINED * camera.width:
        return Refusal("the camera has only turned")
    motion = relative_motion(camera, first_px, newest_px)
    if motion is None or motion.inlier.mean() < _MIN_INLIERS:
        return Refusal("the motion does not fit a rigid scene")
    chosen = _spread(frames)
    if len(chosen) < 3:
        return Refusal("a third view is needed")
    T = motion.T_second_first
    inverse_depth = triangulate(camera, T, first_px, newest_px)
    if np.median(inverse_depth[motion.inlier]) < _MIN_BASELINE:
        return Refusal("the camera has hardly moved")
    known = motion.inlier & (inverse_depth > 0)
    if known.sum() < _MIN_MATCHES:
        return Refusal("too few features have a depth")
    ids = np.intersect1d(first.ids, newest.ids)[known]
    found = _adjusted(camera, chosen, T, ids, inverse_depth[known])
    # With little parallax, structure turned inside out fits nearly as well (Necker reversal).
    mirrored = se3.from_rotation_translation(R @ R @ T[:3, :3].T, -T[:3, 3])
    reversed_depth = np.maximum(2 * np.median(inverse_depth[known]) - inverse_depth[known], 1e-3)
    other = _adjusted(camera, chosen, mirrored, ids, reversed_depth)
    if other.result.cost < found.result.cost:
        found, other = other, found
    if found.result.cost > _MAX_COST_RATIO * other.result.cost and not _same(found, other):
        return Refusal("the direction of motion is ambiguous")
    if np.median(found.result.error_px) > _MAX_ERROR_PX:
        return Refusal("three views do not agree")
    return _normalised(found)


@dataclass(frozen=True)
class _Candidate:
    views: list[OdometryView]
    table: LandmarkTable
    result: BundleResult
    landmarks: NDArray[np.int64]


def _matched(first: Features, second: Features) -> tuple[Array, Array]:
    _, in_first, in_second = np.intersect1d(first.ids, second.ids, return_indices=True)
    return first.px[in_first], second.px[in_second]


def _spread(frames: Sequence[tuple[int, Features]]) -> list[tuple[int, Features]]:
    """The first and the last frame, and some in between."""
    count = min(len(frames), _BETWEEN + 2)
    chosen = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))
    return [frames[n] for n in chosen]


def _adjusted(
    camera: Camera,
    frames: Sequence[tuple[int, Features]],
    T_newest_first: Array,
    ids: NDArray[np.int64],
    inverse_depth: Array,
) -> _Candidate:
    """Bundle adjustment from an initial motion, with the frames between on the way."""
    table = LandmarkTable()
    step = se3.log(se3.inverse(T_newest_first))
    views = []
    for number, (frame, features) in enumerate(frames):
        share = number / (len(frames) - 1)
        views.append(OdometryView(frame, se3.exp(share * step), features))
        table.add(number, features)
    table.inverse_depth[ids], table.measured[ids] = inverse_depth, True
    everything = range(len(views))
    # First the poses between alone, whose initial values are the worst.
    for free in (range(1, len(views) - 1), range(1, len(views))):
        problem, landmarks, _ = bundle(camera, table, views, everything, free)
        result = adjust(problem, BundleOptions(iterations=50))
        for view, T in zip(views, result.T_world_camera, strict=True):
            view.T_world_camera = T
        table.inverse_depth[landmarks] = result.inverse_depth
    return _Candidate(views, table, result, landmarks)


def _same(first: _Candidate, second: _Candidate) -> bool:
    """Whether both found the same motion."""
    a, b = (c.views[-1].T_world_camera for c in (first, second))
    turned = se3.rotation_angle_rad(a[:3, :3].T @ b[:3, :3])
    directions = [T[:3, 3] / np.linalg.norm(T[:3, 3]) for T in (a, b)]
    return bool(turned < np.radians(0.2) and directions[0] @ directions[1] > np.cos(np.radians(5)))


def _normalised(found: _Candidate) -> Initialisation:
    scale = MEDIAN_DEPTH * float(np.median(found.table.inverse_depth[found.landmarks]))
    for view in found.views:
        view.T_world_camera = view.T_world_camera.copy()
        view.T_world_camera[:3, 3] *= scale
    found.table.inverse_depth /= scale
    return Initialisation(found.views, found.table)
