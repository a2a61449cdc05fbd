"""Joining of objects that are one: parts, duplicates in a submap, objects of several submaps."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from toolkit.scene.instances.evidence import MIN_APART
from toolkit.scene.instances.overlapping import overlapping
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.scene.instances.voxels import VoxelVotes

# Fraction of the voxels of the smaller object that both own, from which two objects are one.
_DUPLICATE = 0.5
# A voxel belongs to both of its objects if the second has this fraction of the votes of the first.
_BOTH = 0.3


def join_parts(tracker: InstanceTracker) -> None:
    """Return parts of objects that were hardly ever seen apart to their objects."""
    for number in sorted(tracker.objects, reverse=True):
        parent = tracker.objects[number].parent
        if parent not in tracker.objects:
            continue
        together, apart = tracker.evidence.counts(parent, number)
        if apart < MIN_APART or together >= apart:
            tracker.merge(parent, number)


def join_duplicates(tracker: InstanceTracker, votes: VoxelVotes) -> None:
    """Merge objects of one submap that occupy the same voxels, as after loops within it."""
    first, second = votes.owners.T
    both = (second > 0) & (votes.votes[:, 1] >= _BOTH * votes.votes[:, 0])
    pairs, counts = np.unique(np.sort(votes.owners[both], axis=1), axis=0, return_counts=True)
    sizes = np.bincount(np.concatenate([first, second[second > 0]]))
    for (a, b), count in zip(pairs.tolist(), counts.tolist(), strict=True):
        if count < _DUPLICATE * min(sizes[a], sizes[b]):
            continue
        a, b = tracker.current(a), tracker.current(b)
        if not tracker.evidence.are_apart(a, b):
            _merge(tracker, a, b)


def join_submaps(tracker: InstanceTracker, votes: Mapping[int, VoxelVotes]) -> None:
    """Merge objects of several submaps that overlap in the world.

    Two objects of one submap are never merged this way.

    Args:
        votes: of all submaps of a part of the map, in its frame.
    """

    def class_of(number: int) -> str | None:
        return tracker.objects[number].class_name

    found: list[tuple[float, int, int]] = []
    for one, other in combinations(sorted(votes), 2):
        found += overlapping(votes[one], votes[other], class_of, class_of)
    submaps = {n: {tracker.objects[n].submap} for pair in found for n in pair[1:]}
    for _, a, b in sorted(found, key=lambda row: (-row[0], row[1:])):
        a, b = tracker.current(a), tracker.current(b)
        if a == b or submaps[a] & submaps[b]:
            continue
        together = submaps[a] | submaps[b]
        submaps[_merge(tracker, a, b)] = together


def _merge(tracker: InstanceTracker, a: int, b: int) -> int:
    """Merge two objects into the one with more pixels; return its number."""
    if a == b:
        return a
    kept, gone = sorted((a, b), key=lambda n: (-tracker.objects[n].area, n))
    tracker.merge(kept, gone)
    return kept
