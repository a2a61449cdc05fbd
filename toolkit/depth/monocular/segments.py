"""Visual odometry that starts again where it is lost for long, and the connection of its parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.revisits import (
    Revisit,
    ViewKeypoints,
    best_candidates,
    find_keypoints,
    verified,
)
from toolkit.depth.monocular.visual_odometry.landmarks import OdometryView
from toolkit.depth.monocular.visual_odometry.odometry import (
    OdometryOptions,
    OdometryResult,
    State,
    VisualOdometry,
)
from toolkit.depth.monocular.visual_odometry.sparse_map import SparseMap
from toolkit.semantics.features.keypoints import Keypoints, similarity_votes

Array = NDArray[np.float64]
GreyImage = Callable[[int], NDArray[np.uint8]]

# Lost frames after which another segment is started beside the lost one.
_LOST_FRAMES = 3
_MIN_VIEWS = 3
# Revisits that must agree on the relation of two segments: within these differences of positions,
# relative to the depth of the scene, and of scale.
_MIN_AGREEING = 3
_SAME_PLACE, _SAME_SCALE = 0.15, 0.15


class SegmentedOdometry:
    """Follows a camera; where it is lost for long, another segment begins.

    While nothing is known about the new segment, the lost one may continue.
    """

    def __init__(self, camera: Camera, options: OdometryOptions | None = None) -> None:
        self._camera, self._options = camera, options
        self._finished: list[SparseMap] = []
        self._current = VisualOdometry(camera, options)
        self._next: VisualOdometry | None = None
        self._frame, self._lost = -1, 0

    @property
    def maps(self) -> list[SparseMap]:
        """The segments in order; the first one if none has views."""
        found = [m for m in (*self._finished, self._current.map) if len(m.views) >= _MIN_VIEWS]
        return found or [self._current.map]

    def process(self, image: NDArray[np.uint8]) -> OdometryResult:
        """Estimate the pose of the next image [H, W] within its segment."""
        self._frame += 1
        result = self._current.process(image)
        if result.state is not State.LOST:
            self._lost, self._next = 0, None
            return result
        self._lost += 1
        if self._lost < _LOST_FRAMES:
            return result
        if self._next is None:
            self._next = VisualOdometry(self._camera, self._options, self._frame)
        begun = self._next.process(image)
        if begun.state is not State.TRACKING:
            return result
        self._finished.append(self._current.map)
        self._current, self._next, self._lost = self._next, None, 0
        return begun


def largest(maps: Sequence[SparseMap]) -> SparseMap:
    """The segment with the most frames."""
    return max(maps, key=len)


def connected(
    maps: Sequence[SparseMap], image: GreyImage, detected: dict[int, Keypoints] | None = None
) -> list[SparseMap]:
    """Join the segments that show the same places, the largest one with its own first.

    Args:
        maps: segments in order; those that are joined are moved into the largest one's frame.
        image: returns the grey image [H, W] of a frame.
        detected: as `find_keypoints` has it.

    Returns:
        Maps whose relative positions and scales are unknown.
    """
    joined, rest = [], list(maps)
    while rest:
        parts = _largest_connected(rest, image, detected)
        joined.append(SparseMap.joined([rest[n] for n in parts], rest[parts[0]].camera))
        rest = [segment for n, segment in enumerate(rest) if n not in parts]
    return joined


def _largest_connected(
    maps: list[SparseMap], image: GreyImage, detected: dict[int, Keypoints] | None
) -> list[int]:
    """Numbers of the largest segment and of those that show places of it, in order."""
    main = largest(maps)
    parts = {n for n, m in enumerate(maps) if m is main}
    if len(maps) == 1:
        return sorted(parts)
    keypoints = [find_keypoints(main.camera, m.views, image, detected) for m in maps]
    while True:
        rest = [n for n in range(len(maps)) if n not in parts]
        moved = [n for n in rest if _connect(maps, keypoints, sorted(parts), n)]
        if not moved:
            return sorted(parts)
        parts.update(moved)


@dataclass(frozen=True)
class _Similarity:
    """p_to = scale * R p_from + t."""

    T_to_from: Array
    scale: float

    def pose(self, T: Array) -> Array:
        """A pose [4, 4] in the other frame."""
        R, t = self.T_to_from[:3, :3], self.T_to_from[:3, 3]
        return se3.from_rotation_translation(R @ T[:3, :3], self.scale * R @ T[:3, 3] + t)


def _connect(
    maps: Sequence[SparseMap], keypoints: list[ViewKeypoints], parts: list[int], new: int
) -> bool:
    """Move a segment into the frame of the connected ones; False if they share no place."""
    views = [view for n in parts for view in maps[n].views]
    both = _stacked([*(keypoints[n] for n in parts), keypoints[new]])
    votes = similarity_votes(both.views)
    revisits = []
    for second in range(len(views), len(both.views)):
        for first in best_candidates(votes[second, : len(views)]):
            revisit = verified(maps[new].camera, both, first, second)
            if revisit is not None:
                revisits.append(revisit)
    own = maps[new].views
    candidates = [_similarity(revisit, views, own) for revisit in revisits]
    positions = [_moved(candidate, own) for candidate in candidates]
    inverse_depth = maps[parts[0]].table.inverse_depth[maps[parts[0]].table.measured]
    tolerance = _SAME_PLACE / float(np.median(inverse_depth))
    agreeing = [
        sum(
            np.median(np.linalg.norm(a - b, axis=1)) < tolerance
            and abs(np.log(own_scale.scale / other.scale)) < _SAME_SCALE
            for b, other in zip(positions, candidates, strict=True)
        )
        for a, own_scale in zip(positions, candidates, strict=True)
    ]
    if not agreeing or max(agreeing) < _MIN_AGREEING:
        return False
    best = candidates[int(np.argmax(agreeing))]
    poses = [best.pose(view.T_world_camera) for view in own]
    maps[new].transform(poses, np.full(len(own), best.scale))
    scaled = [depth / best.scale for depth in keypoints[new].inverse_depth]
    keypoints[new] = ViewKeypoints(keypoints[new].views, scaled, keypoints[new].neighbours)
    return True


def _stacked(parts: Sequence[ViewKeypoints]) -> ViewKeypoints:
    return ViewKeypoints(
        [view for part in parts for view in part.views],
        [depth for part in parts for depth in part.inverse_depth],
        {},
    )


def _similarity(
    revisit: Revisit, views: Sequence[OdometryView], own: Sequence[OdometryView]
) -> _Similarity:
    """From the frame of a segment to that of the connected ones."""
    T_world_first = views[revisit.first].T_world_camera
    T_own_second = own[revisit.second - len(views)].T_world_camera
    scale = 1.0 / revisit.scale
    T_second_own = se3.inverse(T_own_second)
    T_second_own[:3, 3] *= scale
    T = T_world_first @ se3.inverse(revisit.T_second_first) @ T_second_own
    return _Similarity(T, scale)


def _moved(similarity: _Similarity, views: Sequence[OdometryView]) -> Array:
    """Positions [V, 3] of views after a similarity."""
    return np.array([similarity.pose(view.T_world_camera)[:3, 3] for view in views])
