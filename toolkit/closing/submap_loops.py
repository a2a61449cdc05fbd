"""Loops between submaps: which pairs to register, and whether the result can be believed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toolkit.closing.options import ClosingOptions
from toolkit.closing.parts import ClosingParts
from toolkit.closing.records import Record, figures_of, verdict
from toolkit.closing.visibility import Visibility
from toolkit.errors import ToolkitError
from toolkit.geometry import se3
from toolkit.loops.candidates import LoopCandidate
from toolkit.loops.options import VerificationOptions
from toolkit.loops.verification import rejection_reason
from toolkit.pose_graph.chi_square import quantile
from toolkit.pose_graph.consistency import OdometryChain, consistent_loops
from toolkit.pose_graph.graph import PoseEdge
from toolkit.registration.result import Registrar, RegistrationResult, register_pair
from toolkit.submaps.atlas import Atlas

# Two neighbours saw the same things from their boundary.
_OF_NEIGHBOURS = VerificationOptions(min_overlap=0.15)


@dataclass(frozen=True, eq=False)
class _Laid:
    """Two submaps laid over each other: the edge, what it came from, and how they lay before."""

    edge: PoseEdge
    result: RegistrationResult
    T_before: NDArray[np.float64]


class SubmapLoops:
    """Measures edges between submaps, and says why where there is none."""

    def __init__(self, parts: ClosingParts, options: ClosingOptions, record: Record) -> None:
        self._parts, self._options, self._record = parts, options, record

    def overlapping(self, atlas: Atlas, held: set[tuple[int, int]]) -> list[tuple[int, int]]:
        """Pairs of submaps with a loop, or whose keyframes see the same places.

        Of the latter, those that share most, until both have `max_partners`.
        """
        views = {number: Visibility.of(atlas.submap(number)) for number in atlas.readable()}
        # Two submaps of a saved map stay as they are.
        pairs = [(a, b) for a in views for b in views if a < b and b >= atlas.saved]
        chosen = [pair for pair in pairs if pair in held]
        partners = Counter(number for pair in chosen for number in pair)
        shares = {(a, b): views[a].shared(views[b]) for a, b in pairs if (a, b) not in held}
        for pair in sorted(shares, key=lambda pair: (-shares[pair], pair)):
            fewest = min(partners[number] for number in pair)
            if shares[pair] >= self._options.min_visible and fewest < self._options.max_partners:
                chosen.append(pair)
                partners.update(pair)
        return sorted(chosen)

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
        for registrar in (self._parts.registrar, self._parts.nearby):
            laid = self._laid(registrar, atlas, first, second)
            if laid is None:
                return None
            impossible = self._against(odometry, laid.edge)
            if self._believed(
                laid, rejection_reason(laid.result, self._parts.verification) or impossible
            ):
                return laid.edge
            if not impossible:
                return None
        return None

    def joined(
        self, atlas: Atlas, first: int, second: int, odometry: Sequence[PoseEdge]
    ) -> PoseEdge | None:
        """A loop edge between neighbours that lie nearly right, or None.

        They cannot be look-alikes, so less is asked of them than of others. Where they lie right
        already, the odometry between them is the better measurement.
        """
        laid = self._laid(self._parts.nearby, atlas, first, second)
        if laid is None:
            return None
        reason = rejection_reason(laid.result, _OF_NEIGHBOURS) or self._against(odometry, laid.edge)
        chi2 = laid.edge.chi2(np.eye(4), laid.T_before)
        if not reason and chi2 <= quantile(self._options.drift_confidence, 6):
            reason = "the submaps lie so already"
        return laid.edge if self._believed(laid, reason) else None

    def _laid(self, registrar: Registrar, atlas: Atlas, first: int, second: int) -> _Laid | None:
        """A registration from where two submaps lie, None where one of them cannot be read."""
        T = se3.inverse(atlas.T_world_submap(first)) @ atlas.T_world_submap(second)
        try:
            result = register_pair(registrar, atlas.submap(first), atlas.submap(second), T)
        except ToolkitError as error:
            # A submap whose file is lost must not end the run.
            self._record("between", {"first": first, "second": second} | verdict(str(error)))
            return None
        noise = self._parts.loop_noise
        edge = noise.edge(first, second, result.T_target_source, result.information)
        return _Laid(edge, result, T)

    def _against(self, odometry: Sequence[PoseEdge], edge: PoseEdge) -> str:
        """Why the odometry rules a loop out, empty where it does not."""
        chain = OdometryChain(odometry)
        return consistent_loops(chain, [edge], self._parts.consistency).reason(0)

    def _believed(self, laid: _Laid, reason: str) -> bool:
        """Write a registration down with what speaks against it; whether nothing does."""
        values = {"first": laid.edge.first, "second": laid.edge.second}
        self._record("between", values | figures_of(laid.result, laid.T_before) | verdict(reason))
        return not reason

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
            enough = shared >= self._options.min_shared
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
