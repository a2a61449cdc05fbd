"""Loops inside a submap: edges between images, and keyframes that move with what they seeded."""

from __future__ import annotations

from typing import Any

import numpy as np

from toolkit.alignment.matching import measure_offset
from toolkit.closing.options import ClosingOptions
from toolkit.closing.parts import ClosingParts
from toolkit.closing.records import Record, moved_by, verdict
from toolkit.closing.uncertainty import SURE
from toolkit.keyframe import Keyframe
from toolkit.loops.candidates import LoopCandidate
from toolkit.pose_graph.chi_square import quantile
from toolkit.pose_graph.consistency import OdometryChain, consistent_loops
from toolkit.pose_graph.correction import PoseCorrection, correct_keyframes, keyframe_graph
from toolkit.pose_graph.graph import PoseEdge
from toolkit.submaps.atlas import Atlas
from toolkit.submaps.submap import Submap


class KeyframeLoops:
    """Measures suspected pairs of the active submap, and corrects it where they contradict it."""

    def __init__(self, parts: ClosingParts, options: ClosingOptions, record: Record) -> None:
        self._parts, self._options, self._record = parts, options, record

    def close(self, atlas: Atlas, suspected: list[LoopCandidate]) -> bool:
        """Close the loops among the suspected pairs; whether keyframes moved."""
        submap = atlas.submap(atlas.active)
        keyframes = {keyframe.index: keyframe for keyframe in submap.keyframes}
        measured = [self._measured(keyframes[c.match], keyframes[c.query]) for c in suspected]
        loops = [loop for loop in measured if loop is not None]
        correction = self._corrected(submap, loops) if loops else None
        if correction is None:
            return False
        atlas.put(submap)
        # G, III.C: the map is optimised again where its keyframes have moved, poses fixed.
        atlas.mapper.optimise_keyframes(correction.moved, self._options.mapping_iterations)
        return True

    def _measured(self, first: Keyframe, second: Keyframe) -> PoseEdge | None:
        """A loop edge between what two keyframes observed, None where that says nothing."""
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

    def _corrected(self, submap: Submap, loops: list[PoseEdge]) -> PoseCorrection | None:
        """Move keyframes and Gaussians where the loops contradict the odometry for certain.

        Returns the correction, or None where nothing was moved.
        """
        odometry = []
        for first, second in zip(submap.keyframes, submap.keyframes[1:], strict=False):
            way = [first.T_map_camera, second.T_map_camera]
            odometry.append(self._parts.noise.along(first.index, second.index, way, SURE))
        agreement = consistent_loops(OdometryChain(odometry), loops, self._parts.consistency)
        for place, loop in enumerate(loops):
            if place not in agreement.kept:
                pair = {"match": loop.first, "query": loop.second}
                self._record("consistency", pair | verdict(agreement.reason(place)))
        agreed = [loops[k] for k in agreement.kept]
        poses = {keyframe.index: keyframe.T_map_camera for keyframe in submap.keyframes}
        chi2 = sum(loop.chi2(poses[loop.first], poses[loop.second]) for loop in agreed)
        drifted = chi2 > quantile(self._options.drift_confidence, 6 * max(len(agreed), 1))
        values = {"submap": submap.number, "loops": len(agreed), "chi2": chi2, "applied": drifted}
        if not drifted:
            self._record("correction within", values)
            return None
        graph = keyframe_graph(submap, odometry, agreed)
        correction = PoseCorrection.of(graph, self._parts.optimiser.optimise(graph))
        self._record("correction within", values | moved_by(correction))
        correct_keyframes(submap, correction)
        return correction
