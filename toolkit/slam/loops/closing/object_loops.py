"""Relative poses of submaps from their objects, where images differ too much to be matched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.pose_graph.graph import PoseEdge, information_of
from toolkit.io.arrays import arrays_below
from toolkit.slam.loops.constellations import (
    Constellation,
    ConstellationMatch,
    closest_view,
    match_constellations,
)
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.submap import Submap

Array = NDArray[np.float64]

# Errors of a pose from objects, which the registration that follows removes. Correct ones of
# synthetic rooms are off by up to 8 cm and 2 degrees.
_SIGMA_M, _SIGMA_RAD = 0.1, 0.04
# Minimum number of objects with the same classes and distances in two submaps.
_MIN_OBJECTS = 5
_MIN_OPACITY, _MIN_CONFIDENCE = 0.5, 0.5
# Maximum distance and angle of two views that may show the same place.
_NEAR_M, _NEAR_RAD = 1.0, 0.8


@dataclass(frozen=True, eq=False)
class ObjectHypothesis:
    """A relative pose of two submaps from their objects, with the views that are alike there.

    Attributes:
        edge: relative pose with its uncertainty.
        match: objects that agree.
        pairs: frame indices of query and match.
    """

    edge: PoseEdge
    match: ConstellationMatch
    pairs: list[tuple[int, int]]


class SubmapInstances(Protocol):
    """The instances of a run so far."""

    def of_points(
        self, submap: int, points_m: Array, T_world_submap: Array
    ) -> NDArray[np.int32] | None:
        """Return the instances [N] of points of a submap, 0 for none; None if it has no masks.

        Args:
            submap: its number.
            points_m: [N, 3] in the frame of the submap.
            T_world_submap: [4, 4].
        """
        ...

    def embeddings(self, numbers: NDArray[np.integer]) -> Mapping[int, NDArray[np.float32]]:
        """Return the embeddings [D] of those instances that have one, of unit length."""
        ...


class ObjectHypotheses:
    """Compares the objects of submaps; remembers them once they were computed.

    Objects are connected components of classes. Instances, if a run has them, are compared as well:
    masks with errors agree less often than components, and good ones more often.

    Args:
        semantics: decoder of the Gaussians' features.
        min_gap_frames: minimum number of frames between query and match.
        instances: of the run; None without instances.
    """

    def __init__(
        self,
        semantics: SemanticMapping,
        min_gap_frames: int,
        instances: SubmapInstances | None = None,
    ) -> None:
        self._semantics, self._min_gap, self._instances = semantics, min_gap_frames, instances
        # By submap, with the number of keyframes at that time: a submap can be entered again.
        self._known: dict[int, tuple[int, list[Constellation]]] = {}

    def of(
        self, atlas: Atlas, first: int, second: int, queries: Sequence[int]
    ) -> list[ObjectHypothesis]:
        """Relative poses of two submaps for which enough objects agree and views are alike.

        Args:
            first: number of the older submap.
            second: number of the submap of the queries.
            queries: frame indices of keyframes of the second submap.

        Returns:
            At most one of each kind of objects, those with most agreeing objects first.

        Raises:
            ToolkitError: a submap cannot be read.
        """
        known = [self._constellations(atlas, n) for n in (first, second)]
        matches = [match_constellations(a, b) for a, b in zip(*known, strict=True)]
        covariance = np.diag([_SIGMA_M**2] * 3 + [_SIGMA_RAD**2] * 3)
        poses = atlas.keyframe_poses(first), atlas.keyframe_poses(second)
        found: list[ObjectHypothesis] = []
        for match in matches:
            if match is None or len(match.pairs) < _MIN_OBJECTS:
                continue
            edge = PoseEdge.loop(first, second, match.T_first_second, information_of(covariance))
            pairs = self._alike(*poses, match.T_first_second, queries)
            # Of two submaps without masks, both kinds of objects are components.
            again = any(np.array_equal(edge.T_first_second, e.edge.T_first_second) for e in found)
            found += [ObjectHypothesis(edge, match, pairs)] if pairs and not again else []
        return sorted(found, key=lambda one: -len(one.match.pairs))

    def state(self) -> dict[str, NDArray]:
        """Arrays for `restore`.

        Remembered objects are part of it: Gaussians change without new keyframes, so that objects
        computed again would differ.
        """
        arrays: dict[str, NDArray] = {}
        for number, (size, known) in self._known.items():
            arrays[f"{number}/keyframes"] = np.array(size)
            for kind, one in enumerate(known):
                arrays |= {f"{number}/{kind}/{name}": array for name, array in vars(one).items()}
        return arrays

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._known = {}
        for number in {int(name.split("/")[0]) for name in arrays}:
            values = arrays_below(arrays, f"{number}/")
            size = int(values.pop("keyframes"))
            kinds = sorted({name.split("/")[0] for name in values})
            known = [Constellation(**arrays_below(values, f"{kind}/")) for kind in kinds]
            self._known[number] = size, known

    def _alike(
        self,
        first: dict[int, Array],
        second: dict[int, Array],
        T_first_second: Array,
        queries: Sequence[int],
    ) -> list[tuple[int, int]]:
        """Queries with the most similar view of the first submap, if both may show one place."""
        pairs = []
        for query in queries:
            older = {n: T for n, T in first.items() if query - n >= self._min_gap}
            if not older:
                continue
            nearest = closest_view(
                T_first_second @ second[query], list(older.values()), _NEAR_M, _NEAR_RAD
            )
            if nearest is not None:
                pairs.append((query, list(older)[nearest]))
        return pairs

    def _constellations(self, atlas: Atlas, number: int) -> list[Constellation]:
        size = len(atlas.keyframe_poses(number))
        known = self._known.get(number)
        if known is None or known[0] != size:
            known = size, self._objects(atlas.submap(number))
            self._known[number] = known
        return known[1]

    def _objects(self, submap: Submap) -> list[Constellation]:
        """The constellation of components, and that of instances if the run has any."""
        cloud = submap.gaussians.to("cpu")
        solid = cloud.opacities.reshape(-1) >= _MIN_OPACITY
        decoding = self._semantics.decode_gaussians(cloud.features[solid])
        class_ids = np.where(decoding.confidence >= _MIN_CONFIDENCE, decoding.class_ids, 0)
        points_m = cloud.means[solid].numpy().astype(np.float64)
        found = [Constellation.of(points_m, class_ids)]
        if self._instances is not None:
            ids = self._instances.of_points(submap.number, points_m, submap.T_world_submap)
            embeddings = {} if ids is None else self._instances.embeddings(np.unique(ids))
            found.append(Constellation.of(points_m, class_ids, ids, embeddings))
        return found
