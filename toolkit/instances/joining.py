"""Joining of objects that are one: parts, duplicates in a submap, objects of several submaps."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from toolkit.instances.evidence import MIN_APART
from toolkit.instances.tracking import InstanceTracker
from toolkit.instances.voxels import VoxelVotes

# Fraction of the voxels of the smaller object that both own, from which two objects are one.
_DUPLICATE = 0.5
# A voxel belongs to both of its objects if the second has this fraction of the votes of the first.
_BOTH = 0.3
# Minimum intersection over union, in the voxels that both submaps know, of objects of two submaps,
# and minimum number of voxels that they share.
_MIN_OVERLAP, _MIN_SHARED = 0.25, 5
# Factor of the overlap of objects of different classes.
_OTHER_CLASS = 0.5


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
    found: list[tuple[float, int, int]] = []
    for one, other in combinations(sorted(votes), 2):
        found += _overlaps(tracker, votes[one], votes[other])
    submaps = {n: {tracker.objects[n].submap} for pair in found for n in pair[1:]}
    for _, a, b in sorted(found, key=lambda row: (-row[0], row[1:])):
        a, b = tracker.current(a), tracker.current(b)
        if a == b or submaps[a] & submaps[b]:
            continue
        together = submaps[a] | submaps[b]
        submaps[_merge(tracker, a, b)] = together


def _overlaps(
    tracker: InstanceTracker, one: VoxelVotes, other: VoxelVotes
) -> list[tuple[float, int, int]]:
    """Overlap and numbers of pairs of objects of two submaps."""
    rows = other.rows(one.keys)
    shared = rows >= 0
    if not shared.any():
        return []
    mine, theirs = one.owners[shared, 0], other.owners[rows[shared], 0]
    pairs, counts = np.unique(np.stack([mine, theirs], axis=1), axis=0, return_counts=True)
    size_a, size_b = np.bincount(mine), np.bincount(theirs)
    found = []
    for (a, b), count in zip(pairs.tolist(), counts.tolist(), strict=True):
        overlap = count / (size_a[a] + size_b[b] - count)
        names = [tracker.objects[n].class_name for n in (a, b)]
        if None not in names and names[0] != names[1]:
            overlap *= _OTHER_CLASS
        if overlap >= _MIN_OVERLAP and count >= _MIN_SHARED:
            found.append((float(overlap), int(a), int(b)))
    return found


def _merge(tracker: InstanceTracker, a: int, b: int) -> int:
    """Merge two objects into the one with more pixels; return its number."""
    if a == b:
        return a
    kept, gone = sorted((a, b), key=lambda n: (-tracker.objects[n].area, n))
    tracker.merge(kept, gone)
    return kept
