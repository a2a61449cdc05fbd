"""Loops inside a submap: edges from pairs of images; keyframes move with their Gaussians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from toolkit.base.keyframe import Keyframe
from toolkit.base.pose_graph.consistency import OdometryChain, consistent_loops, quantile
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.slam.loops.candidates import LoopCandidate
from toolkit.slam.loops.closing.log_entries import Record, correction_values, pair_values, verdict
from toolkit.slam.loops.closing.options import ClosingOptions
from toolkit.slam.loops.closing.parts import ClosingParts
from toolkit.slam.loops.closing.uncertainty import NEGLIGIBLE_NOISE
from toolkit.slam.loops.correction import (
    PoseCorrection,
    correct_keyframes,
    keyframe_graph,
)
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.submap import Submap


class KeyframeLoops:
    """Estimates the relative poses of candidate pairs and corrects the active submap."""

    def __init__(self, parts: ClosingParts, options: ClosingOptions, record: Record) -> None:
        self._parts, self._options, self._record = parts, options, record

    def close(self, submap: Submap, mapper: Mapper, candidates: list[LoopCandidate]) -> bool:
        """Close the loops among pairs of a submap; return whether its keyframes moved."""
        keyframes = {keyframe.index: keyframe for keyframe in submap.keyframes}
        loops = self._loop_edges(keyframes, candidates)
        correction = self._correct(submap, loops) if loops else None
        if correction is None:
            return False
        # G, III.C: optimise the map again over the moved keyframes, at fixed poses.
        mapper.optimise_moved(submap, correction.moved, self._options.mapping_iterations)
        return True

    def _loop_edges(
        self, keyframes: Mapping[int, Keyframe], candidates: Sequence[LoopCandidate]
    ) -> list[PoseEdge]:
        """At most one edge for each query: further ones of the same place add little."""
        by_query: dict[int, list[tuple[Keyframe, Keyframe]]] = {}
        for c in candidates:
            by_query.setdefault(c.query, []).append((keyframes[c.match], keyframes[c.query]))
        edges = [self._query_edge(pairs) for pairs in by_query.values()]
        return [edge for edge in edges if edge is not None]

    def _query_edge(self, pairs: list[tuple[Keyframe, Keyframe]]) -> PoseEdge | None:
        """The first verified edge of a query, in descending order of feature matches."""
        matcher = self._parts.matcher
        promising = matcher.most_matches(pairs)
        for number in sorted(set(range(len(pairs))) - {number for number, _ in promising}):
            first, second = pairs[number]
            self._record(
                "within",
                {"match": first.index, "query": second.index} | verdict("images do not match"),
            )
        for number, rough in promising:
            first, second = pairs[number]
            result = matcher.verified(first, second, rough)
            values = {"match": first.index, "query": second.index} | pair_values(result)
            self._record("within", values | verdict(result.reason))
            if result.offset is not None and not result.reason:
                offset = result.offset
                return self._parts.loop_noise.edge(
                    first.index, second.index, offset.T_first_second, offset.information
                )
        return None

    def _correct(self, submap: Submap, loops: list[PoseEdge]) -> PoseCorrection | None:
        """Move keyframes and their Gaussians if the loops significantly contradict the odometry.

        Returns:
            The correction, or None if nothing was moved.
        """
        odometry = []
        for first, second in zip(submap.keyframes, submap.keyframes[1:], strict=False):
            path = [first.T_map_camera, second.T_map_camera]
            edge = self._parts.noise.along(first.index, second.index, path, NEGLIGIBLE_NOISE)
            odometry.append(edge)
        agreement = consistent_loops(OdometryChain(odometry), loops, self._parts.pose_graph)
        for index, loop in enumerate(loops):
            if index not in agreement.kept:
                pair = {"match": loop.first, "query": loop.second}
                self._record("consistency", pair | verdict(agreement.reason(index)))
        kept = [loops[k] for k in agreement.kept]
        poses = {keyframe.index: keyframe.T_map_camera for keyframe in submap.keyframes}
        chi2 = sum(loop.chi2(poses[loop.first], poses[loop.second]) for loop in kept)
        drifted = chi2 > quantile(self._options.drift_confidence, 6 * max(len(kept), 1))
        values = {"submap": submap.number, "loops": len(kept), "chi2": chi2, "applied": drifted}
        if not drifted:
            self._record("correction within", values)
            return None
        graph = keyframe_graph(submap, odometry, kept)
        correction = PoseCorrection.of(graph, self._parts.optimiser.optimise(graph))
        self._record("correction within", values | correction_values(correction))
        correct_keyframes(submap, correction)
        return correction
