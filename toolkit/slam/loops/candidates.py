"""Loop candidates: keyframes with similar descriptors, ranked by landmarks (G, Algorithm 1).

Registration decides later whether a candidate is a loop. Each search therefore returns every
keyframe that it considered, accepted or rejected, with the reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.io.arrays import arrays_below
from toolkit.slam.loops.landmarks import landmark_distance, landmark_vectors, printed_vectors
from toolkit.slam.loops.options import CandidateOptions, LandmarkOptions
from toolkit.slam.loops.retrieval import DescriptorIndex, Neighbour

# Landmark distance assumed where it is unknown: that of vectors with little in common.
_UNKNOWN_LANDMARKS = 1.0
# The adaptive threshold is this quantile of the descriptor distances within the query's submap, and
# at most this multiple of the fixed one.
_ADAPTIVE_QUANTILE, _ADAPTIVE_LIMIT = 0.5, 1.5
# The adaptive threshold needs at least this many distances to neighbouring keyframes.
_MIN_NEIGHBOURS = 3


@dataclass(frozen=True)
class DescribedKeyframe:
    """A keyframe as loop detection stores it.

    Attributes:
        frame: index in the sequence.
        submap: number of its submap.
        travelled_m: length of the estimated path up to this keyframe, metres.
        descriptor: [D] float32 of unit length.
        class_counts: [C] observed pixels or Gaussians per class, void excluded; C may be 0.
        submap_counts: [C] Gaussians per class in its submap so far; None where they are not
            counted.
    """

    frame: int
    submap: int
    travelled_m: float
    descriptor: NDArray[np.float32]
    class_counts: NDArray[np.int64]
    submap_counts: NDArray[np.int64] | None = None


@dataclass(frozen=True)
class LoopCandidate:
    """Two keyframes that may show the same place.

    Attributes:
        query, match: frame indices; the match is the older keyframe.
        query_submap, match_submap: numbers of their submaps.
        distance: Euclidean distance between the descriptors.
        cosine: cosine similarity of the descriptors.
        landmark_distance: distance between the landmark vectors; None if unknown.
        reason: why it was accepted or rejected.
        accepted: whether it is passed on to verification.
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
        """Return the fields as a dictionary for the loop log."""
        return asdict(self)


@dataclass(frozen=True)
class SimilarKeyframe:
    """A keyframe similar to a query view.

    Attributes:
        frame: index in the sequence.
        submap: number of its submap.
        distance: Euclidean distance between the descriptors.
    """

    frame: int
    submap: int
    distance: float


