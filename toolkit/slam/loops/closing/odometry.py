"""The odometry between submaps: a chain of edges from each anchor to the next one.

A submap may start in an earlier one that the camera has entered again. Its edge then begins at the
newest submap all the same: it leads back to the earlier one first, with the drift of the way. So
the odometry remains a chain, against which `pose_graph.consistency` tests loops.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.graph import PoseEdge, covariance_in_frame, information_of
from toolkit.base.pose_graph.noise import OdometryNoise
from toolkit.slam.loops.closing.uncertainty import PathPose, measured_links
from toolkit.slam.loops.relocalisation import Relocalisation
from toolkit.slam.mapping.keyframes import view_motions
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.tracking.reach import Reach

Array = NDArray[np.float64]

# Standard deviations of an unknown pose, metres and radians, and of one within reach, as a fraction
# of that: the tests of loops allow 4.7.
_UNKNOWN_M, _UNKNOWN_RAD = 10.0, 3.0
_OF_REACH = 0.21
# Information between the submaps of a loaded map, whose relative poses are fixed.
_RIGID = np.eye(6) * 1e9


class SubmapOdometry:
    """Adds an edge for each submap that starts.

    Attributes:
        links: edges from each submap to the next one, by number.
        ended: numbers of the submaps that have been left at least once.
        ways_back: edges from the newest submap to those entered since it was left, by number.
        origins: number of the submap in which each submap started, by number.
        lost: numbers of those that started at a lost frame. Their links only bound their poses.
    """

    def __init__(self, noise: OdometryNoise) -> None:
        self.links: list[PoseEdge] = []
        self.ended: set[int] = set()
        self.ways_back: dict[int, PoseEdge] = {}
        self.origins: dict[int, int] = {}
        self.lost: set[int] = set()
        self._noise = noise

    @property
    def known(self) -> list[PoseEdge]:
        """The links but those that only bound an unknown pose."""
        return [link for link in self.links if link.second not in self.lost]

    def map_loaded(self, atlas: Atlas) -> None:
        """Link the submaps of a loaded map, which is treated as rigid."""
        for first, second in pairwise(range(atlas.saved)):
            self.links.append(PoseEdge(first, second, _between(atlas, first, second), _RIGID))

    def started(self, atlas: Atlas, where: int, information: Array) -> None:
        """Add the edge of the active submap, which is new.

        Args:
            where: number of the submap in which it started.
            information: [6, 6] of the boundary keyframe, from the tracker.
        """
        new = atlas.active
        boundary = next(iter(atlas.keyframe_poses(new)))
        path = self._path_in(atlas, where, atlas.keyframe_poses(where)[boundary])
        edge = self._noise.along(where, new, path, information)
        edge = replace(edge, T_first_second=_between(atlas, where, new))
        if where != new - 1:
            edge = self.ways_back[where].then(edge)
        self.ways_back, self.origins[new] = {}, where
        self.links.append(edge)

    def started_lost(self, atlas: Atlas, where: int | None, reach: Reach | None) -> None:
        """Add the edge of the active submap, which started at a lost frame.

        The odometry is interrupted, so the pose relative to the submap before is uncertain: as
        much as the camera can have moved meanwhile. A loop with a place farther away is one with
        another place that looks the same.

        Args:
            where: number of the submap in which the frame was relocalised, if it was.
            reach: where the camera may be in the world; None if that is unknown.
        """
        new = atlas.active
        self.ways_back = {}
        if where is not None:
            self.origins[new] = where
        T_world_camera = atlas.T_world_submap(new) if reach is None else reach.T_map_camera
        T = se3.orthonormalise(se3.inverse(atlas.T_world_submap(new - 1)) @ T_world_camera)
        metres, radians = _UNKNOWN_M, _UNKNOWN_RAD
        if reach is not None:
            metres = min(_OF_REACH * reach.metres, metres)
            radians = min(_OF_REACH * reach.radians, radians)
        information = np.diag([1.0 / metres**2] * 3 + [1.0 / radians**2] * 3)
        self.links.append(PoseEdge(new - 1, new, T, information))
        self.lost.add(new)

    def beside(self, number: int) -> set[int]:
        """The submap in which a submap started, and those that started in it."""
        started = {new for new, where in self.origins.items() if where == number}
        return started | {self.origins.get(number, number)} - {number}

    def entered(
        self, atlas: Atlas, left: int, T_left_camera: Array, found: Relocalisation
    ) -> PoseEdge:
        """Remember the way from the newest submap to the active one, if that is an earlier one.

        Args:
            left: number of the submap that was active before.
            T_left_camera: [4, 4] pose of a frame in it.
            found: the same frame in the active submap.

        Returns:
            The edge from the one to the other, with the drift within the former.
        """
        path = self._path_in(atlas, left, T_left_camera)
        drift = self._noise.along(left, atlas.active, path, found.result.information).covariance
        T_camera_active = se3.inverse(found.T_submap_camera)
        information = information_of(covariance_in_frame(drift, T_camera_active))
        T = se3.orthonormalise(T_left_camera @ T_camera_active)
        step = PoseEdge(left, atlas.active, T, information)
        newest = len(atlas) - 1
        # The first way to a submap is the shortest one.
        if atlas.active != newest and atlas.active not in self.ways_back:
            way = step if left == newest else self.ways_back[left].then(step)
            self.ways_back[atlas.active] = way
        return step

    def _path_in(self, atlas: Atlas, number: int, T_submap_camera: Array) -> list[Array]:
        """Keyframe poses from a submap's anchor to a camera, along which the map has drifted.

        In a submap that was left before, only the keyframes up to the nearest one count: the map
        was aligned there, and what came after it is of other visits.
        """
        poses = list(atlas.keyframe_poses(number).values())
        if number in self.ended:
            earlier = poses[:-1] or poses
            metres, radians = view_motions(earlier, T_submap_camera)
            poses = earlier[: int(np.argmin(metres + radians)) + 1]
        return poses if np.array_equal(poses[-1], T_submap_camera) else [*poses, T_submap_camera]

    def measured(self, path: Iterable[PathPose]) -> list[PoseEdge]:
        """The links with the covariances that tracking measured, where it did.

        Args:
            path: the frames, in order.
        """
        pairs = zip(self.links, measured_links(self.links, path, self._noise), strict=True)
        return [
            link
            if self.origins.get(link.second, link.first) != link.first  # with a way back
            or link.second in self.lost
            or np.array_equal(link.information, _RIGID)
            else measured
            for link, measured in pairs
        ]

    def values(self) -> dict[str, Any]:
        """JSON values for `restore`; the edges are stored by the caller."""
        return {
            "ended": sorted(self.ended),
            "origins": sorted(self.origins.items()),
            "lost": sorted(self.lost),
        }

    def restore(
        self, links: Sequence[PoseEdge], ways_back: Sequence[PoseEdge], values: Mapping[str, Any]
    ) -> None:
        """Restore an earlier state."""
        self.links, self.ways_back = list(links), {way.second: way for way in ways_back}
        self.origins = {int(new): int(where) for new, where in values["origins"]}
        self.lost = set(values["lost"])
        self.ended = set(values["ended"])


def _between(atlas: Atlas, first: int, second: int) -> Array:
    """Relative pose [4, 4] of two anchors."""
    T = se3.inverse(atlas.T_world_submap(first)) @ atlas.T_world_submap(second)
    return se3.orthonormalise(T)
