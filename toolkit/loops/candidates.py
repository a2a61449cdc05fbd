"""Loop candidates: places that look alike, ranked by what stands there (G, Algorithm 1).

A candidate is a suspicion. Whether two views show one place is decided by registration, after
this; so each search gives every keyframe it considered, taken or refused, with the reason.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.loops.landmarks import landmark_distance, landmark_vectors
from toolkit.loops.options import CandidateOptions, LandmarkOptions
from toolkit.loops.retrieval import DescriptorIndex, Neighbour

# The rank of a candidate whose landmarks tell nothing: as of vectors with little in common.
_UNKNOWN_LANDMARKS = 1.0
# Fewer distances than these say nothing about how alike neighbours look.
_LEAST_NEIGHBOURS = 3


@dataclass(frozen=True)
class DescribedKeyframe:
    """What loop detection knows of a keyframe.

    Attributes:
        frame: its index in the sequence.
        submap: the number of its submap.
        travelled_m: length of the estimated path up to here, metres.
        descriptor: [D] float32 of unit length.
        class_counts: [C] observed pixels or Gaussians of each class without void; C may be 0.
    """

    frame: int
    submap: int
    travelled_m: float
    descriptor: NDArray[np.float32]
    class_counts: NDArray[np.int64]


@dataclass(frozen=True)
class LoopCandidate:
    """Two keyframes that may show one place.

    Attributes:
        query, match: frame indices, the match being the older.
        query_submap, match_submap: numbers of their submaps.
        distance: of the descriptors, Euclidean.
        cosine: of the descriptors.
        landmark_distance: of the landmark vectors, in [0, sqrt 2]; None where they tell nothing.
        reason: why it was taken or refused, in plain words.
        accepted: whether it goes on to verification.
    """

    query: int
    match: int
    query_submap: int
    match_submap: int
    distance: float
    cosine: float
    landmark_distance: float | None
    reason: str
    accepted: bool

    def record(self) -> dict[str, Any]:
        """The values for a log."""
        return asdict(self)


@dataclass(frozen=True)
class Sighting:
    """A keyframe that looks like a view: its frame index, its submap, and how alike they are."""

    frame: int
    submap: int
    distance: float


class CandidateFinder:
    """Remembers the keyframes of a run, and searches among them every so often.

    Args:
        dimensions: length D of a descriptor.
        threshold: the descriptor's own.
        options: when keyframes are candidates; default if None.
        landmarks: how classes are weighed; default if None.

    Raises:
        DependencyError: FAISS cannot be loaded.
    """

    def __init__(
        self,
        dimensions: int,
        threshold: float,
        options: CandidateOptions | None = None,
        landmarks: LandmarkOptions | None = None,
    ) -> None:
        self.options = options or CandidateOptions()
        self._landmarks = landmarks or LandmarkOptions()
        fixed = self.options.distance
        self._fixed_threshold = threshold if fixed is None else fixed
        self._index = DescriptorIndex(dimensions)
        self._frames: list[int] = []
        self._submaps: list[int] = []
        self._travelled_m: list[float] = []
        self._class_counts: list[NDArray[np.int64]] = []

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, keyframe: DescribedKeyframe) -> list[LoopCandidate]:
        """Remember a keyframe and, if its turn has come, search for its loops.

        Args:
            keyframe: the next one, with a later frame than the last.

        Returns:
            What was considered, best first: those taken, then those refused. Nothing, too,
            where no search was due.

        Raises:
            ValueError: the keyframe does not fit those before.
        """
        number = self.remember(keyframe)
        return self.search(number) if self.search_was_due else []

    def remember(self, keyframe: DescribedKeyframe) -> int:
        """Remember a keyframe without a search; its number.

        Raises:
            ValueError: the keyframe does not fit those before.
        """
        self._check(keyframe)
        number = self._index.add(keyframe.descriptor)
        self._frames.append(keyframe.frame)
        self._submaps.append(keyframe.submap)
        self._travelled_m.append(keyframe.travelled_m)
        self._class_counts.append(np.array(keyframe.class_counts, np.int64))
        return number

    @property
    def search_was_due(self) -> bool:
        """Whether the newest keyframe was one at which loops are searched for."""
        return len(self) > 0 and len(self) % self.options.search_every == 0

    def search(self, number: int) -> list[LoopCandidate]:
        """Candidates for the keyframe that was added as the `number`-th, from 0; as `add`."""
        options = self.options
        among = np.flatnonzero(self._beyond_gap(number))
        found = self._index.search(self._index.descriptor(number), options.considered, among)
        if not found:
            return []
        counts = np.stack(self._class_counts)
        # The paper's weighting counts over the map, which holds what its keyframes observed.
        vectors = landmark_vectors(counts, self._landmarks, map_counts=counts.sum(axis=0))
        limit = self._threshold_of(number)
        judged = [
            self._judged(
                number, near, limit, landmark_distance(vectors[number], vectors[near.keyframe])
            )
            for near in found
        ]
        refused = [c for c in judged if not c.accepted]
        return _chosen([c for c in judged if c.accepted], options.kept) + refused

    def alike(self, descriptor: NDArray[np.float32], count: int) -> list[Sighting]:
        """The keyframes that look most like a view of descriptor [D], nearest first."""
        return [
            Sighting(self._frames[n.keyframe], self._submaps[n.keyframe], n.distance)
            for n in self._index.search(descriptor, count)
        ]

    def state(self) -> dict[str, NDArray]:
        """Arrays that `restore` takes over to identical results."""
        counts = self._class_counts
        return {
            **self._index.state(),
            "frames": np.array(self._frames, np.int64),
            "submaps": np.array(self._submaps, np.int64),
            "travelled_m": np.array(self._travelled_m, np.float64),
            "class_counts": np.stack(counts) if counts else np.zeros((0, 0), np.int64),
        }

    def restore(self, state: dict[str, NDArray]) -> None:
        """Take over an earlier `state`."""
        self._index = DescriptorIndex.from_state(state, self._index.dimensions)
        self._frames = [int(n) for n in state["frames"]]
        self._submaps = [int(n) for n in state["submaps"]]
        self._travelled_m = [float(m) for m in state["travelled_m"]]
        self._class_counts = [np.array(counts) for counts in state["class_counts"]]

    def _check(self, keyframe: DescribedKeyframe) -> None:
        if not self._frames:
            return
        if keyframe.frame <= self._frames[-1] or keyframe.travelled_m < self._travelled_m[-1]:
            raise ValueError(
                f"keyframe {keyframe.frame} at {keyframe.travelled_m:.3f} m must come after "
                f"{self._frames[-1]} at {self._travelled_m[-1]:.3f} m"
            )
        if keyframe.class_counts.shape != self._class_counts[-1].shape:
            raise ValueError(
                f"class_counts must have shape {list(self._class_counts[-1].shape)}, "
                f"got {list(keyframe.class_counts.shape)}"
            )

    def _beyond_gap(self, number: int) -> NDArray[np.bool_]:
        """Which keyframes are older by enough frames and enough metres."""
        frames, travelled_m = np.array(self._frames), np.array(self._travelled_m)
        options = self.options
        far = frames[number] - frames >= options.min_gap_frames
        return far & (travelled_m[number] - travelled_m >= options.min_gap_m)

    def _threshold_of(self, number: int) -> float:
        """The descriptor distance below which a keyframe's matches are believed."""
        options = self.options
        if options.threshold == "fixed":
            return self._fixed_threshold
        submaps, numbers = np.array(self._submaps), np.arange(len(self))
        near = (submaps == submaps[number]) & (numbers < number) & ~self._beyond_gap(number)
        if near.sum() < _LEAST_NEIGHBOURS:
            return self._fixed_threshold
        mine = self._index.search(
            self._index.descriptor(number), int(near.sum()), np.flatnonzero(near)
        )
        own = float(np.quantile([n.distance for n in mine], options.adaptive_quantile))
        return min(own, options.adaptive_limit * self._fixed_threshold)

    def _judged(
        self, number: int, near: Neighbour, limit: float, landmarks: float | None
    ) -> LoopCandidate:
        most = self.options.max_landmark_distance
        accepted, reason = True, ""
        if near.distance >= limit:
            accepted = False
            reason = f"descriptors differ by {near.distance:.3f}, {limit:.3f} or more"
        elif landmarks is not None and landmarks > most:
            accepted = False
            reason = f"landmarks differ by {landmarks:.3f}, more than {most:.3f}"
        return LoopCandidate(
            query=self._frames[number],
            match=self._frames[near.keyframe],
            query_submap=self._submaps[number],
            match_submap=self._submaps[near.keyframe],
            distance=near.distance,
            cosine=near.cosine,
            landmark_distance=landmarks,
            reason=reason,
            accepted=accepted,
        )


def _chosen(passed: list[LoopCandidate], kept: int) -> list[LoopCandidate]:
    """Candidates in order of preference, all but the first few refused.

    The best by landmarks of each submap come before the second ones: neighbours say the same,
    and where two places look alike those of the wrong one could be all that is asked.
    """
    ranked = sorted(passed, key=_rank)
    turns: Counter[int] = Counter()
    numbered = []
    for place, candidate in enumerate(ranked):
        numbered.append((turns[candidate.match_submap], place, candidate))
        turns[candidate.match_submap] += 1
    chosen: list[LoopCandidate] = []
    for turn, place, candidate in sorted(numbered, key=lambda entry: entry[:2]):
        reason = f"number {place + 1} of {len(ranked)} by landmarks, {turn + 1} of its submap"
        accepted = len(chosen) < kept
        if not accepted:
            reason += f"; {kept} are kept"
        chosen.append(replace(candidate, accepted=accepted, reason=reason))
    return chosen


def _rank(candidate: LoopCandidate) -> tuple[float, float]:
    landmarks = candidate.landmark_distance
    return (_UNKNOWN_LANDMARKS if landmarks is None else landmarks, candidate.distance)
