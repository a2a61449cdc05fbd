"""Interface between the SLAM system and loop closure, which closes no loops by default."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.keyframe import Keyframe
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.slam.loops.closing.uncertainty import PathPose
from toolkit.slam.loops.relocalisation import Relocalisation, Relocaliser
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.tracking.reach import Reach

Array = NDArray[np.float64]


class LoopClosing:
    """Receives the events of a run, in chronological order.

    These methods neither close loops nor relocalise frames.
    """

    @property
    def loops(self) -> Sequence[PoseEdge]:
        """The accepted loop edges between submaps."""
        return ()

    @property
    def relocaliser(self) -> Relocaliser | None:
        """Relocalises lost frames; None without relocalisation."""
        return None

    def similar_keyframes(self, atlas: Atlas, view: Keyframe) -> list[Keyframe]:
        """Keyframes of the active submap that look most similar to a view, most similar first."""
        return []

    def map_loaded(self, atlas: Atlas) -> None:
        """The atlas has loaded the map of an earlier run."""

    def defer(self) -> None:
        """Close loops between submaps in `finish` only, because registration takes long."""

    def keyframe_added(self, atlas: Atlas) -> None:
        """The active submap has a new keyframe."""

    def submap_ending(self, atlas: Atlas, mapper: Mapper) -> Array | None:
        """The active submap is about to end.

        Args:
            mapper: optimises the submap again if its keyframes move.

        Returns:
            The motion T_new_old [4, 4] of its newest keyframe; None if the keyframe did not move.
        """
        return None

    def submap_started(self, atlas: Atlas, ended: int, information: Array) -> None:
        """A submap has started at the newest keyframe of another submap.

        Args:
            ended: number of the submap that was active before.
            information: [6, 6] information matrix of that keyframe, from the tracker.
        """

    def submap_recovered(
        self, atlas: Atlas, ended: int, found: Relocalisation | None, reach: Reach | None = None
    ) -> None:
        """A submap has started at a lost frame.

        Args:
            ended: number of the submap that was active before.
            found: the relocalisation of the frame; None if it failed.
            reach: where the camera may be in the world; None if that is unknown.
        """

    def enterable(self, atlas: Atlas) -> list[int]:
        """Submaps of this run in which tracking may continue where one of them shows the view.

        Odometry and verified loops determine their poses relative to the active submap.
        """
        return []

    def origin(self, atlas: Atlas) -> int | None:
        """Number of the submap in which the active one started; None if that is not known."""
        return None

    def submap_entered(
        self, atlas: Atlas, ended: int, T_ended_camera: Array, found: Relocalisation
    ) -> None:
        """Tracking continues in an earlier submap, which is active again.

        Args:
            ended: number of the submap that was active before.
            T_ended_camera: [4, 4] pose of a frame in it.
            found: the same frame in the active submap.
        """

    def finish(self, atlas: Atlas, mapper: Mapper) -> None:
        """The sequence has ended; the submaps are not refined yet."""

    def parts(self, atlas: Atlas) -> list[tuple[int, ...]]:
        """Parts of the map: the ascending numbers of submaps whose relative poses are known.

        Submaps are connected by odometry, and by the loops accepted so far. A submap that started
        where relocalisation had failed is a part of its own until a loop connects it.

        Returns:
            The parts in the order of their first submaps.
        """
        return [tuple(range(len(atlas)))]

    def covariances(self, atlas: Atlas, path: Sequence[PathPose]) -> Array | None:
        """Covariances [M, 6, 6] of frames (`frame_covariances`); None if they are unknown.

        Anchors are uncertain relative to the first submap of their part.
        """
        return None

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values for `restore`."""
        return {}, {}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""


class GivenParts(LoopClosing):
    """Groups submaps by the part of the trajectory that their first keyframe belongs to.

    Loops have been closed when the trajectory was estimated.

    Args:
        part_of_keyframe: number of the part by the index of a frame.
    """

    def __init__(self, part_of_keyframe: Mapping[int, int]) -> None:
        self._part_of_keyframe = part_of_keyframe

    def parts(self, atlas: Atlas) -> list[tuple[int, ...]]:
        """The submaps of each part of the trajectory, in the order of their first submaps."""
        found: dict[int, list[int]] = {}
        for number in range(len(atlas)):
            # Only the first submap can be empty.
            first = next(iter(atlas.keyframe_poses(number)), None)
            part = 0 if first is None else self._part_of_keyframe[first]
            found.setdefault(part, []).append(number)
        return [tuple(numbers) for numbers in found.values()]
