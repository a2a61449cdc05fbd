"""Loop edges between submaps from the images of two keyframes.

Registration compares maps, which a short overlap or wrong depth may not suffice for. The images of
two keyframes that are verified in both directions give an edge of their own, and contradict
registrations of the wrong place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.pose_graph.consistency import OdometryChain, consistent_loops
from toolkit.base.pose_graph.graph import PoseEdge, information_of
from toolkit.base.pose_graph.noise import path_between
from toolkit.slam.loops.candidates import LoopCandidate
from toolkit.slam.loops.closing.log_entries import Record, pair_values, verdict
from toolkit.slam.loops.closing.parts import ClosingParts
from toolkit.slam.loops.closing.uncertainty import NEGLIGIBLE_NOISE
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.tracking.reach import is_only_place
from toolkit.splatting.alignment.matching import Offset

Array = NDArray[np.float64]

# Maximum angle between the pose of two images and that of a registration that agree.
_MAX_RAD = 0.035
# Number of queries that must show the same place if the relative pose of two submaps is unknown.
_MIN_QUERIES = 2


@dataclass(frozen=True, eq=False)
class ImageEdges:
    """What the images of candidate pairs say about the relative pose of two submaps.

    Attributes:
        matched: number of candidate pairs with enough feature matches.
        edges: edges of the verified pairs that agree with the odometry, most matches first.
        beyond: edges of the verified pairs that the odometry contradicts.
        queries: frame of each edge's query.
        T_second_query: [4, 4] pose of each edge's query in the second submap.
    """

    matched: int
    edges: list[PoseEdge]
    beyond: list[PoseEdge]
    queries: list[int]
    T_second_query: list[Array]

    def contradiction(self, T_first_second: Array, max_m: float) -> str:
        """Why a relative pose of the submaps contradicts all edges; empty if one agrees.

        Args:
            max_m: maximum distance of poses that agree.
        """
        differences = [
            se3.inverse(edge.T_first_second @ T) @ T_first_second @ T
            for edge, T in zip(self.edges, self.T_second_query, strict=True)
        ]
        if not differences:
            return ""
        metres = [float(np.linalg.norm(T[:3, 3])) for T in differences]
        radians = [float(se3.rotation_angle_rad(T[:3, :3])) for T in differences]
        if any(m <= max_m and r <= _MAX_RAD for m, r in zip(metres, radians, strict=True)):
            return ""
        nearest = int(np.argmin(metres))
        degrees = np.degrees(radians[nearest])
        return f"the images differ by {100 * metres[nearest]:.1f} cm and {degrees:.1f} degrees"


class ImageLoops:
    """Estimates edges between submaps from the images of candidate pairs."""

    def __init__(self, parts: ClosingParts, record: Record) -> None:
        self._parts, self._record = parts, record

    def unambiguous(
        self,
        atlas: Atlas,
        number: int,
        others: set[int],
        parts: Sequence[Sequence[int]],
        candidates: Sequence[LoopCandidate],
        odometry: Sequence[PoseEdge],
    ) -> dict[int, ImageEdges]:
        """What images say about a submap and each older one, without ambiguous loops.

        A submap whose pose relative to a part of the map is unknown is joined to it only if it
        looks like a single place of it. Submaps that cannot be read are left out.

        Args:
            number: of the submap of the queries.
            others: numbers of the older submaps.
            parts: the numbers of all submaps, by submaps whose relative poses are known.
            candidates: all candidate pairs of the submap.
            odometry: edges between anchors.
        """
        images: dict[int, ImageEdges] = {}
        for part in parts:
            known, found = number in part, {}
            for other in sorted(others.intersection(part)):
                pairs = [c for c in candidates if c.match_submap == other]
                try:
                    found[other] = self._edges(atlas, (other, number), pairs, odometry, not known)
                except ToolkitError as error:
                    self._reject(other, number, str(error))
            matched = [one for one in found.values() if one.matched > 0]
            reason = "" if known or not matched else self._ambiguity(atlas, matched, odometry)
            if reason:
                for other in found:
                    self._reject(other, number, reason)
            else:
                images |= found
        return dict(sorted(images.items()))

    def _reject(self, first: int, second: int, reason: str) -> None:
        self._record("between", {"first": first, "second": second} | verdict(reason))

    def _ambiguity(
        self, atlas: Atlas, found: Sequence[ImageEdges], odometry: Sequence[PoseEdge]
    ) -> str:
        """Why images do not tell where a submap of unknown pose is; empty if they do.

        After frames without a pose, the odometry permits places metres apart, and a door looks
        like the next one. Several queries must then show one place, and none another one.

        Args:
            found: what the images of the submap and of each submap of one part say.
        """
        if len({query for one in found for query in one.queries}) < _MIN_QUERIES:
            return f"images of {_MIN_QUERIES} keyframes are needed after frames without a pose"
        best, T_second_query = next(
            (one.edges[0], one.T_second_query[0]) for one in found if one.edges
        )
        T_query_second = se3.inverse(T_second_query)
        T_first_world = se3.inverse(atlas.T_world_submap(best.first))

        def possible(T_world_query: Array) -> bool:
            T = se3.orthonormalise(T_first_world @ T_world_query @ T_query_second)
            return not self._contradiction(odometry, replace(best, T_first_second=T))

        place, *others = (
            atlas.T_world_submap(edge.first) @ edge.T_first_second @ T_second_query
            for edge in (best, *(edge for one in found for edge in (*one.edges, *one.beyond)))
        )
        if is_only_place(place, others, possible):
            return ""
        return "the images look like several places where the camera may be"

    def _contradiction(self, odometry: Sequence[PoseEdge], edge: PoseEdge) -> str:
        """Why the odometry contradicts an edge; empty if it does not."""
        return consistent_loops(OdometryChain(odometry), [edge], self._parts.pose_graph).reason(0)

    def _edges(
        self,
        atlas: Atlas,
        submaps: tuple[int, int],
        candidates: Sequence[LoopCandidate],
        odometry: Sequence[PoseEdge],
        every: bool,
    ) -> ImageEdges:
        """The edges of the candidate pairs of two submaps.

        Args:
            submaps: numbers of the older submap, of the matches, and of the queries' submap.
            every: whether all pairs of a query are verified, instead of the first one that passes.
        """
        first, second = (
            {keyframe.index: keyframe for keyframe in atlas.submap(number).keyframes}
            for number in submaps
        )
        matcher = self._parts.matcher
        matched = 0
        found: list[tuple[int, int, PoseEdge, Array]] = []
        beyond: list[PoseEdge] = []
        for query in dict.fromkeys(candidate.query for candidate in candidates):
            pairs = [(first[c.match], second[query]) for c in candidates if c.query == query]
            promising = matcher.most_matches(pairs)
            matched += len(promising)
            for number, rough in promising:
                match, own = pairs[number]
                result = matcher.verified(match, own, rough)
                values = dict(zip(("first", "second"), submaps, strict=True))
                values |= {"query": query, "match": match.index}
                reason, edge = result.reason, None
                if result.offset is not None and not reason:
                    edge = self._edge(atlas, submaps, (match.index, query), result.offset)
                    reason = self._contradiction(odometry, edge)
                self._record("images", values | pair_values(result) | verdict(reason))
                if edge is not None and reason:
                    beyond.append(edge)
                elif edge is not None:
                    found.append((result.matches, query, edge, own.T_map_camera))
                    if not every:
                        break
        found.sort(key=lambda entry: -entry[0])
        _, queries, edges, poses = zip(*found, strict=True) if found else ((), (), (), ())
        return ImageEdges(matched, list(edges), beyond, list(queries), list(poses))

    def _edge(
        self, atlas: Atlas, submaps: tuple[int, int], frames: tuple[int, int], offset: Offset
    ) -> PoseEdge:
        """The edge between submaps from the offset Z of two of their keyframes.

        T_first_second = A Z B^-1 with the poses A and B of the keyframes in their submaps, whose
        errors are those of the odometry from the anchors.
        """
        A, B = (
            atlas.keyframe_poses(number)[frame]
            for number, frame in zip(submaps, frames, strict=True)
        )
        drift_a, drift_b = (
            self._drift(atlas, number, frame) for number, frame in zip(submaps, frames, strict=True)
        )
        Z = offset.T_first_second
        # Perturbations at A are moved to the query's camera; those at B have the opposite sign.
        to_query, to_second = se3.adjoint(se3.inverse(Z)), se3.adjoint(B)
        covariance = self._parts.loop_noise.alignment(offset.information)
        covariance = covariance + drift_b + to_query @ drift_a @ to_query.T
        covariance = to_second @ covariance @ to_second.T
        T = se3.orthonormalise(A @ Z @ se3.inverse(B))
        return PoseEdge.loop(*submaps, T, information_of(covariance))

    def _drift(self, atlas: Atlas, number: int, frame: int) -> Array:
        """Covariance [6, 6] of a keyframe's pose in its submap."""
        path = [T for index, T in atlas.keyframe_poses(number).items() if index <= frame]
        return self._parts.noise.covariance(NEGLIGIBLE_NOISE, *path_between(path))
