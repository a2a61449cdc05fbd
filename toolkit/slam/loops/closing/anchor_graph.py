"""The pose graph of the submaps: odometry and loops between their anchors."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.pose_graph.consistency import OdometryChain, consistent_loops
from toolkit.base.pose_graph.graph import PoseEdge, adjacent, connected_parts
from toolkit.slam.loops.closing.log_entries import Record, correction_values, verdict
from toolkit.slam.loops.closing.odometry import SubmapOdometry
from toolkit.slam.loops.closing.parts import ClosingParts
from toolkit.slam.loops.closing.uncertainty import PathPose, frame_covariances
from toolkit.slam.loops.correction import PoseCorrection, submap_graph
from toolkit.slam.submaps.atlas import Atlas

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)


class AnchorGraph:
    """Keeps the edges between submaps, and corrects their anchors.

    Attributes:
        odometry: edges from each submap to the next one.
        loops: accepted loop edges.

    Args:
        parts: with the noise of odometry, the conditions of loops and the optimiser.
        record: receives decisions and corrections.
    """

    def __init__(self, parts: ClosingParts, record: Record) -> None:
        self.odometry = SubmapOdometry(parts.noise)
        self.loops: list[PoseEdge] = []
        self._parts, self._record = parts, record

    @property
    def by_pair(self) -> dict[tuple[int, int], PoseEdge]:
        """The loops by the numbers of their submaps."""
        return {(loop.first, loop.second): loop for loop in self.loops}

    @property
    def known(self) -> list[PoseEdge]:
        """The edges that determine relative poses: loops, and odometry without interruption."""
        return [*self.odometry.known, *self.loops]

    def enterable(self, atlas: Atlas) -> list[int]:
        """Neighbours of the active submap by odometry, and those that loops connect to them.

        The relative poses of others contain the drift of a long way, and their loops may be wrong.
        """
        near = self._beside({atlas.active})
        near = self._beside(adjacent(near, self.loops))
        return sorted(n for n in near if n != atlas.active and n >= atlas.saved)

    def _beside(self, numbers: set[int]) -> set[int]:
        """The submaps, and those that started in one of them or in which one of them started."""
        return numbers.union(*(self.odometry.beside(number) for number in numbers))

    def correct(self, atlas: Atlas) -> bool:
        """Optimise the anchors over all consistent loops; return whether anchors moved."""
        agreement = consistent_loops(
            OdometryChain(self.odometry.links), self.loops, self._parts.pose_graph
        )
        for index, loop in enumerate(self.loops):
            if index not in agreement.kept:
                reason = agreement.reason(index)
                values = {"first": loop.first, "second": loop.second}
                self._record("consistency", values | verdict(reason))
        self.loops = [self.loops[k] for k in agreement.kept]
        if not self.loops:
            return False
        poses = {number: atlas.T_world_submap(number) for number in range(len(atlas))}
        graph = submap_graph(poses, self.odometry.links, self.loops)
        solution = self._parts.optimiser.optimise(graph)
        retracted = [graph.edges[k] for k in solution.retracted]
        for edge in retracted:
            values = {"first": edge.first, "second": edge.second}
            self._record("retracted", values | verdict("contradicts the rest of the graph"))
        self.loops = [loop for loop in self.loops if not any(loop is e for e in retracted)]
        correction = PoseCorrection.of(graph, solution)
        for number, T in correction.T_new.items():
            if number >= atlas.saved:
                atlas.move(number, T)
        self._record(
            "correction between",
            {"loops": len(self.loops), **correction_values(correction)},
        )
        _log.info(
            "Closed %d loops between submaps: anchors moved by up to %.1f cm.",
            len(self.loops),
            100 * correction.largest_m,
        )
        return True

    def parts(self, atlas: Atlas) -> list[tuple[int, ...]]:
        """Submaps with known relative poses, by number."""
        return connected_parts(range(len(atlas)), self.known)

    def covariances(self, atlas: Atlas, path: Sequence[PathPose]) -> Array:
        """Covariances of frame poses; see `frame_covariances`."""
        links = self.odometry.measured(path)
        anchors: dict[int, Array] = {}
        for part in self.parts(atlas):
            anchors |= self._anchor_covariances(atlas, part, links)
        ordered = [anchors[number] for number in range(len(atlas))]
        return frame_covariances(ordered, path, self._parts.noise)

    def _anchor_covariances(
        self, atlas: Atlas, part: tuple[int, ...], links: Sequence[PoseEdge]
    ) -> dict[int, Array]:
        """Covariance [6, 6] of each anchor of a part relative to the first one, by number."""
        links, loops = (
            [edge for edge in edges if edge.first in part and edge.second in part]
            for edges in (links, self.loops)
        )
        first, *others = part
        anchors = {first: np.zeros((6, 6))}
        if others and not loops:
            chain = OdometryChain(links)
            anchors |= {number: chain.covariance(first, number) for number in others}
        elif others:
            poses = {number: atlas.T_world_submap(number) for number in part}
            graph = submap_graph(poses, links, loops)
            solution = self._parts.optimiser.optimise(graph)
            assert solution.covariances is not None
            anchors = dict(zip(graph.nodes, solution.covariances, strict=True))
        return anchors

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values for `restore`."""
        arrays: dict[str, NDArray] = {}
        ends = []
        for name, edges in self._edges().items():
            T = np.array([edge.T_first_second for edge in edges]).reshape(-1, 4, 4)
            information = np.array([edge.information for edge in edges]).reshape(-1, 6, 6)
            arrays |= {f"{name}/T": T, f"{name}/information": information}
            ends.append([[edge.first, edge.second] for edge in edges])
        return arrays, {"ends": ends, "odometry": self.odometry.values()}

    def _edges(self) -> dict[str, list[PoseEdge]]:
        odometry = self.odometry
        ways_back = list(odometry.ways_back.values())
        return {"loops": self.loops, "links": odometry.links, "ways_back": ways_back}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        restored = []
        for name, ends in zip(self._edges(), values["ends"], strict=True):
            make = PoseEdge.loop if name == "loops" else PoseEdge
            rows = zip(ends, arrays[f"{name}/T"], arrays[f"{name}/information"], strict=True)
            restored.append([make(first, second, T, info) for (first, second), T, info in rows])
        self.loops, links, ways_back = restored
        self.odometry.restore(links, ways_back, values["odometry"])
