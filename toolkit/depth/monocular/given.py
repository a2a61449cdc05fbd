"""The motion of a camera whose poses are given, as the depth of its keyframes is estimated from it.

Features of frames with similar views are triangulated with the given poses. They give the range of
depths of each keyframe, and show whether the poses agree with the images at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.thinning import thinned
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.pose_convention import (
    OURS,
    PoseConvention,
    all_conventions,
    motions,
)
from toolkit.depth.monocular.motion import CameraMotion, MetricScale, grey_image, swept_keyframe
from toolkit.depth.monocular.visual_odometry.two_view import rays, triangulate
from toolkit.semantics.features.keypoints import Keypoints, detect_keypoints, match_keypoints

Array = NDArray[np.float64]

# Maximum number of keyframes, their keypoints, and the frames that each is matched with.
_MAX_KEYFRAMES, _KEYPOINTS, _PARTNERS = 150, 800, 4
_RATIO = 0.8
# Largest angle between the directions of view of frames that are matched, radians.
_MAX_TURN_RAD = 0.8
# A match agrees with the poses if its point is projected this near, in pixels of a width of 640.
_MAX_ERROR_PX = 3.0
# Smallest angle between the rays of a point whose depth counts, radians.
_MIN_PARALLAX_RAD = 0.01
# Share of the matches that agree with right poses; wrong ones reach 0.05 to 0.3, since each point
# on an epipolar line agrees.
_MIN_AGREEMENT, _CLEARLY_BETTER = 0.4, 1.5
_MIN_MATCHES = 50


def motion_of_given_poses(
    frames: Iterable[Frame],
    camera: Camera,
    given: Trajectory,
    metric: bool,
) -> CameraMotion:
    """Describe the motion of given poses, with keyframes whose depth can be estimated.

    Args:
        frames: all frames of the sequence; only their images are used.
        camera: their intrinsics.
        given: poses in metres; frames without a pose are lost.
        metric: whether the unit of the poses is the metre.

    Raises:
        DatasetError: fewer than three frames have a pose that agrees with others, or the poses
            contradict the images.
    """
    indices: list[int] = []
    times_s: list[float] = []
    poses: list[Array] = []
    greys: dict[int, NDArray[np.uint8]] = {}
    count = 0
    kept = _kept_frames(given)
    for frame in frames:
        count += 1
        T_world_camera = given.at(frame.timestamp_s)
        if T_world_camera is None:
            continue
        if len(indices) in kept:
            greys[len(indices)] = grey_image(frame)
        indices.append(frame.index)
        times_s.append(frame.timestamp_s)
        poses.append(T_world_camera)
    keyframes = _Keyframes.of(greys, np.array(poses).reshape(-1, 4, 4))
    pairs = list(keyframes.matched())
    agreement = _agreement(camera, pairs, OURS)
    _check(camera, pairs, agreement)
    views = []
    for number in sorted(greys):
        points = [p.known_points(camera) for p in pairs if p.first == number]
        points += [p.swapped().known_points(camera) for p in pairs if p.second == number]
        known = np.concatenate([np.zeros((0, 3)), *points])
        view = swept_keyframe(indices[number], poses[number], known)
        if view is not None:
            views.append(view)
    if len(views) < 3:
        raise DatasetError(
            f"depth cannot be estimated with the given poses: only {len(views)} frames have "
            "neighbours from another place that show the same points"
        )
    centres = np.array(poses)[:, :3, 3]
    median = float(np.median([np.sqrt(view.near * view.far) for view in views]))
    return CameraMotion(
        Trajectory(np.array(times_s), np.array(poses)),
        camera,
        views,
        count,
        extent=float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean())) / median,
        scale_sigma=0.0,
        metric_scale=MetricScale(1.0, 0.0, "the given poses") if metric else None,
        without_pose={"no pose is given": count - len(indices)} if count > len(indices) else {},
    )


def _kept_frames(given: Trajectory) -> set[int]:
    """Numbers of the poses whose frames become keyframes."""
    count = min(len(given), _MAX_KEYFRAMES)
    return set(np.linspace(0, len(given) - 1, count).round().astype(int).tolist())


@dataclass(frozen=True, eq=False)
class _Pair:
    """Matched keypoints of two frames.

    Attributes:
        first, second: numbers of their poses.
        first_px, second_px: [M, 2].
        T_first, T_second: given poses [4, 4].
    """

    first: int
    second: int
    first_px: Array
    second_px: Array
    T_first: Array
    T_second: Array

    def swapped(self) -> _Pair:
        return _Pair(
            self.second, self.first, self.second_px, self.first_px, self.T_second, self.T_first
        )

    def known_points(self, camera: Camera) -> Array:
        """Pixels and depths [N, 3] in the first frame of points with parallax.

        They agree with the poses.
        """
        T_second_first = se3.inverse(self.T_second) @ self.T_first
        inverse, good = _triangulated(camera, self, T_second_first)
        good &= inverse > 0
        directions = rays(camera, self.first_px)
        points = directions / np.where(good, inverse, 1.0)[:, None]
        baseline = se3.inverse(T_second_first)[:3, 3]
        to_second = points - baseline
        cosine = (points * to_second).sum(1) / np.maximum(
            np.linalg.norm(points, axis=1) * np.linalg.norm(to_second, axis=1), 1e-12
        )
        good &= np.arccos(np.clip(cosine, -1.0, 1.0)) > _MIN_PARALLAX_RAD
        return np.column_stack([self.first_px[good], 1.0 / inverse[good]])


def _triangulated(
    camera: Camera, pair: _Pair, T_second_first: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Inverse depths [M] in the first frame, and which are projected onto their matches."""
    inverse = triangulate(camera, T_second_first, pair.first_px, pair.second_px)
    # Points of directions alone are infinitely far.
    clamped = np.maximum(inverse, 0.0)
    moved = rays(camera, pair.first_px) @ T_second_first[:3, :3].T
    moved = moved + clamped[:, None] * T_second_first[:3, 3]
    ahead = moved[:, 2] > 1e-9
    projected = camera.project(np.where(ahead[:, None], moved, [0.0, 0.0, 1.0]))
    error_px = np.linalg.norm(projected - pair.second_px, axis=1)
    good = ahead & (error_px < _MAX_ERROR_PX * camera.width / 640.0)
    return inverse, good


