"""Loops between submaps: which pairs to register, and whether the result can be believed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from toolkit.closing.parts import ClosingOptions, ClosingParts
from toolkit.closing.records import Record, figures_of, verdict
from toolkit.closing.sights import Sights
from toolkit.errors import ToolkitError
from toolkit.geometry import se3
from toolkit.loops.candidates import LoopCandidate
from toolkit.loops.verification import VerificationOptions, objection
from toolkit.pose_graph.consistency import OdometryChain, consistent_loops
from toolkit.pose_graph.graph import PoseEdge
from toolkit.registration.result import Registrar, register_pair
from toolkit.submaps.atlas import Atlas

# Two neighbours saw the same things from their boundary; bent by drift inside they agree less.
_OF_NEIGHBOURS = VerificationOptions(least_overlap=0.15, least_inliers=0.6)


class SubmapLoops:
    """Measures edges between submaps, and says why where there is none."""

    def __init__(self, parts: ClosingParts, options: ClosingOptions, record: Record) -> None:
        self._parts, self._options, self._record = parts, options, record

    def overlapping(self, atlas: Atlas, held: set[tuple[int, int]]) -> list[tuple[int, int]]:
        """Pairs of submaps with a loop, or whose keyframes see the same places."""
        views = {number: Sights.of(atlas.submap(number)) for number in atlas.readable()}
        # Two submaps of a saved map stay as they are.
        pairs = [(a, b) for a in views for b in views if a < b and b >= atlas.saved]
        least = self._options.least_visible
        return [p for p in pairs if p in held or views[p[0]].shared(views[p[1]]) >= least]

    def neighbours(self, atlas: Atlas) -> list[tuple[int, int]]:
        """Pairs of submaps of which the second begins with a keyframe of the first."""
        pairs = [(a, b) for a, b in pairwise(atlas.readable()) if b >= atlas.saved]
        return [
            (first, second)
            for first, second in pairs
            if next(iter(atlas.keyframe_poses(second))) in atlas.keyframe_poses(first)
        ]

    def registered(
        self, atlas: Atlas, first: int, second: int, odometry: Sequence[PoseEdge]
    ) -> PoseEdge | None:
        """A loop edge between two submaps, or None where nothing can be verified.

        Alike keyframes can lead to another place that looks the same. Where the odometry rules
        that out, the submaps are laid over each other once more where the odometry has them.
        """
        parts = self._parts
        for registrar in (parts.registrar, parts.nearby):
            edge, possible = self._tried(
                registrar, parts.verification, atlas, (first, second), odometry
            )
            if edge is not None or possible:
                return edge
        return None

    def joined(
        self, atlas: Atlas, first: int, second: int, odometry: Sequence[PoseEdge]
    ) -> PoseEdge | None:
        """A loop edge between neighbours that lie nearly right, or None.

        They cannot be look-alikes, so less is asked of them than of others.
        """
        pair = (first, second)
        return self._tried(self._parts.nearby, _OF_NEIGHBOURS, atlas, pair, odometry)[0]

    def _tried(
        self,
        registrar: Registrar,
        verification: VerificationOptions,
        atlas: Atlas,
        pair: tuple[int, int],
        odometry: Sequence[PoseEdge],
    ) -> tuple[PoseEdge | None, bool]:
        """An edge or None, and whether the odometry allows what was found."""
        first, second = pair
        values: dict[str, Any] = {"first": first, "second": second}
        T = se3.inverse(atlas.T_world_submap(first)) @ atlas.T_world_submap(second)
        try:
            result = register_pair(registrar, atlas.submap(first), atlas.submap(second), T)
        except ToolkitError as error:
            # A submap whose file is lost must not end the run.
            self._record("between", values | verdict(str(error)))
            return None, True
        edge = self._parts.loop_noise.edge(
            first, second, result.T_target_source, result.information
        )
        chain = OdometryChain(odometry)
        impossible = consistent_loops(chain, [edge], self._parts.consistency).reason(0)
        reason = objection(result, verification) or impossible
        self._record("between", values | figures_of(result, T) | verdict(reason))
        return None if reason else edge, not impossible

    def confirmed(self, atlas: Atlas, edge: PoseEdge, pairs: Sequence[LoopCandidate]) -> bool:
        """Whether a suspected pair of keyframes sees the same place, as the submaps now lie.

        Submaps that overlap anyhow can be registered whatever was suspected; without this they
        would be taken for a proof of it.
        """
        matches = {k.index: k for k in atlas.submap(edge.first).keyframes}
        queries = {k.index: k for k in atlas.submap(edge.second).keyframes}
        confirmed = 0
        for pair in pairs:
            query, match = queries[pair.query], matches[pair.match]
            points = se3.transform_points(edge.T_first_second, query.points_in_map())
            shared = float(match.reaches(points).mean()) if len(points) else 0.0
            T_first_query = edge.T_first_second @ query.T_map_camera
            apart_m = float(np.linalg.norm(T_first_query[:3, 3] - match.T_map_camera[:3, 3]))
            enough = shared >= self._options.least_shared
            reason = "" if enough else f"the views share only {100 * shared:.0f} %"
            values = {
                "first": edge.first,
                "second": edge.second,
                "query": pair.query,
                "match": pair.match,
                "shared": shared,
                "apart_m": apart_m,
            }
            self._record("verified", values | verdict(reason))
            confirmed += enough
        return confirmed > 0
