"""Loops inside a submap: edges from pairs of images; keyframes move with their Gaussians."""

from __future__ import annotations

from typing import Any

import numpy as np

from toolkit.alignment.matching import measure_offset
from toolkit.closing.options import ClosingOptions
from toolkit.closing.parts import ClosingParts
from toolkit.closing.records import Record, correction_values, verdict
from toolkit.closing.uncertainty import NEGLIGIBLE_NOISE
from toolkit.keyframe import Keyframe
from toolkit.loops.candidates import LoopCandidate
from toolkit.pose_graph.chi_square import quantile
from toolkit.pose_graph.consistency import OdometryChain, consistent_loops
from toolkit.pose_graph.correction import PoseCorrection, correct_keyframes, keyframe_graph
from toolkit.pose_graph.graph import PoseEdge
from toolkit.submaps.atlas import Atlas
from toolkit.submaps.submap import Submap


class KeyframeLoops:
    """Estimates the relative poses of candidate pairs and corrects the active submap."""

    def __init__(self, parts: ClosingParts, options: ClosingOptions, record: Record) -> None:
        self._parts, self._options, self._record = parts, options, record

    def close(self, atlas: Atlas, candidates: list[LoopCandidate]) -> bool:
        """Close the loops among the candidate pairs; return whether keyframes moved."""
        submap = atlas.submap(atlas.active)
        keyframes = {keyframe.index: keyframe for keyframe in submap.keyframes}
        edges = [self._loop_edge(keyframes[c.match], keyframes[c.query]) for c in candidates]
        loops = [loop for loop in edges if loop is not None]
        correction = self._correct(submap, loops) if loops else None
        if correction is None:
            return False
        atlas.put(submap)
        # G, III.C: optimise the map again over the moved keyframes, at fixed poses.
        atlas.mapper.optimise_keyframes(correction.moved, self._options.mapping_iterations)
        return True

    def _loop_edge(self, first: Keyframe, second: Keyframe) -> PoseEdge | None:
        """Estimate a loop edge from the images of two keyframes; None if they do not match."""
        offset = measure_offset(first, second, self._parts.matching)
        values: dict[str, Any] = {"match": first.index, "query": second.index}
        if offset is None:
            self._record("within", values | verdict("images do not match"))
            return None
        apart_m = float(np.linalg.norm(offset.T_first_second[:3, 3]))
        values |= {"matches": offset.matches, "visible": offset.visible, "apart_m": apart_m}
        if offset.visible < self._options.min_visible:
            reason = f"only {100 * offset.visible:.0f} % of the view is shared"
            self._record("within", values | verdict(reason))
            return None
        self._record("within", values | verdict(""))
        T = offset.T_first_second
        return self._parts.loop_noise.edge(first.index, second.index, T, offset.information)

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
        agreement = consistent_loops(OdometryChain(odometry), loops, self._parts.consistency)
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