@dataclass(frozen=True, eq=False)
class _Keyframes:
    """Keypoints and poses of keyframes by number."""

    keypoints: dict[int, Keypoints]
    poses: Array

    @classmethod
    def of(cls, greys: dict[int, NDArray[np.uint8]], poses: Array) -> _Keyframes:
        found = {number: detect_keypoints(grey, _KEYPOINTS) for number, grey in greys.items()}
        return cls(found, poses)

    def matched(self) -> Iterator[_Pair]:
        """Pairs of frames with similar views. Neighbours in time count, whatever their poses."""
        numbers = sorted(self.keypoints)
        done = set()
        for place, number in enumerate(numbers):
            partners = {*numbers[place + 1 : place + 3], *self._similar(number, numbers)}
            for other in sorted(partners - {number}):
                pair = (min(number, other), max(number, other))
                if pair in done:
                    continue
                done.add(pair)
                a, b = (self.keypoints[n] for n in pair)
                matches = match_keypoints(a, b, _RATIO)
                if len(matches):
                    T_first, T_second = (self.poses[n] for n in pair)
                    yield _Pair(*pair, a.px[matches[:, 0]], b.px[matches[:, 1]], T_first, T_second)

    def _similar(self, number: int, numbers: Sequence[int]) -> list[int]:
        """The nearest frames that look in a similar direction."""
        here, others = self.poses[number], self.poses[np.array(numbers)]
        cosine = others[:, :3, 2] @ here[:3, 2]
        distance = np.linalg.norm(others[:, :3, 3] - here[:3, 3], axis=1)
        order = [numbers[k] for k in np.argsort(distance) if cosine[k] > np.cos(_MAX_TURN_RAD)]
        return [n for n in order if n != number][:_PARTNERS]


def _agreement(camera: Camera, pairs: Sequence[_Pair], convention: PoseConvention) -> float:
    """Share of the matches between neighbours that agree with the poses by a convention."""
    agrees = matches = 0
    for pair in pairs:
        (T_second_first,) = motions([convention], pair.T_first, pair.T_second)
        agrees += int(_triangulated(camera, pair, T_second_first)[1].sum())
        matches += len(pair.first_px)
    return agrees / max(matches, 1)


def _check(camera: Camera, pairs: Sequence[_Pair], agreement: float) -> None:
    """Check that the poses agree with the images."""
    if agreement >= _MIN_AGREEMENT or sum(len(p.first_px) for p in pairs) < _MIN_MATCHES:
        return
    few = thinned(pairs, 20)
    scores = [(_agreement(camera, few, convention), convention) for convention in all_conventions()]
    best, convention = max(scores, key=lambda item: item[0])
    reason = "check that they belong to these images and are in their order"
    if best >= max(_MIN_AGREEMENT, _CLEARLY_BETTER * agreement):
        reason = f"they agree if {convention}; convert them"
    raise DatasetError(
        f"the given poses contradict the images ({agreement:.0%} of the matched points agree); "
        f"{reason}"
    )
