"""Loops between submaps: choice of the pairs to register, and verification of the results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.pose_graph.consistency import OdometryChain, consistent_loops, quantile
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.slam.loops.candidates import LoopCandidate
from toolkit.slam.loops.closing.image_edges import ImageEdges
from toolkit.slam.loops.closing.log_entries import (
    Record,
    motion_values,
    registration_values,
    verdict,
)
from toolkit.slam.loops.closing.object_loops import ObjectHypothesis
from toolkit.slam.loops.closing.options import ClosingOptions
from toolkit.slam.loops.closing.parts import ClosingParts
from toolkit.slam.loops.closing.visibility import Visibility
from toolkit.slam.loops.registration.result import Registrar, RegistrationResult, register_pair
from toolkit.slam.loops.verification import VerificationLimits, rejection_reason
from toolkit.slam.submaps.atlas import Atlas

# Minimum fraction of a candidate keyframe's view that the other keyframe sees after the
# registration of their submaps.
_MIN_SHARED = 0.3
# Maximum distance of a registration's result from the pose of a verified pair of keyframes.
_MAX_IMAGE_DIFFERENCE_M = 0.05
# Neighbours overlap at least in the views around their boundary.
_NEIGHBOUR_VERIFICATION = VerificationLimits(min_overlap=0.15)
# After a change of light or colour, only surfaces and classes are compared, and more strictly.
_OBJECT_VERIFICATION = VerificationLimits(
    min_inliers=0.9, min_class_agreement=0.85, max_intensity_residual=np.inf
)
# Maximum distance of a registration's result from the pose of the objects.
_MAX_FROM_OBJECTS_M = 0.2


@dataclass(frozen=True, eq=False)
class _Registration:
    """A registration of two submaps: its edge, its result and the relative pose before it."""

    edge: PoseEdge
    result: RegistrationResult
    T_before: NDArray[np.float64]


class SubmapLoops:
    """Estimates loop edges between submaps, and records why registrations are rejected."""

    def __init__(self, parts: ClosingParts, options: ClosingOptions, record: Record) -> None:
        self._parts, self._options, self._record = parts, options, record

    def overlapping(
        self,
        atlas: Atlas,
        loops: set[tuple[int, int]],
        parts: Sequence[Sequence[int]],
    ) -> list[tuple[int, int]]:
        """Pairs of submaps with a loop edge, or with overlapping keyframe views.

        The latter are chosen in order of decreasing overlap, as long as one of the two submaps has
        fewer than `max_partners` partners.

        Args:
            loops: pairs with a loop edge.
            parts: submaps with known relative poses; those of others overlap by chance only.
        """
        views = {number: Visibility.of(atlas.submap(number)) for number in atlas.readable()}
        part = {number: k for k, numbers in enumerate(parts) for number in numbers}
        # The relative poses of loaded submaps are fixed.
        pairs = [(a, b) for a in views for b in views if a < b and b >= atlas.saved]
        pairs = [(a, b) for a, b in pairs if part[a] == part[b]]
        chosen = [pair for pair in pairs if pair in loops]
        partners = Counter(number for pair in chosen for number in pair)
        overlaps = {(a, b): views[a].overlap(views[b]) for a, b in pairs if (a, b) not in loops}
        for pair in sorted(overlaps, key=lambda pair: (-overlaps[pair], pair)):
            fewest = min(partners[number] for number in pair)
            if overlaps[pair] >= self._options.min_visible and fewest < self._options.max_partners:
                chosen.append(pair)
                partners.update(pair)
        return sorted(chosen)

    def neighbours(self, atlas: Atlas) -> list[tuple[int, int]]:
        """Pairs of submaps that share the keyframe at their boundary."""
        readable = atlas.readable()
        return [
            (first, second)
            for second in readable
            for first in readable
            if first < second >= atlas.saved
            if next(iter(atlas.keyframe_poses(second))) in atlas.keyframe_poses(first)
        ]

    def register(
        self,
        atlas: Atlas,
        first: int,
        second: int,
        odometry: Sequence[PoseEdge],
        images: ImageEdges | None = None,
    ) -> PoseEdge | None:
        """Register two submaps; return their loop edge, or None if it cannot be verified.

        Similar keyframes can be of different places (perceptual aliasing). If the odometry
        contradicts the result, the submaps are registered again from their current poses.

        Args:
            images: edges of the candidate pairs' images, which the result must not contradict.
        """
        for registrar in (self._parts.registrar, self._parts.nearby):
            registration = self._registered(registrar, atlas, first, second)
            if registration is None:
                return None
            contradiction = self._contradiction(odometry, registration.edge)
            if images is not None and not contradiction:
                T = registration.edge.T_first_second
                contradiction = images.contradiction(T, _MAX_IMAGE_DIFFERENCE_M)
            rejection = rejection_reason(registration.result, self._parts.verification)
            if self._accept(registration, rejection or contradiction):
                return registration.edge
            if not contradiction:
                return None
        return None

    def close(
        self,
        atlas: Atlas,
        submaps: tuple[int, int],
        candidates: Sequence[LoopCandidate],
        odometry: Sequence[PoseEdge],
        images: ImageEdges | None,
    ) -> PoseEdge | None:
        """The loop edge of two submaps; None without one.

        Submaps are registered only if the images of some pair match, or their objects. If the
        registration is rejected, verified images give the edge. Without tests (G), the registration
        is the edge.

        Args:
            submaps: numbers of the older submap and of that of the queries.
            candidates: all candidate pairs of the second submap.
            odometry: edges between anchors.
            images: what the images of the pairs say; not needed without tests.
        """
        pairs = [c for c in candidates if c.match_submap == submaps[0]]
        if self._parts.verification is None:
            edge = self.register(atlas, *submaps, odometry)
            if edge is not None:
                self.confirm(atlas, edge, _frames(pairs))
            return edge
        assert images is not None
        if images.matched == 0 and pairs:
            values = {"first": submaps[0], "second": submaps[1]}
            reason = f"the images of none of {len(pairs)} candidate pairs match"
            self._record("between", values | verdict(reason))
        elif pairs:
            edge = self.register(atlas, *submaps, odometry, images)
            if edge is not None and self.confirm(atlas, edge, _frames(pairs)):
                return edge
            if images.edges:
                return images.edges[0]
        return self._close_by_objects(atlas, submaps, candidates, odometry)

    def suspected_by_objects(
        self,
        atlas: Atlas,
        number: int,
        candidates: Sequence[LoopCandidate],
        odometry: Sequence[PoseEdge],
    ) -> set[int]:
        """Older submaps without a candidate pair whose objects agree with those of a submap."""
        if self._parts.objects is None:
            return set()
        known = {candidate.match_submap for candidate in candidates}
        others = [n for n in atlas.readable() if n < number and n not in known]
        queries = list(dict.fromkeys(candidate.query for candidate in candidates))
        return {n for n in others if self._hypotheses(atlas, (n, number), queries, odometry)}

    def _hypotheses(
        self,
        atlas: Atlas,
        submaps: tuple[int, int],
        queries: Sequence[int],
        odometry: Sequence[PoseEdge],
    ) -> list[ObjectHypothesis]:
        """The relative poses of two submaps from their objects that the odometry permits."""
        assert self._parts.objects is not None
        values = {"first": submaps[0], "second": submaps[1]}
        try:
            hypotheses = self._parts.objects.of(atlas, *submaps, queries)
        except ToolkitError as error:
            self._record("objects", values | verdict(str(error)))
            return []
        permitted = []
        for one in hypotheses:
            reason = self._contradiction(odometry, one.edge)
            agreeing = {"objects": len(one.match.pairs), "error_m": one.match.error_m}
            self._record("objects", values | agreeing | verdict(reason))
            permitted += [] if reason else [one]
        return permitted

    def _close_by_objects(
        self,
        atlas: Atlas,
        submaps: tuple[int, int],
        candidates: Sequence[LoopCandidate],
        odometry: Sequence[PoseEdge],
    ) -> PoseEdge | None:
        """The loop edge of two submaps whose images do not match, registered from their objects."""
        if self._parts.objects is None:
            return None
        queries = list(dict.fromkeys(candidate.query for candidate in candidates))
        for found in self._hypotheses(atlas, submaps, queries, odometry):
            edge = self._register_objects(atlas, submaps, found, odometry)
            if edge is not None:
                return edge
        return None

    def _register_objects(
        self,
        atlas: Atlas,
        submaps: tuple[int, int],
        found: ObjectHypothesis,
        odometry: Sequence[PoseEdge],
    ) -> PoseEdge | None:
        """The loop edge of two submaps that are registered from the pose of their objects.

        Instead of the images, the objects confirm it: the result must stay near the pose that they
        determine, besides passing the tests of a registration.
        """
        T = found.edge.T_first_second
        registration = self._registered(self._parts.nearby, atlas, *submaps, T)
        if registration is None:
            return None
        change = se3.inverse(T) @ registration.edge.T_first_second
        reason = rejection_reason(registration.result, _OBJECT_VERIFICATION)
        reason = reason or self._contradiction(odometry, registration.edge)
        if not reason and np.linalg.norm(change[:3, 3]) > _MAX_FROM_OBJECTS_M:
            reason = f"the objects differ by {100 * np.linalg.norm(change[:3, 3]):.0f} cm"
        if not self._accept(registration, reason):
            return None
        return registration.edge if self.confirm(atlas, registration.edge, found.pairs) else None

    def register_neighbours(
        self, atlas: Atlas, first: int, second: int, odometry: Sequence[PoseEdge]
    ) -> PoseEdge | None:
        """Register neighbours whose relative pose is approximately known; None if rejected.

        Perceptual aliasing is impossible, so a smaller overlap suffices. If the registration
        agrees with the current poses, the odometry between them is the more accurate measurement.
        """
        registration = self._registered(self._parts.nearby, atlas, first, second)
        if registration is None:
            return None
        edge = registration.edge
        reason = rejection_reason(registration.result, _NEIGHBOUR_VERIFICATION)
        reason = reason or self._contradiction(odometry, edge)
        chi2 = edge.chi2(np.eye(4), registration.T_before)
        if not reason and chi2 <= quantile(self._options.drift_confidence, 6):
            reason = "the registration agrees with the current poses"
        return edge if self._accept(registration, reason) else None

    def _registered(
        self,
        registrar: Registrar,
        atlas: Atlas,
        first: int,
        second: int,
        start: NDArray[np.float64] | None = None,
    ) -> _Registration | None:
        """Register two submaps; None if one of them cannot be read.

        Args:
            start: initial T_first_second [4, 4]; by default from their current poses.
        """
        T = se3.inverse(atlas.T_world_submap(first)) @ atlas.T_world_submap(second)
        start = T if start is None else start
        try:
            result = register_pair(registrar, atlas.submap(first), atlas.submap(second), start)
        except ToolkitError as error:
            # The run must continue if the file of a submap is missing or damaged.
            self._record("between", {"first": first, "second": second} | verdict(str(error)))
            return None
        noise = self._parts.loop_noise
        edge = noise.edge(first, second, result.T_target_source, result.information)
        return _Registration(edge, result, T)

    def _contradiction(self, odometry: Sequence[PoseEdge], edge: PoseEdge) -> str:
        """Why a loop is inconsistent with the odometry; empty if it is consistent."""
        chain = OdometryChain(odometry)
        return consistent_loops(chain, [edge], self._parts.pose_graph).reason(0)

    def _accept(self, registration: _Registration, reason: str) -> bool:
        """Record a registration and the reason for rejecting it; return whether it is accepted."""
        values = {"first": registration.edge.first, "second": registration.edge.second}
        values |= registration_values(registration.result, registration.T_before)
        self._record("between", values | verdict(reason))
        return not reason

    def confirm(self, atlas: Atlas, edge: PoseEdge, pairs: Sequence[tuple[int, int]]) -> bool:
        """Check whether a pair of keyframes (query, match) overlaps after the registration.

        Submaps that overlap can be registered even if no candidate pair shows the same place; a
        successful registration alone does not confirm the candidates.
        """
        matches = {k.index: k for k in atlas.submap(edge.first).keyframes}
        queries = {k.index: k for k in atlas.submap(edge.second).keyframes}
        confirmed = 0
        for query_frame, match_frame in pairs:
            query, match = queries[query_frame], matches[match_frame]
            points = se3.transform_points(edge.T_first_second, query.points_in_map())
            shared = float(match.reaches(points).mean()) if len(points) else 0.0
            T_first_query = edge.T_first_second @ query.T_map_camera
            enough = shared >= _MIN_SHARED or self._parts.verification is None
            reason = "" if enough else f"only {100 * shared:.0f} % of the view is shared"
            values = {
                "first": edge.first,
                "second": edge.second,
                "query": query_frame,
                "match": match_frame,
                "shared": shared,
                **motion_values(se3.inverse(match.T_map_camera) @ T_first_query),
            }
            self._record("verified", values | verdict(reason))
            confirmed += enough
        return confirmed > 0


def _frames(pairs: Sequence[LoopCandidate]) -> list[tuple[int, int]]:
    """Query and match of candidates."""
    return [(pair.query, pair.match) for pair in pairs]