class CandidateFinder:
    """Stores the keyframes of a run and searches them for loop candidates at a fixed interval.

    Args:
        dimensions: length D of a descriptor.
        threshold: maximum descriptor distance of the encoder.
        options: candidate selection; default if None.
        landmarks: class weighting; default if None.

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
        self._submap_counts: dict[int, NDArray[np.int64]] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, keyframe: DescribedKeyframe) -> list[LoopCandidate]:
        """Store a keyframe and search for its loops if a search is due.

        Args:
            keyframe: next keyframe, with a larger frame index than the previous one.

        Returns:
            The keyframes considered: accepted candidates first, best first, then rejected ones.
            Empty if no search was due.

        Raises:
            ValueError: the keyframe is out of order or has a different number of classes.
        """
        number = self.remember(keyframe)
        return self.search(number) if self.search_due else []

    def remember(self, keyframe: DescribedKeyframe) -> int:
        """Store a keyframe without a search and return its number.

        Raises:
            ValueError: the keyframe is out of order or has a different number of classes.
        """
        number = self._index.add(keyframe.descriptor)
        self._frames.append(keyframe.frame)
        self._submaps.append(keyframe.submap)
        self._travelled_m.append(keyframe.travelled_m)
        self._class_counts.append(np.array(keyframe.class_counts, np.int64))
        if keyframe.submap_counts is not None:
            self._submap_counts[keyframe.submap] = np.array(keyframe.submap_counts, np.int64)
        return number

    @property
    def search_due(self) -> bool:
        """Whether a loop search is due at the newest keyframe."""
        return len(self) > 0 and len(self) % self.options.search_every == 0

    def search(self, number: int) -> list[LoopCandidate]:
        """Search candidates for keyframe `number`, counted from 0; returns the same as `add`."""
        options = self.options
        among = np.flatnonzero(self._beyond_gap(number))
        found = self._index.search(self._index.descriptor(number), options.considered, among)
        if not found:
            return []
        vectors = self._landmark_vectors()
        limit = self._threshold_of(number)
        evaluated = [
            self._evaluate(
                number, near, limit, landmark_distance(vectors[number], vectors[near.keyframe])
            )
            for near in found
        ]
        rejected = [c for c in evaluated if not c.accepted]
        order = _by_distance if options.threshold == "rank" else _by_landmarks
        return _select([c for c in evaluated if c.accepted], options.kept, order) + rejected

    def _landmark_vectors(self) -> NDArray[np.float64]:
        """Landmark vectors [K, C] of all keyframes."""
        counts = np.stack(self._class_counts)
        if self._landmarks.weighting != "paper":
            return landmark_vectors(counts, self._landmarks)
        unknown = np.zeros_like(counts[0])
        rows = [self._submap_counts.get(submap, unknown) for submap in self._submaps]
        return printed_vectors(counts, np.stack(rows))

    def most_similar(self, descriptor: NDArray[np.float32], count: int) -> list[SimilarKeyframe]:
        """Return the keyframes with the nearest descriptors to [D], nearest first."""
        return [
            SimilarKeyframe(self._frames[n.keyframe], self._submaps[n.keyframe], n.distance)
            for n in self._index.search(descriptor, count)
        ]

    def state(self) -> dict[str, NDArray]:
        """Return the arrays from which `restore` continues identically."""
        counts = self._class_counts
        return {
            **self._index.state(),
            "frames": np.array(self._frames, np.int64),
            "submaps": np.array(self._submaps, np.int64),
            "travelled_m": np.array(self._travelled_m, np.float64),
            "class_counts": np.stack(counts) if counts else np.zeros((0, 0), np.int64),
            **{f"submap_counts/{n}": c for n, c in self._submap_counts.items()},
        }

    def restore(self, state: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._index = DescriptorIndex.from_state(state, self._index.dimensions)
        self._frames = [int(n) for n in state["frames"]]
        self._submaps = [int(n) for n in state["submaps"]]
        self._travelled_m = [float(m) for m in state["travelled_m"]]
        self._class_counts = [np.array(counts) for counts in state["class_counts"]]
        submap_counts = arrays_below(state, "submap_counts/")
        self._submap_counts = {int(n): np.array(c) for n, c in submap_counts.items()}

    def _beyond_gap(self, number: int) -> NDArray[np.bool_]:
        """[K] mask of keyframes older by the minimum number of frames and metres."""
        frames, travelled_m = np.array(self._frames), np.array(self._travelled_m)
        options = self.options
        far = frames[number] - frames >= options.min_gap_frames
        return far & (travelled_m[number] - travelled_m >= options.min_gap_m)

    def _threshold_of(self, number: int) -> float:
        """Descriptor distance below which matches of a keyframe are accepted."""
        options = self.options
        if options.threshold == "rank":
            return np.inf if options.distance is None else options.distance
        if options.threshold == "fixed":
            return self._fixed_threshold
        submaps, numbers = np.array(self._submaps), np.arange(len(self))
        near = (submaps == submaps[number]) & (numbers < number) & ~self._beyond_gap(number)
        if near.sum() < _MIN_NEIGHBOURS:
            return self._fixed_threshold
        neighbours = self._index.search(
            self._index.descriptor(number), int(near.sum()), np.flatnonzero(near)
        )
        own = float(np.quantile([n.distance for n in neighbours], _ADAPTIVE_QUANTILE))
        return min(own, _ADAPTIVE_LIMIT * self._fixed_threshold)

    def _evaluate(
        self, number: int, near: Neighbour, limit: float, landmarks: float | None
    ) -> LoopCandidate:
        accepted = near.distance < limit
        reason = f"descriptor distance {near.distance:.3f}, not below {limit:.3f}"
        return LoopCandidate(
            query=self._frames[number],
            match=self._frames[near.keyframe],
            query_submap=self._submaps[number],
            match_submap=self._submaps[near.keyframe],
            distance=near.distance,
            cosine=near.cosine,
            landmark_distance=landmarks,
            reason="" if accepted else reason,
            accepted=accepted,
        )


def _select(
    passed: list[LoopCandidate], kept: int, order: Callable[[LoopCandidate], tuple[float, float]]
) -> list[LoopCandidate]:
    """Order candidates by preference and accept the first `kept`.

    The best candidate of every submap precedes the second best of any submap. Neighbouring
    keyframes of one submap are redundant, and where two places look similar, the candidates of
    the wrong place could otherwise take all `kept` positions.
    """
    ranked = sorted(passed, key=order)
    turns: Counter[int] = Counter()
    numbered = []
    for rank, candidate in enumerate(ranked):
        numbered.append((turns[candidate.match_submap], rank, candidate))
        turns[candidate.match_submap] += 1
    chosen: list[LoopCandidate] = []
    for turn, rank, candidate in sorted(numbered, key=lambda entry: entry[:2]):
        reason = f"rank {rank + 1} of {len(ranked)}, {turn + 1} in its submap"
        accepted = len(chosen) < kept
        if not accepted:
            reason += f"; {kept} are kept"
        chosen.append(replace(candidate, accepted=accepted, reason=reason))
    return chosen


def _by_distance(candidate: LoopCandidate) -> tuple[float, float]:
    return (candidate.distance, _by_landmarks(candidate)[0])


def _by_landmarks(candidate: LoopCandidate) -> tuple[float, float]:
    landmarks = candidate.landmark_distance
    return (_UNKNOWN_LANDMARKS if landmarks is None else landmarks, candidate.distance)
