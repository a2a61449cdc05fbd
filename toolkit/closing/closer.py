"""Loop closure from candidates to corrections (G-III.C): verify, optimise the graph, move anchors.

Loops are closed when a submap ends, and once more at the end of the run. Inside a submap, edges
are measured between the images of two keyframes, and keyframes move together with the Gaussians
they seeded. Between submaps, edges come from registration, and only anchors move.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.closing.keyframe_loops import KeyframeLoops
from toolkit.closing.options import ClosingOptions
from toolkit.closing.parts import ClosingParts
from toolkit.closing.records import moved_by, verdict
from toolkit.closing.submap_loops import SubmapLoops
from toolkit.closing.uncertainty import frame_covariances
from toolkit.frame import NullRecorder, Recorder
from toolkit.geometry import se3
from toolkit.io.arrays import arrays_below
from toolkit.loops.candidates import LoopCandidate
from toolkit.loops.detection import LoopDetector
from toolkit.loops.log import LoopLog
from toolkit.loops.relocalisation import Relocalisation, Relocaliser
from toolkit.pose_graph.consistency import OdometryChain, consistent_loops
from toolkit.pose_graph.correction import (
    PoseCorrection,
    submap_graph,
)
from toolkit.pose_graph.graph import PoseEdge
from toolkit.submaps.atlas import Atlas

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)


class LoopCloser:
    """Finds loops during a run and corrects the atlas; see `LoopClosing`.

    Args:
        log: receives each candidate and each verdict; None for no log.
    """

    def __init__(
        self,
        detector: LoopDetector,
        parts: ClosingParts,
        options: ClosingOptions | None = None,
        log: LoopLog | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self.options = options or ClosingOptions()
        self.loops: list[PoseEdge] = []
        self._detector, self._parts, self._log = detector, parts, log
        self._recorder = recorder or NullRecorder()
        self._links: list[PoseEdge] = []
        self._suspected: list[LoopCandidate] = []
        self._between = SubmapLoops(parts, self.options, self._record)

    def map_loaded(self, atlas: Atlas) -> None:
        """Add the keyframes and the anchors of a loaded map, which is rigid from now on."""
        self._detector.add_saved_submaps(atlas.submap(number) for number in range(atlas.saved))
        for first, second in pairwise(range(atlas.saved)):
            T = se3.inverse(atlas.T_world_submap(first)) @ atlas.T_world_submap(second)
            self._links.append(PoseEdge(first, second, T, _RIGID))

    def keyframe_added(self, atlas: Atlas) -> None:
        """Search for loops at the newest keyframe of the active submap."""
        with self._recorder.timed("loop detection"):
            considered = self._detector.observe(atlas)
        if self._detector.searched:
            query = atlas.mapper.keyframes[-1].index
            self._record("search", {"query": query, "considered": len(considered)})
        for candidate in considered:
            self._record("candidate", candidate.record())
        self._suspected += [c for c in considered if c.accepted]

    def submap_ending(self, atlas: Atlas) -> Array | None:
        """Close the loops inside the active submap; see `LoopClosing`."""
        keyframes = atlas.mapper.keyframes
        if not keyframes:
            return None
        T_map_camera = keyframes[-1].T_map_camera
        if not self.close_within(atlas):
            return None
        return atlas.mapper.keyframes[-1].T_map_camera @ se3.inverse(T_map_camera)

    def submap_started(self, atlas: Atlas, information: Array) -> None:
        """Add the odometry to the new submap, and close the loops of the one before."""
        self.add_odometry(atlas, information)
        self.close_between(atlas, atlas.active - 1)

    def submap_recovered(self, atlas: Atlas, found: Relocalisation | None) -> None:
        """Connect a submap that started at a lost frame, and close the loops of the one before."""
        self._connect(atlas, found)
        self.close_between(atlas, atlas.active - 1)
        self.keyframe_added(atlas)

    def finish(self, atlas: Atlas) -> None:
        """Close all remaining loops, and register overlapping submaps once more."""
        # Before refinement: it changes what frames and other submaps are registered against.
        self.submap_ending(atlas)
        self.close_between(atlas, atlas.active)
        self.register_overlaps(atlas)

    def close_within(self, atlas: Atlas) -> bool:
        """Close the loops inside the active submap; whether its keyframes moved."""
        number = atlas.active
        mine = [c for c in self._suspected if c.query_submap == c.match_submap == number]
        self._suspected = [c for c in self._suspected if c not in mine]
        if not mine or not self.options.within:
            return False
        with self._recorder.timed("loops within submaps"):
            return KeyframeLoops(self._parts, self.options, self._record).close(atlas, mine)

    def add_odometry(self, atlas: Atlas, information: Array) -> None:
        """Add the odometry edge from the anchor of the previous submap to the active one's.

        Args:
            information: [6, 6] of the boundary keyframe, from the tracker.
        """
        new = atlas.active
        boundary = next(iter(atlas.keyframe_poses(new)))
        poses = atlas.keyframe_poses(new - 1)
        way = [T for index, T in poses.items() if index <= boundary]
        edge = self._parts.noise.along(new - 1, new, way, information)
        T = se3.inverse(atlas.T_world_submap(new - 1)) @ atlas.T_world_submap(new)
        self._links.append(replace(edge, T_first_second=se3.orthonormalise(T)))

    def _connect(self, atlas: Atlas, found: Relocalisation | None) -> None:
        """Add the edges of a submap that started at a lost frame.

        Its odometry is interrupted, so its pose relative to the previous submap is a guess. If
        the frame was found in a submap, that is a loop edge.
        """
        new = atlas.active
        T = se3.inverse(atlas.T_world_submap(new - 1)) @ atlas.T_world_submap(new)
        self._links.append(PoseEdge(new - 1, new, T, _GUESS))
        if found is None:
            return
        result = found.result
        edge = self._parts.loop_noise.edge(
            found.submap, new, result.T_map_camera, result.information
        )
        self.loops.append(edge)
        self._record(
            "found",
            {"first": found.submap, "second": new, "visible": result.visible_fraction},
        )

    @property
    def relocaliser(self) -> Relocaliser:
        """Finds lost frames."""
        return self._parts.relocaliser

    def close_between(self, atlas: Atlas, number: int) -> bool:
        """Close the loops of one submap with older ones; whether anchors moved."""
        mine = [c for c in self._suspected if c.query_submap == number != c.match_submap]
        self._suspected = [c for c in self._suspected if c not in mine]
        if not mine or not self.options.between:
            return False
        with self._recorder.timed("loops between submaps"):
            found = False
            # Where a lost frame was found, two submaps are joined before they are registered.
            held = {(loop.first, loop.second): loop for loop in self.loops}
            for other in sorted({c.match_submap for c in mine}):
                new = self._between.registered(atlas, other, number, self._links)
                edge = new or held.get((other, number))
                pairs = [c for c in mine if c.match_submap == other]
                proven = edge is not None and self._between.confirmed(atlas, edge, pairs)
                if new is not None and proven:
                    self.loops.append(new)
                    found = True
            return found and self._correct_between(atlas)

    def register_overlaps(self, atlas: Atlas) -> bool:
        """Measure all overlaps again on finished submaps; whether anchors moved (stage 2 of G).

        The papers render the joined map at each keyframe and move the anchors by gradients.
        Registration of each pair that overlaps asks the same question with second-order steps,
        and its answers can be weighed and refused.
        """
        if not self.loops or not self.options.between:
            return False
        with self._recorder.timed("anchors settle"):
            held = {(loop.first, loop.second): loop for loop in self.loops}
            measured = []
            for first, second in self._between.overlapping(atlas, set(held)):
                edge = self._between.registered(atlas, first, second, self._links)
                edge = edge or held.get((first, second))
                measured += [] if edge is None else [edge]
            self.loops = measured
            moved = self._correct_between(atlas)
            return self._join_neighbours(atlas) or moved

    def _join_neighbours(self, atlas: Atlas) -> bool:
        """Register neighbours without a loop once more, from where the others have put them.

        Drift between two that stay unjoined would only be spread over the graph.
        """
        joined = {(loop.first, loop.second) for loop in self.loops}
        apart = [pair for pair in self._between.neighbours(atlas) if pair not in joined]
        edges = [self._between.joined(atlas, *pair, self._links) for pair in apart]
        new = [edge for edge in edges if edge is not None]
        self.loops += new
        return bool(new) and self._correct_between(atlas)

    def _correct_between(self, atlas: Atlas) -> bool:
        """Move the anchors to where all loops that agree put them."""
        parts = self._parts
        agreement = consistent_loops(OdometryChain(self._links), self.loops, parts.consistency)
        for place, loop in enumerate(self.loops):
            if place not in agreement.kept:
                reason = agreement.reason(place)
                values = {"first": loop.first, "second": loop.second}
                self._record("consistency", values | verdict(reason))
        self.loops = [self.loops[k] for k in agreement.kept]
        if not self.loops:
            return False
        poses = {number: atlas.T_world_submap(number) for number in range(len(atlas))}
        graph = submap_graph(poses, self._links, self.loops)
        solution = parts.optimiser.optimise(graph)
        taken_back = [graph.edges[k] for k in solution.retracted]
        for edge in taken_back:
            values = {"first": edge.first, "second": edge.second}
            self._record("retracted", values | verdict("contradicts the rest of the graph"))
        self.loops = [loop for loop in self.loops if not any(loop is e for e in taken_back)]
        correction = PoseCorrection.of(graph, solution)
        for number, T in correction.T_new.items():
            if number >= atlas.saved:
                atlas.move(number, T)
        self._record(
            "correction between",
            {"loops": len(self.loops), **moved_by(correction)},
        )
        _log.info(
            "%d loops between submaps: anchors move by up to %.1f cm",
            len(self.loops),
            100 * correction.largest_m,
        )
        return True

    def covariances(
        self, atlas: Atlas, submaps: Sequence[int], T_submap_camera: Sequence[Array]
    ) -> Array:
        """How sure frames are; see `frame_covariances`."""
        anchors = [np.zeros((6, 6))]
        if len(atlas) > 1 and not self.loops:
            chain = OdometryChain(self._links)
            anchors += [chain.covariance(0, number) for number in range(1, len(atlas))]
        elif len(atlas) > 1:
            poses = {number: atlas.T_world_submap(number) for number in range(len(atlas))}
            graph = submap_graph(poses, self._links, self.loops)
            solution = self._parts.optimiser.optimise(graph)
            assert solution.covariances is not None
            anchors = list(solution.covariances)
        return frame_covariances(anchors, submaps, T_submap_camera, self._parts.noise)

    def _record(self, kind: str, values: dict[str, Any]) -> None:
        if self._log is not None:
            self._log.write({"kind": kind, **values})

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values that `restore` takes."""
        arrays = {f"detector/{name}": array for name, array in self._detector.state().items()}
        ends = []
        for name, edges in (("loops", self.loops), ("links", self._links)):
            T = np.array([edge.T_first_second for edge in edges]).reshape(-1, 4, 4)
            information = np.array([edge.information for edge in edges]).reshape(-1, 6, 6)
            arrays |= {f"{name}/T": T, f"{name}/information": information}
            ends.append([[edge.first, edge.second] for edge in edges])
        values = {
            "ends": ends,
            "suspected": [asdict(candidate) for candidate in self._suspected],
            "log_bytes": None if self._log is None else self._log.size_bytes,
        }
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Take over an earlier `state`, and cut the log back to it."""
        self._detector.restore(arrays_below(arrays, "detector/"))
        made = []
        for name, ends in zip(("loops", "links"), values["ends"], strict=True):
            make = PoseEdge.loop if name == "loops" else PoseEdge
            rows = zip(ends, arrays[f"{name}/T"], arrays[f"{name}/information"], strict=True)
            made.append([make(first, second, T, info) for (first, second), T, info in rows])
        self.loops, self._links = made
        self._suspected = [LoopCandidate(**candidate) for candidate in values["suspected"]]
        if self._log is not None and values["log_bytes"] is not None:
            self._log.truncate(values["log_bytes"])


# Information of an unknown pose: standard deviations of 10 m and 3 rad.
_GUESS = np.diag([1.0 / 10.0**2] * 3 + [1.0 / 3.0**2] * 3)

# Information between the submaps of a loaded map, which do not move against each other.
_RIGID = np.eye(6) * 1e9
