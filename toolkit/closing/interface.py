"""What the SLAM system reports to loop closure, and the system without loop closure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.loops.relocalisation import Relocalisation, Relocaliser
from toolkit.pose_graph.graph import PoseEdge
from toolkit.submaps.atlas import Atlas

Array = NDArray[np.float64]


class LoopClosing(Protocol):
    """Events of a run, in the order in which they happen."""

    @property
    def loops(self) -> Sequence[PoseEdge]:
        """The accepted loop edges between submaps."""
        ...

    @property
    def relocaliser(self) -> Relocaliser | None:
        """Finds lost frames; None if nothing can."""
        ...

    def map_loaded(self, atlas: Atlas) -> None:
        """The atlas has loaded the map of an earlier run."""
        ...

    def keyframe_added(self, atlas: Atlas) -> None:
        """The active submap has a new keyframe."""
        ...

    def submap_ending(self, atlas: Atlas) -> Array | None:
        """The active submap is about to end.

        Returns:
            T_new_old [4, 4], by which its newest keyframe was moved; None if it was not.
        """
        ...

    def submap_started(self, atlas: Atlas, information: Array) -> None:
        """A submap has started at the newest keyframe of the one before.

        Args:
            information: [6, 6] of that keyframe, from the tracker.
        """
        ...

    def submap_recovered(self, atlas: Atlas, found: Relocalisation | None) -> None:
        """A submap has started at a lost frame, which was found or was not."""
        ...

    def finish(self, atlas: Atlas) -> None:
        """The sequence has ended; the submaps are not refined yet."""
        ...

    def covariances(
        self, atlas: Atlas, submaps: Sequence[int], T_submap_camera: Sequence[Array]
    ) -> Array | None:
        """Covariances [M, 6, 6] of frames (`frame_covariances`); None if they are unknown."""
        ...

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values that `restore` takes."""
        ...

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        ...


class NoLoopClosing:
    """Closes no loops and finds no lost frames."""

    loops: Sequence[PoseEdge] = ()
    relocaliser: Relocaliser | None = None

    def map_loaded(self, atlas: Atlas) -> None:
        """Do nothing."""

    def keyframe_added(self, atlas: Atlas) -> None:
        """Do nothing."""

    def submap_ending(self, atlas: Atlas) -> Array | None:
        """Move nothing."""
        return None

    def submap_started(self, atlas: Atlas, information: Array) -> None:
        """Do nothing."""

    def submap_recovered(self, atlas: Atlas, found: Relocalisation | None) -> None:
        """Do nothing."""

    def finish(self, atlas: Atlas) -> None:
        """Do nothing."""

    def covariances(
        self, atlas: Atlas, submaps: Sequence[int], T_submap_camera: Sequence[Array]
    ) -> Array | None:
        """Covariances are unknown."""
        return None

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """There is no state."""
        return {}, {}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """There is no state."""
