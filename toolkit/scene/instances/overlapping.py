"""Objects of two submaps or maps that overlap in the world."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from toolkit.scene.instances.voxels import VoxelVotes

# Minimum intersection over union, in the voxels that both submaps know, of objects of two submaps,
# and minimum number of voxels that they share.
_MIN_OVERLAP, _MIN_SHARED = 0.25, 5
# Factor of the overlap of objects of different classes.
_OTHER_CLASS = 0.5


def overlapping(
    one: VoxelVotes,
    other: VoxelVotes,
    class_of_one: Callable[[int], str | None],
    class_of_other: Callable[[int], str | None],
) -> list[tuple[float, int, int]]:
    """Overlap and numbers of the pairs of objects of two submaps or maps that may be one.

    Args:
        one, other: votes for the objects of both, in one frame.
        class_of_one, class_of_other: class names of their objects.
    """
    rows = other.rows(one.keys)
    shared = rows >= 0
    if not shared.any():
        return []
    mine, theirs = one.owners[shared, 0], other.owners[rows[shared], 0]
    pairs, counts = np.unique(np.stack([mine, theirs], axis=1), axis=0, return_counts=True)
    size_a, size_b = np.bincount(mine), np.bincount(theirs)
    found = []
    for (a, b), count in zip(pairs.tolist(), counts.tolist(), strict=True):
        if not a or not b:
            continue
        overlap = count / (size_a[a] + size_b[b] - count)
        names = [class_of_one(a), class_of_other(b)]
        if None not in names and names[0] != names[1]:
            overlap *= _OTHER_CLASS
        if overlap >= _MIN_OVERLAP and count >= _MIN_SHARED:
            found.append((float(overlap), int(a), int(b)))
    return found
